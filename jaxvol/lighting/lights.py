"""Light sources, and how much of their light arrives at a point. Names and units are Mitsuba's: irradiance is
power per area, radiance power per area and solid angle, each in linear RGB."""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.checks import Arrayable, finite_array, require
from .._util.vec3 import Scalar, Vec3, apart


class Arriving(NamedTuple):
    """Light at a point from one direction: toward the light, its distance (infinite for parallel light), and
    the irradiance on a plane that faces it, without occlusion."""

    toward: Vec3
    distance: Scalar
    irradiance: Vec3


class Light(eqx.Module):
    """A light source outside the volume or anywhere inside it."""


class LocatedLight(Light):
    """Light that reaches each point from a single direction."""

    @abstractmethod
    def at(self, point: Vec3) -> Arriving:
        """Light that arrives at a world point."""


class DirectionalLight(LocatedLight):
    """Parallel light, such as sunlight.

    **Arguments:**

    - `direction`: (3,), in which the light travels; any length except 0.
    - `irradiance`: (3,) linear RGB, power per area on a plane that faces the light, ≥ 0.

    **Raises:** `ValueError` for other shapes, NaN or infinity, a direction of length 0, negative irradiance.
    """

    direction: Float[Array, "3"]
    irradiance: Float[Array, "3"]

    def __init__(self, direction: Arrayable, irradiance: Arrayable = (1.0, 1.0, 1.0)):
        self.direction = require(
            finite_array("direction", direction, (3,)),
            lambda d: (d != 0).any(),
            "direction must not have length 0; got {got}.",
        )
        self.irradiance = _power("irradiance", irradiance)

    def at(self, point: Vec3) -> Arriving:
        # scaled first, so that no square overflows or underflows
        direction = self.direction / jax.lax.stop_gradient(jnp.max(jnp.abs(self.direction)))
        x, y, z = apart(-direction / jnp.linalg.norm(direction))
        zero = jnp.zeros_like(point[0])
        r, g, b = apart(self.irradiance)
        return Arriving((x + zero, y + zero, z + zero), zero + jnp.inf, (r + zero, g + zero, b + zero))


class PointLight(LocatedLight):
    """Isotropic point light. Its irradiance falls with the square of the distance.

    **Arguments:**

    - `position`: (3,) world point.
    - `intensity`: (3,) linear RGB, power per solid angle, ≥ 0. The irradiance at distance r is
      intensity / r².

    **Raises:** `ValueError` for other shapes, NaN or infinity, and negative intensity.
    """

    position: Float[Array, "3"]
    intensity: Float[Array, "3"]

    def __init__(self, position: Arrayable, intensity: Arrayable = (1.0, 1.0, 1.0)):
        self.position = finite_array("position", position, (3,))
        self.intensity = _power("intensity", intensity)

    def at(self, point: Vec3) -> Arriving:
        dx, dy, dz = (p - x for p, x in zip(apart(self.position), point, strict=True))
        # bounded away from 0 at the light itself, where the derivative would be infinite
        squared = jnp.maximum(dx * dx + dy * dy + dz * dz, jnp.finfo(dx.dtype).tiny ** 0.5)
        distance = jnp.sqrt(squared)
        r, g, b = (i / squared for i in apart(self.intensity))
        return Arriving((dx / distance, dy / distance, dz / distance), distance, (r, g, b))


class HeadLight(Light):
    """A light at the camera: each ray brings its own parallel light, which travels along it. For `Phong`.

    **Arguments:**

    - `irradiance`: (3,) linear RGB, power per area on a plane that faces the ray, ≥ 0.

    **Raises:** `ValueError` for another shape, NaN or infinity, and negative irradiance.
    """

    irradiance: Float[Array, "3"]

    def __init__(self, irradiance: Arrayable = (1.0, 1.0, 1.0)):
        self.irradiance = _power("irradiance", irradiance)


class ConstantLight(Light):
    """The same radiance from all directions, as in a white room or under an overcast sky.

    **Arguments:**

    - `radiance`: (3,) linear RGB, ≥ 0.

    **Raises:** `ValueError` for another shape, NaN or infinity, and negative radiance.
    """

    radiance: Float[Array, "3"]

    def __init__(self, radiance: Arrayable = (1.0, 1.0, 1.0)):
        self.radiance = _power("radiance", radiance)


def lights_of(
    lights: Light | tuple[Light, ...] | Any,
    kinds: tuple[type[Light], ...] = (LocatedLight, ConstantLight),
) -> tuple[Light, ...]:
    """One or several lights of some kinds, as a tuple; `ValueError` for anything else."""
    several = (lights,) if isinstance(lights, Light) else lights
    if not isinstance(several, tuple | list) or not several:
        raise ValueError(f"lights must be a light or a tuple of lights; got {lights!r}.")
    for light in several:
        if not isinstance(light, kinds):
            classes = (DirectionalLight, PointLight, HeadLight, ConstantLight)
            known = ", ".join(each.__name__ for each in classes if issubclass(each, kinds))
            raise ValueError(f"lights must hold jaxvol lights, here {known}; got {light!r}.")
    return tuple(several)


def _power(name: str, value: Arrayable) -> Float[Array, "3"]:
    return require(
        finite_array(name, value, (3,)), lambda v: v >= 0, f"{name} must not be negative; got {{got}}."
    )
