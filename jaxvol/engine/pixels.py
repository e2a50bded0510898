"""Computes pixels after the march, by chunks of those that are not transparent.

For modes that select a depth, and for lightings that shade pixels: `reference.finish` says what of each.
"""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.compaction import CHUNK, in_front
from .._util.trees import PyTree
from .._util.vec3 import Scalar
from ..reference import finish
from .acceleration import VolumeAcceleration
from .image import fault_of, pipeline_of
from .scene import Scene
from .tiles import line


Found: TypeAlias = tuple[Float[Array, "*rays 4"], Float[Array, "*rays"], PyTree]
"""What a march found, of rays: `Rendering.rgba`, `Rendering.depth` and `Details.selected`."""


def finish_image(scene: Scene, acceleration: VolumeAcceleration, found: Found) -> Float[Array, "*rays 5"]:
    """Pixels and their depths, from what the march found."""
    scene = acceleration.packed(scene)
    space, pipeline = pipeline_of(scene)

    def one(place: Int[Array, ""], rgba: Float[Array, "4"], depth: Scalar, selected: PyTree) -> Array:
        through = line(scene.source, place)
        return jnp.append(*finish(pipeline, scene.lighting, space, through, rgba, depth, selected))

    finished = of_visible(one, found)
    return finished * jnp.where(fault_of(scene), jnp.nan, 1).astype(finished.dtype)


def of_visible(one: Callable[..., Float[Array, "5"]], found: Found) -> Float[Array, "*rays 5"]:
    """`one` of the index, and of what was found, of each pixel that is not transparent; the others stay
    transparent, and infinitely far."""
    shape = found[1].shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(shape) :]), found)
    visible = flat[0][:, 3] != 0
    place, last = in_front(visible), jnp.maximum(jnp.sum(visible, dtype=jnp.int32) - 1, 0)
    nothing = jnp.zeros((visible.size, 5), flat[0].dtype).at[:, 4].set(jnp.inf)

    # recomputed in the backward pass, where its states would take memory for all rays
    @jax.checkpoint
    def some(places: Int[Array, " chunk"]) -> Float[Array, "chunk 5"]:
        # beyond the last visible one that one again, since nothing can be shaded at an infinite depth
        places = jnp.where(places < visible.size, places, place[last])
        return jax.vmap(one)(places, *jax.tree.map(lambda leaf: leaf[places], flat))

    def chunk(number: Int[Array, ""]) -> Float[Array, "chunk 5"]:
        places = jax.lax.dynamic_slice_in_dim(place, number * CHUNK, CHUNK)
        return jax.lax.cond(
            number * CHUNK <= last, some, lambda _: jnp.zeros((CHUNK, 5), nothing.dtype), places
        )

    pixels = jax.lax.map(chunk, jnp.arange(place.size // CHUNK, dtype=jnp.int32)).reshape(-1, 5)
    return nothing.at[place].set(pixels, mode="drop").reshape(*shape, 5)
