"""Where does light come from, and how much of it arrives? With Mitsuba's names and units.

Irradiance is power per area, radiance power per area and solid angle, each in linear RGB. Images by
`path_trace`, and by `ScattererTemplates` wherever there is a material, are in radiance of the same unit.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.checks import Arrayable, finite_array, require
from .._util.vec3 import Scalar, Vec3, apart


class Arriving(NamedTuple):
    """Light that arrives at a point from one direction.

    - `toward`: unit direction to the light. `distance`: to it, world length; infinite for parallel light.
    - `irradiance`: (r, g, b) on a plane that faces the light, were nothing in between.
    """

    toward: Vec3
    distance: Scalar
    irradiance: Vec3


class Light(eqx.Module):
    """A source of light outside the volume, or anywhere in it."""


class LocatedLight(Light):
    """Light that comes from a single direction at each point."""

    @abstractmethod
    def at(self, point: Vec3) -> Arriving:
        """What arrives at a world point."""


class DirectionalLight(LocatedLight):
    """Parallel light, as from a sun.

    **Arguments:**

    - `direction`: (3,) in which the light travels; of any length but 0.
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
        x, y, z = apart(-self.direction / jnp.linalg.norm(self.direction))
        like = jnp.zeros_like(point[0])
        r, g, b = apart(self.irradiance)
        return Arriving((x + like, y + like, z + like), like + jnp.inf, (r + like, g + like, b + like))


class PointLight(LocatedLight):
    """Light from a point, alike in all directions. Its irradiance falls with the square of the distance.

    **Arguments:**

    - `position`: (3,) world point.
    - `intensity`: (3,) linear RGB, power per solid angle, ≥ 0. At a distance r it makes an irradiance of
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
        # never 0, and neither is its derivative infinite, at the light itself
        squared = jnp.maximum(dx * dx + dy * dy + dz * dz, jnp.finfo(dx.dtype).tiny ** 0.5)
        distance = jnp.sqrt(squared)
        r, g, b = (i / squared for i in apart(self.intensity))
        return Arriving((dx / distance, dy / distance, dz / distance), distance, (r, g, b))


class ConstantLight(Light):
    """The same light from all directions: a white room, an overcast sky.

    **Arguments:**

    - `radiance`: (3,) linear RGB, ≥ 0.

    **Raises:** `ValueError` for another shape, NaN or infinity, and negative radiance.
    """

    radiance: Float[Array, "3"]

    def __init__(self, radiance: Arrayable = (1.0, 1.0, 1.0)):
        self.radiance = _power("radiance", radiance)


def lights_of(lights: Light | tuple[Light, ...] | Any) -> tuple[Light, ...]:
    """One or several lights as a tuple. **Raises** `ValueError` for none, and for what is no light."""
    several = (lights,) if isinstance(lights, Light) else lights
    if not isinstance(several, tuple | list) or not several:
        raise ValueError(f"lights must be a light, or a tuple of some; got {lights!r}.")
    for light in several:
        if not isinstance(light, LocatedLight | ConstantLight):
            raise ValueError(f"lights must hold jaxvol lights, such as DirectionalLight; got {light!r}.")
    return tuple(several)


def _power(name: str, value: Arrayable) -> Float[Array, "3"]:
    return require(
        finite_array(name, value, (3,)), lambda v: v >= 0, f"{name} must not be negative; got {{got}}."
    )
