"""Shades samples where they are, for shading that costs less than to gather the visible ones.

Colours are elementwise. The one term that they depend on is computed for rows of neighbouring rays in which
any sample is visible: a fifth of all samples in the bonsai, two fifths in the engine. A row fills a vector
register, so that it is gathered in one piece, and no sample is moved.
"""

from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._util.compaction import Chosen
from .._util.trees import PyTree
from .._util.vec3 import Scalar, Vec3, along
from .._util.xla import gather, in_memory
from ..lighting.shading import Sample, Shader
from ..march import Cell
from ..reference import Pipeline, Progress
from ..selection import Selection
from ..space import Ray


Place: TypeAlias = tuple[Vec3, Vec3, tuple[Int[Array, ""], Int[Array, ""]]]
"""Of a ray, where it enters, its direction and its pixel."""

ROW, CHUNK = 16, 64
"""Rays of a row, and rows whose terms are computed at a time."""


def inline_shader(pipeline: Pipeline) -> Shader | None:
    """What shades all samples of a march where they are, if anything does."""
    light = pipeline.classification.light
    inline = isinstance(light, Shader) and light.shading.inline
    return light if inline and not isinstance(pipeline.compositing, Selection) else None


def inline_colors(
    shader: Shader,
    pipeline: Pipeline,
    ray: Ray,
    at: Progress,
    cells: list[Cell],
    colors: list[Vec3],
    alphas: list[Scalar],
) -> list[Vec3]:
    """Shaded colours of a segment's samples; any finite ones for invisible samples."""
    shading, around = shader
    depths = [pipeline.march.sample(cell) for cell in cells]
    terms = _terms(shader, ray, at, depths, alphas)

    def one(place: Place, depth: Scalar, color: Vec3, term: PyTree) -> Vec3:
        sample = _sample(place, depth, color)
        return shading.color(sample, shading.about(around, sample), term)

    each = jax.vmap(jax.vmap(one), in_axes=(None, 0, 0, 0))
    return [each(_place(ray), *piece) for piece in zip(depths, colors, terms, strict=True)]


def _terms(
    shader: Shader, ray: Ray, at: Progress, depths: list[Scalar], alphas: list[Scalar]
) -> list[PyTree]:
    """The terms of visible samples, arrays (cells, rays); zeros or those of other samples for others."""
    shading, around = shader
    size = ROW if ray.length.size % ROW == 0 else 1

    def rows(leaf: Array) -> Array:
        return leaf.reshape(*leaf.shape[:-1], -1, size)

    def one(place: Place, depth: Scalar) -> PyTree:
        sample = _sample(place, depth, (jnp.zeros_like(depth),) * 3)
        return shading.term(around, sample, shading.about(around, sample), jnp.zeros((), jnp.int32))

    every = jnp.concatenate(depths)
    firsts = jnp.arange(every.shape[0]) * every.shape[1]
    visible = jnp.concatenate(alphas) > 0
    chosen = Chosen.of(
        [(jnp.any(rows(visible), axis=(0, 2)) & ~jnp.all(rows(at.finished), axis=1))[None]], CHUNK
    )

    def add(indices: Int[Array, " chunk"], state: tuple[Int[Array, ""], PyTree]) -> PyTree:
        begin, found = state

        lanes = (jnp.minimum(indices, chosen.columns - 1)[:, None] * size + jnp.arange(size)).reshape(-1)

        def taken(place: Place, depth: Scalar) -> Any:
            of_rays = jax.tree.map(lambda leaf: gather(leaf, lanes), place)
            return of_rays, gather(depth.reshape(-1), firsts[:, None] + lanes[None])

        here = in_memory(begin >= 0, taken, _place(ray), every)
        # a kernel of its own: one that writes into part of an array runs on one thread
        term = in_memory(begin >= 0, jax.vmap(jax.vmap(one), in_axes=(None, 0)), *here)
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=begin * size, axis=1)
        return begin + indices.size, jax.tree.map(put, found, term)

    shapes = jax.eval_shape(one, *jax.tree.map(lambda leaf: leaf[0], (_place(ray), depths[0][0])))
    none = jax.tree.map(
        lambda leaf: jnp.zeros((every.shape[0], chosen.indices.size * size), leaf.dtype), shapes
    )
    _, found = chosen.fold(add, (jnp.zeros((), jnp.int32), none))
    whose = (chosen.ranks[:, None] * size + jnp.arange(size)).reshape(-1)
    begins = jnp.arange(every.shape[0])[:, None] * chosen.indices.size * size
    terms = jax.tree.map(lambda leaf: gather(leaf.reshape(-1), begins + whose[None]), found)
    split = [slice(i * len(depth), (i + 1) * len(depth)) for i, depth in enumerate(depths)]
    return [jax.tree.map(lambda leaf, part=part: leaf[part], terms) for part in split]


def _place(ray: Ray) -> Place:
    return ray.entry, ray.direction, ray.pixel


def _sample(place: Place, depth: Scalar, color: Vec3) -> Sample:
    entry, direction, pixel = place
    zero = jnp.zeros_like(depth)
    return Sample(along(entry, direction, depth), direction, (), color, zero, zero + 1, pixel)
