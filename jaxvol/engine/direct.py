"""Images by a static number of reference steps along each ray, a scan that JAX differentiates; and their
samples."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..march.beams import Box, EmptySpaceIndex
from ..march.march import March
from ..ray import Progress, Scene, Track, by_rules, end
from ..reference import step, steps_across
from ..scene.rendering import RaySamples, Rendering
from ..scene.space import Ray
from ..scene.volume import Volume
from ..xla.compiling import compiled
from ..xla.differentiation import nan_derivatives
from ..xla.sharding import varying
from ..xla.trees import PyTree
from .acceleration import VolumeAcceleration, empty_space_of
from .rays import RayTiles, over_tiles, vmap_rays
from .shifts import begin_rays
from .tiling import RenderOptions, Tiling
from .wavefront import Job, to_next_cell


def steps_of(volume: Volume, march: March) -> int:
    """Number of steps for the longest ray: a multiple of 64, which few changes of step alter."""
    return min(-(-steps_across(volume, march) // 64) * 64, march.most_samples)


def scan_image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    """The image by `options.steps` steps along each ray; and, with `options.samples`, the samples of those
    steps, which then do not lie in empty space."""
    tiles = RayTiles.of(scene.source, options.tiling, direct=True)
    scene = nan_derivatives(scene, scene.has_fault)
    prepared = acceleration.prepared(scene)
    index = empty_space_of(scene, acceleration, options.tiling) if options.samples else None

    def scan_tile(_: Int[Array, ""], rays: Ray) -> tuple[Rendering, None]:
        one = vmap_rays(partial(step, prepared))
        start = begin_rays(scene.march, prepared, rays, options.tiling, options.outputs, finds_shifts=False)
        start = varying(start, rays)
        if options.samples:
            leap = leap_by_ray(prepared, options.tiling, index, rays, start.track)
            at, samples = scan_samples(partial(one, rays), leap, rays, start, options.steps or 0)
        else:
            samples = None
            at, _ = jax.lax.scan(lambda at, none: (one(rays, at)[0], none), start, None, length=options.steps)
        rendering = vmap_rays(partial(end, prepared))(rays, at)
        return replace(rendering, details=rendering.details._replace(ray_samples=samples)), None

    return over_tiles(scene, prepared.space, tiles, scan_tile)[0]


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


direct_image = compiled(scan_image, has_jvp=True)
