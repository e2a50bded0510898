"""Light sources, and how much of their light arrives at a point. Names and units are Mitsuba's: irradiance is
power per area, radiance power per area and solid angle, each in linear RGB."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from .._util.checks import Arrayable, finite_array, not_negative, require
from .._util.vec3 import Scalar, Vec3, apart


class Arriving(NamedTuple):
    """Light at a point, without occlusion.

    Attributes:
        toward: direction to the light; None for light from all sides.
        distance: distance to the light; infinite for parallel light.
        irradiance: irradiance of a plane that faces the light.
    """

    toward: Vec3 | None
    distance: Scalar
    irradiance: Vec3


class Light(eqx.Module):
    """A light source outside the volume or anywhere inside it."""

    @abstractmethod
    def at(self, point: Vec3, direction: Vec3) -> Arriving:
        """Light that arrives at a world point on a ray of this direction."""


class DirectionalLight(Light):
    """Parallel light, such as sunlight.

    Args:
        direction: (3,) direction in which the light travels, of any length except 0.
        irradiance: (3,) linear RGB, power per area on a plane that faces the light, ≥ 0.

    Raises:
        ValueError: for other shapes, NaN or infinity, a direction of length 0, negative irradiance.
    """

    direction: Float[Array, "3"]
    irradiance: Float[Array, "3"]

    def __init__(self, direction: Arrayable, irradiance: Arrayable = (1.0, 1.0, 1.0)):
        self.direction = require(
            finite_array("direction", direction, (3,)),
            lambda d: (d != 0).any(),
            "direction must not have length 0; got {got}.",
        )
        self.irradiance = not_negative("irradiance", irradiance, (3,))

    def at(self, point: Vec3, direction: Vec3) -> Arriving:
        # scaled first, so that no square overflows or underflows
        travels = self.direction / jax.lax.stop_gradient(jnp.max(jnp.abs(self.direction)))
        x, y, z = apart(-travels / jnp.linalg.norm(travels))
        zero = jnp.zeros_like(point[0])
        r, g, b = apart(self.irradiance)
        return Arriving((x + zero, y + zero, z + zero), zero + jnp.inf, (r + zero, g + zero, b + zero))


class PointLight(Light):
    """Isotropic point light. Its irradiance falls with the square of the distance.

    Args:
        position: (3,) world point.
        intensity: (3,) linear RGB, power per solid angle, ≥ 0. The irradiance at distance r is
            intensity / r².

    Raises:
        ValueError: for other shapes, NaN or infinity, and negative intensity.
    """

    position: Float[Array, "3"]
    intensity: Float[Array, "3"]

    def __init__(self, position: Arrayable, intensity: Arrayable = (1.0, 1.0, 1.0)):
        self.position = finite_array("position", position, (3,))
        self.intensity = not_negative("intensity", intensity, (3,))

    def at(self, point: Vec3, direction: Vec3) -> Arriving:
        dx, dy, dz = (p - x for p, x in zip(apart(self.position), point, strict=True))
        # bounded away from 0 at the light itself, where the derivative would be infinite
        squared = jnp.maximum(dx * dx + dy * dy + dz * dz, jnp.finfo(dx.dtype).tiny ** 0.5)
        distance = jnp.sqrt(squared)
        r, g, b = (i / squared for i in apart(self.intensity))
        return Arriving((dx / distance, dy / distance, dz / distance), distance, (r, g, b))


class HeadLight(Light):
    """A light at the camera: parallel light along each ray. For `Phong`.

    Args:
        irradiance: (3,) linear RGB, power per area on a plane that faces the ray, ≥ 0.

    Raises:
        ValueError: for another shape, NaN or infinity, and negative irradiance.
    """

    irradiance: Float[Array, "3"]

    def __init__(self, irradiance: Arrayable = (1.0, 1.0, 1.0)):
        self.irradiance = not_negative("irradiance", irradiance, (3,))

    def at(self, point: Vec3, direction: Vec3) -> Arriving:
        x, y, z = direction
        return Arriving((-x, -y, -z), jnp.full_like(x, jnp.inf), apart(self.irradiance))


class ConstantLight(Light):
    """The same radiance from all directions, as in a white room or under an overcast sky.

    Args:
        radiance: (3,) linear RGB, ≥ 0.

    Raises:
        ValueError: for another shape, NaN or infinity, and negative radiance.
    """

    radiance: Float[Array, "3"]

    def __init__(self, radiance: Arrayable = (1.0, 1.0, 1.0)):
        self.radiance = not_negative("radiance", radiance, (3,))

    def at(self, point: Vec3, direction: Vec3) -> Arriving:
        r, g, b = (jnp.pi * radiance for radiance in self.radiance)
        return Arriving(None, jnp.full_like(point[0], jnp.inf), (r, g, b))


def located(lights: tuple[Light, ...]) -> list[Light]:
    """Select the lights that reach a point from a single direction."""
    return [light for light in lights if not isinstance(light, ConstantLight)]


def sky_of(lights: tuple[Light, ...], dtype: DTypeLike) -> Vec3:
    """Radiance of all constant lights."""
    constant = [light.radiance for light in lights if isinstance(light, ConstantLight)]
    return apart(sum(constant, jnp.zeros(3, dtype)))


def lights_of(lights: Light | Sequence[Light], excluded: type[Light] = HeadLight) -> tuple[Light, ...]:
    """Convert to a tuple of lights of any but the `excluded` kind; `ValueError` for anything else."""
    sources = (lights,) if isinstance(lights, Light) else lights
    if not isinstance(sources, tuple | list) or not sources:
        raise ValueError(f"lights must be a light or a tuple of lights; got {lights!r}.")
    for light in sources:
        if not isinstance(light, Light) or isinstance(light, excluded):
            raise ValueError(
                f"lights must hold jaxvol lights, of any kind but {excluded.__name__}; got {light!r}."
            )
    return tuple(sources)
