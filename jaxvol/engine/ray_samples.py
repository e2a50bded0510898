"""Collects the samples of rays, whose number is static, by a scan that JAX differentiates."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..march.beams import Box, EmptySpaceIndex
from ..ray import Progress, Scene, Track, by_rules
from ..scene.rendering import RaySamples
from ..scene.space import Ray
from ..xla.trees import PyTree
from .tiling import Tiling
from .wavefront import Job, to_next_cell


def scan_samples(
    step: Callable[[Progress], tuple[Progress, RaySamples]],
    leap: Callable[[Progress], Progress],
    rays: Ray,
    start: Progress,
    limit: int,
) -> tuple[Progress, RaySamples]:
    """The rays (groups, rays in a group) after at most `limit` samples and cells, and these samples. A cell
    with more pieces than there is room for is not taken: its ray is not finished."""

    def advance(state: PyTree, _: None) -> tuple[PyTree, RaySamples]:
        at, count = state
        at = leap(at)
        after, cells = step(at)
        total = count + jnp.sum(cells.width > 0, axis=-1, dtype=count.dtype)
        fits = (total <= limit) & (at.index < at.track.until)
        state = jax.tree.map(lambda a, b: jnp.where(fits, a, b), (after, total), (at, count))
        return state, replace(cells, width=jnp.where(fits[..., None], cells.width, 0))

    none = jnp.zeros_like(start.index)
    (at, _), cells = jax.lax.scan(advance, (start, none), None, length=limit)

    def by_ray(leaf: Array) -> Array:
        """Reshapes (cells, groups, rays, pieces, ...) to (groups, rays, samples, ...)."""
        leaf = jnp.moveaxis(leaf, 0, 2)
        return leaf.reshape(*leaf.shape[:2], -1, *leaf.shape[4:])

    depth, width, weight, color = (
        by_ray(leaf) for leaf in (cells.depth, cells.width, cells.weight, cells.color)
    )
    order = jnp.argsort(width <= 0, axis=-1, stable=True)[..., :limit]
    depth, width, weight = (jnp.take_along_axis(leaf, order, -1) for leaf in (depth, width, weight))
    color = jnp.take_along_axis(color, order[..., None], -2)
    counts, exit_ = width > 0, (rays.t_in + rays.length)[..., None]
    fault = jnp.where(jnp.isnan(exit_), exit_, 1).astype(exit_.dtype)  # as the pixel's
    samples = RaySamples(
        jnp.where(counts, depth, exit_),
        width,
        jnp.where(counts, weight, 0) * fault,
        jnp.where(counts[..., None], color, 0),
    )
    return at, samples


def leap_by_ray(
    scene: Scene, tiling: Tiling, index: EmptySpaceIndex | None, rays: Ray, track: Track
) -> Callable[[Progress], Progress]:
    """A function that moves rays (groups, rays in a group) to their next cell that is not proven empty. They
    do not leap in beams, since rays of one group may be far apart."""
    if index is None:
        return lambda at: at

    def flat(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)

    alone = jax.tree.map(lambda leaf: leaf[:, None], flat(rays))
    skips = index.skips(lambda occupancy: Box.around(occupancy, alone), scene.march.step)
    job = Job(by_rules(scene), tiling, (rays, track, None), None, skips, track.shifted is not None)
    numbers = jnp.arange(rays.length.size, dtype=jnp.int32)

    def leap(at: Progress) -> Progress:
        moved = to_next_cell(job, numbers, flat(rays), flat(at))
        return jax.tree.map(lambda leaf, like: leaf.reshape(like.shape), moved, at)

    return leap
