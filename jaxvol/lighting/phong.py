"""Surface shading by the angles between the lights, the viewer and the gradient of the values."""

from collections.abc import Sequence
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from .._util.checks import Arrayable, not_negative, number
from .._util.vec3 import Vec3, dot, plus, scaled, times
from ..scene.space import world_gradient
from ..xla.memory import packed_pair, unpacked_pair
from .lights import ConstantLight, HeadLight, Light, lights_of
from .shading import Sample, Shading, Surroundings


Angles: TypeAlias = Float[Array, "..."] | Complex[Array, "..."]
"""Angles of a light at a sample: n·v for a head light; for others n·l and n·v, packed in one array."""


class Phong(Shading):
    """Local illumination by the volume's gradient. With the normal n, the direction v to the viewer, and
    lights of directions l and irradiances E, a sample of colour c gets the colour

        c (ambient + diffuse Σ_lights n·l E) + specular Σ_lights (r·v)^specular_power E

    where r = 2 (n·l) n - l is the direction in which the light is reflected. A light on the far side, with
    n·l ≤ 0, adds nothing.

    - The normal is the world gradient of the value by central differences, of unit length. It is turned to
      the viewer, so that both sides of a surface are lit, as by VTK.
    - Where the gradient is 0 there is no normal, and only ambient light, as in VTK; the same where the square
      of its length leaves the range of floats: in float32, below 1e-19 and above 1e19 value units per length.
    - A light of irradiance 1 is VTK's light of colour 1. Phong's colours are no radiances: lights of
      irradiance π E here are those of irradiance E for `ScattererTemplates` and `path_trace`.
    - Only the angle matters, not whether there is a surface: a nearly homogeneous region is shaded by its
      noise (`experiments/stability.py`, "normals in noise").
    - The highlight of VTK's fixed-point ray caster is as wide as this one of a quarter of the power.

    Gradients are those of this formula, also by an extinction of 0, where samples are lit although they are
    invisible. They grow without bound as the volume's gradient falls to 0; where it is 0, and where a normal
    turns from one side to the other, they miss a jump.

    Args:
        lights: one or several, of any kind but `ConstantLight`; by default a `HeadLight`.
        ambient: ≥ 0. Names and defaults are those of `vtkVolumeProperty`.
        diffuse: ≥ 0.
        specular: ≥ 0.
        specular_power: positive.

    Raises:
        ValueError: for other lights, and for numbers that are negative, NaN or infinite.

    Source: Phong, "Illumination for Computer Generated Pictures", 1975; Levoy, "Display of Surfaces from
    Volume Data", 1988.
    """

    lights: tuple[Light, ...]
    ambient: Float[Array, ""]
    diffuse: Float[Array, ""]
    specular: Float[Array, ""]
    specular_power: Float[Array, ""]

    def __init__(
        self,
        lights: Light | Sequence[Light] | None = None,
        ambient: Arrayable = 0.1,
        diffuse: Arrayable = 0.7,
        specular: Arrayable = 0.2,
        specular_power: Arrayable = 10.0,
    ):
        self.lights = lights_of(HeadLight() if lights is None else lights, excluded=ConstantLight)
        self.ambient = not_negative("ambient", ambient)
        self.diffuse = not_negative("diffuse", diffuse)
        self.specular = not_negative("specular", specular)
        self.specular_power = number("specular_power", specular_power, above=0)

    @property
    def reads_gradient(self) -> bool:
        return True

    @property
    def farthest_read(self) -> float:
        return 0.0

    @property
    def terms(self) -> int:
        return 1

    def begin(self, around: Surroundings, sample: Sample) -> list[tuple[Vec3, Vec3]]:
        """Compute the direction and the irradiance of each light."""
        arriving = [light.at(sample.point, sample.direction) for light in self.lights]
        return [(light.toward, light.irradiance) for light in arriving if light.toward is not None]

    def term(
        self, around: Surroundings, sample: Sample, shared: list[tuple[Vec3, Vec3]], number: Int[Array, ""]
    ) -> tuple[Angles, ...]:
        space, place = around.space.local, sample.place
        if place is None:
            space, place = around.space, sample.point
        gradient = world_gradient(around.volume, space, place)
        squared, toward_viewer = dot(gradient, gradient), -dot(gradient, sample.direction)
        exists = ~(squared <= 0)  # true for NaN, which then shows in the image
        # 0 without a normal, so that it has no derivative
        side = jnp.where(exists, jnp.where(toward_viewer < 0, -1, 1), 0).astype(squared.dtype)
        # Used once per light, last: XLA would store a value of two uses, and then repeat the fetches.
        scale = 1 / jnp.sqrt(jnp.where(exists, squared, 1))

        return tuple(
            side * toward_viewer * scale
            if isinstance(light, HeadLight)
            else packed_pair(side * dot(gradient, toward), side * toward_viewer, scale)
            for light, (toward, _) in zip(self.lights, shared, strict=True)
        )

    def color(self, sample: Sample, shared: list[tuple[Vec3, Vec3]], sums: tuple[Angles, ...]) -> Vec3:
        zero = jnp.zeros_like(sample.extinction)
        diffuse, specular = (zero, zero, zero), (zero, zero, zero)
        for (toward, irradiance), angles in zip(shared, sums, strict=True):
            if jnp.iscomplexobj(angles):
                facing, viewed = unpacked_pair(angles)
                mirrored = 2 * facing * viewed + dot(toward, sample.direction)
            else:
                facing, mirrored = angles, 2 * angles * angles - 1
            shines = (facing > 0) & (mirrored > 0)
            highlight = jnp.exp(self.specular_power * jnp.log(jnp.where(shines, mirrored, 1)))
            diffuse = plus(diffuse, scaled(irradiance, jnp.where(facing <= 0, 0, facing)))
            specular = plus(specular, scaled(irradiance, jnp.where(shines, highlight, 0)))
        ambient = self.ambient
        factor = plus(scaled(diffuse, self.diffuse), (ambient, ambient, ambient))
        return plus(times(sample.color, factor), scaled(specular, self.specular))
