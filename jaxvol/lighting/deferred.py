"""Deferred lighting: each ray is shaded once, at the mean depth of what it sees."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.vec3 import Scalar, along
from ..scene.space import Line, Space
from ..scene.transfer import Classification
from .shading import Lighting, Sample, Shading, Surroundings


class Deferred(Lighting):
    """A lighting that shades each ray once, rather than each of its samples.

    Rays are marched without light. What lies at a ray's mean depth is then shaded as one sample of colour C /
    A that nothing hides, where C is the ray's colour and A its opacity.

    This is right where a ray sees one surface. Where it sees several, one through the other, the mean depth
    lies between them, perhaps where there is no material, and then the pixel stays unlit. Baked light shows
    its grid as faint rings. `experiments/lighting.py` measures the error:
    `Deferred(ScattererTemplates(..., templates=2, blend=True, photons=8))` is the cheapest that is as near as
    all photons of a template on all samples.

    The gradient of voxels takes an array of their size for each place where light is looked up, for each
    chunk of 2048 pixels: slow for large volumes.

    **Arguments:**

    - `lighting`: how the one sample is shaded.

    **Raises:** `ValueError` for something that is no lighting.
    """

    lighting: Lighting

    def __init__(self, lighting: Lighting | Any):
        if not isinstance(lighting, Lighting):
            raise ValueError(f"lighting must be a Lighting, such as ScattererTemplates; got {lighting!r}.")
        self.lighting = lighting

    @property
    def reads_gradient(self) -> bool:
        return self.lighting.reads_gradient

    def for_image(self, around: Surroundings) -> Shading:
        return self.lighting.for_image(around)

    def shade_pixel(
        self,
        classification: Classification,
        space: Space,
        line: Line,
        rgba: Float[Array, "4"],
        depth: Scalar,
    ) -> Float[Array, "4"]:
        """The shaded colour and opacity of a ray (premultiplied), from those without light and its depth."""
        light = classification.light
        assert light is not None
        opacity = rgba[3]
        visible = opacity != 0  # NaN stays NaN
        red, green, blue = (rgba[i] / jnp.where(visible, opacity, 1) for i in range(3))
        point = along(line.origin, line.direction, jnp.where(visible, depth, 0))
        measured = classification.at(space.coordinate(point))
        _, extinction = classification.classify(measured)
        one = jnp.ones_like(opacity)
        sample = Sample(point, line.direction, measured, (red, green, blue), extinction, one, line.pixel)
        return jnp.stack([*(jnp.where(visible, opacity * part, 0) for part in light(sample)), opacity])
