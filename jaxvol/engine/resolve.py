"""Computes pixels after the march, by chunks of those that are not transparent.

For modes that resolve, and for lightings that shade pixels (`ray.resolve`).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.vec3 import Scalar
from ..compositing.blending import Outputs, Weighting
from ..compositing.selection import Selection
from ..ray import Scene, bands_of, resolve
from ..scene.rendering import Details, Rendering
from ..scene.space import Line
from ..scene.volume import fetches_of, with_fetches
from ..xla.compaction import in_front, in_place
from ..xla.trees import PyTree
from .acceleration import VolumeAcceleration
from .rays import lines_at
from .tiling import RenderOptions, Tiling


MarchResult: TypeAlias = tuple[Float[Array, "*rays colors"], Float[Array, "*rays"], PyTree]
"""Result of a march, per ray: `Rendering.rgba`, `Rendering.depth` and `Details.selected`."""


def resolve_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, marched: MarchResult
) -> Float[Array, "*rays numbers"]:
    """Pixels, their depths and, if requested, normals, from the result of the march: concatenated numbers,
    which `with_pixels` splits."""
    packed, mode = acceleration.packed(scene), scene.compositing
    if options.adjoint == "forward":
        fetches = [replace(fetch, steady=True) for fetch in fetches_of(packed.volume)]
        packed = packed._replace(volume=with_fetches(packed.volume, fetches))
    prepared = packed.prepared()
    with_normal = isinstance(mode, Selection) and mode.has_normal and options.outputs == "all"

    def one(line: Line, rgba: Float[Array, " n"], depth: Scalar, selected: PyTree) -> Float[Array, " m"]:
        pixel = resolve(prepared, line, rgba, depth, selected)
        normal = [pixel.normal] if with_normal and pixel.normal is not None else []
        return jnp.concatenate([pixel.rgba, pixel.depth[None], *normal])

    def resolve_chunk(indices: Int[Array, " chunk"], *marched: PyTree) -> Float[Array, "chunk numbers"]:
        return jax.vmap(one)(lines_at(scene.source, indices), *marched)

    transparent = isinstance(mode, Weighting) and mode.resolves_transparent
    bands = bands_of(scene.transfer, scene.volume)
    resolved = resolve_visible(
        resolve_chunk, options.tiling, marched, bands, 3 * with_normal, transparent=transparent
    )
    return resolved * jnp.where(scene.has_fault, jnp.nan, 1).astype(resolved.dtype)


def resolve_visible(
    resolve_chunk: Callable[..., Float[Array, "chunk numbers"]],
    tiling: Tiling,
    marched: MarchResult,
    bands: int,
    extra: int,
    *,
    transparent: bool = False,
) -> Float[Array, "*rays numbers"]:
    """Pixels of `bands` colours, opacity, depth and `extra` numbers, by `resolve_chunk(indices, *marched)`:
    chunks of visible pixels, or all pixels at once if `Tiling.chunk` is 0. Transparent pixels are 0, at
    infinite depth; with `transparent`, they are computed, too, for their derivatives."""
    numbers = bands + 2 + extra
    shape, size = marched[1].shape, tiling.chunk
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(shape) :]), marched)
    visible = flat[0][:, flat[0].shape[1] - 1] != 0
    background = jnp.zeros((visible.size, numbers), flat[0].dtype).at[:, bands + 1].set(jnp.inf)
    if visible.size == 0:
        return background.reshape(*shape, numbers)
    # at an infinite depth, values and derivatives would be NaN
    flat = (flat[0], *jax.tree.map(lambda leaf: jnp.where(visible, leaf, jnp.zeros_like(leaf)), flat[1:]))
    asked = jnp.ones_like(visible) if transparent else visible
    count, chosen = jnp.sum(asked, dtype=jnp.int32), in_front(asked, size) if size > 0 else in_place(asked)

    # recomputed in the backward pass: stored states would take memory for all rays
    @jax.checkpoint
    def computed(indices: Int[Array, " chunk"]) -> Float[Array, "chunk numbers"]:
        indices = jnp.minimum(indices, visible.size - 1)
        return resolve_chunk(indices, *jax.tree.map(lambda leaf: leaf[indices], flat))

    def chunk(start: Int[Array, ""]) -> Float[Array, "chunk numbers"]:
        indices = jax.lax.dynamic_slice_in_dim(chosen, start, size)
        none = jnp.zeros((size, numbers), background.dtype)
        return jax.lax.cond(start < count, computed, lambda _: none, indices)

    if size > 0:
        pixels = jax.lax.map(chunk, jnp.arange(0, chosen.size, size, dtype=jnp.int32))
    else:
        pixels = computed(chosen)
    pixels = background.at[chosen].set(pixels.reshape(-1, numbers), mode="drop")
    if transparent:
        pixels = pixels.at[:, bands + 1].set(jnp.where(visible, pixels[:, bands + 1], jnp.inf))
    return pixels.reshape(*shape, numbers)


def with_pixels(
    scene: Scene, rendering: Rendering, pixels: Float[Array, "*rays numbers"], outputs: Outputs
) -> Rendering:
    """The rendering of a march, with the pixels of `resolve_image`."""
    depth = bands_of(scene.transfer, scene.volume) + 1
    details = Details()
    if outputs == "all":
        normal = pixels[..., depth + 1 :] if pixels.shape[-1] > depth + 1 else None
        details = rendering.details._replace(depth=pixels[..., depth], normal=normal, selected=None)
    return Rendering(pixels[..., :depth], rendering.exhausted, details)
