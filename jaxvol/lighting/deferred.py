"""What if each ray were lit once? At the mean depth of what it sees, when all of that is known.

Light varies more slowly than what it falls on, and the samples that make up a surface lie close together. So
they can share the light of one place, which costs as many times less as there are of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.compaction import CHUNK, in_front
from .._util.vec3 import Scalar, Vec3, along
from ..march import March
from ..space import Space
from ..transfer import Classification, Transfer
from ..volume import Volume
from .shading import Lighting, Sample, Shading, Surroundings


class Deferred(Lighting):
    """A lighting that is asked once for each ray, not for each of its samples.

    The march goes on without light, and finds a ray's colour C, opacity A and mean depth. What is at that
    depth is then lit as a sample of colour C / A is that nothing hides.

    It is right where a ray sees one surface, of samples close together beside the distances over which light
    varies. Where it sees several, one through the other, the mean depth lies between them: perhaps where
    there is nothing of any material, and the pixel stays unlit. Of baked light, which is not evened out over
    the samples of a ray, the grid shows as faint rings. How far off it is on an opaque head, and on a
    translucent one, is measured by `experiments/lighting.py`. There two templates blended, of eight
    photons each, come as near to many of them as one does with all its photons on all samples, in a
    fourteenth of the time: `Deferred(ScattererTemplates(..., templates=2, blend=True, photons=8))`.

    Its gradients are those of the image that it makes. That of voxels takes an array like them for each place
    that light is looked up in, of each 2048 pixels: slow for large volumes.

    **Arguments:**

    - `lighting`: how the one sample is lit.

    **Raises:** `ValueError` for something that is no lighting.
    """

    lighting: Lighting

    def __init__(self, lighting: Lighting | Any):
        if not isinstance(lighting, Lighting):
            raise ValueError(f"lighting must be a Lighting, such as ScattererTemplates; got {lighting!r}.")
        self.lighting = lighting

    def over(self, around: Surroundings) -> Shading:
        return self.lighting.over(around)

    def prepared(self, volume: Volume, transfer: Transfer, march: March) -> Lighting:
        return Deferred(self.lighting.prepared(volume, transfer, march))


class Line(NamedTuple):
    """A ray as it was made: origin and unit direction in the world, and (column, row) of the pixel."""

    origin: Vec3
    direction: Vec3
    pixel: tuple[Int[Array, ""], Int[Array, ""]]


def lit_once(
    seen: Classification, space: Space, line: Line, rgba: Float[Array, "4"], depth: Scalar
) -> Float[Array, "4"]:
    """What one ray has seen, as lit by `seen.light`."""
    assert seen.light is not None
    opacity = rgba[3]
    visible = opacity != 0  # NaN stays NaN
    red, green, blue = (rgba[i] / jnp.where(visible, opacity, 1) for i in range(3))
    point = along(line.origin, line.direction, jnp.where(visible, depth, 0))
    measured = seen.searched(seen.measure(space.coordinate(point)))
    _, extinction = seen.classify(measured)
    one = jnp.ones_like(opacity)
    sample = Sample(point, line.direction, measured, (red, green, blue), extinction, one, line.pixel)
    return jnp.stack([*(jnp.where(visible, opacity * part, 0) for part in seen.light(sample)), opacity])


def lit_picture(
    seen: Classification,
    space: Space,
    line: Callable[[Int[Array, ""]], Line],
    rgba: Float[Array, "*rays 4"],
    depth: Float[Array, "*rays"],
) -> Float[Array, "*rays 4"]:
    """What many rays have seen, as lit. `line`: the ray at a place of the flattened picture. Those that have
    seen anything are put together, and lit so many at a time."""
    flat, depth = rgba.reshape(-1, 4), depth.reshape(-1)
    visible = flat[:, 3] != 0
    place, last = in_front(visible), jnp.maximum(jnp.sum(visible, dtype=jnp.int32) - 1, 0)

    # computed again on the way back, where it would take memory for all rays
    @jax.checkpoint
    def lit(places: Int[Array, " chunk"]) -> Float[Array, "chunk 4"]:
        # past the last one that one once more, since there is no light at an infinite depth
        places = jnp.where(places < visible.size, places, place[last])
        one = jax.vmap(lambda place, rgba, depth: lit_once(seen, space, line(place), rgba, depth))
        return one(places, flat[places], depth[places])

    def chunk(number: Int[Array, ""]) -> Float[Array, "chunk 4"]:
        places = jax.lax.dynamic_slice_in_dim(place, number * CHUNK, CHUNK)
        return jax.lax.cond(number * CHUNK <= last, lit, lambda _: jnp.zeros((CHUNK, 4), flat.dtype), places)

    found = jax.lax.map(chunk, jnp.arange(place.size // CHUNK, dtype=jnp.int32)).reshape(-1, 4)
    return jnp.zeros_like(flat).at[place].set(found, mode="drop").reshape(rgba.shape)
