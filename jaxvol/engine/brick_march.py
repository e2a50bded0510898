"""Marches an image through the bricks of a volume, one after the other.

The state of each ray is kept between bricks. In a brick, a ray marches the cells within it (`CellRange`),
from its state after the previous brick.
"""

from dataclasses import replace
from functools import partial, reduce

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..compositing.blending import joined
from ..march.march import March
from ..ray import Progress, Scene, by_rules, end, front, stopped
from ..scene.rendering import Rendering
from ..scene.space import Ray
from ..xla.trees import with_fields
from .acceleration import VolumeAcceleration, empty_space_of
from .rays import RayTiles, vmap_rays
from .resolve import resolve_image
from .shifts import begin_rays
from .tiling import RenderOptions
from .wavefront import CellRange, finish_blind, into_range, march_rays


class RayStates(eqx.Module):
    """The rays of an image, and their progress, (tiles, groups, rays in a group)."""

    rays: Ray
    at: Progress


def begin_image(scene: Scene, options: RenderOptions) -> RayStates:
    """The rays of an image at their entries. No voxel is read."""
    tiles, fault = RayTiles.of(scene.source, options.tiling), scene.has_fault
    prepared, tiling = scene._replace(lighting=None).prepared(), options.tiling

    def one(inputs: tuple[Int[Array, ""]]) -> RayStates:
        rays = tiles.rays(scene.source, prepared.space, inputs[0], fault)
        at = begin_rays(scene.march, prepared, rays, tiling, options.outputs, finds_shifts=False)
        return RayStates(rays, at)

    return tiles.map(one)


def march_brick(
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    states: RayStates,
    ranges: CellRange,
    restart: bool = False,
) -> RayStates:
    """Marches each ray through its range. `scene`: a scene with a brick that covers the ranges. `restart`:
    whether rays that are not opaque start at their ranges, regardless of their state."""
    tiles = RayTiles.of(scene.source, options.tiling)
    index = empty_space_of(acceleration.packed(scene), acceleration, options.tiling)
    prepared, shifts = by_rules(acceleration.prepared(scene)), scene.march.may_shift

    def one(inputs: tuple[Int[Array, ""], RayStates, CellRange]) -> RayStates:
        _, states, range_ = inputs
        rays, start = states.rays, states.at
        if restart:
            over = opaque(prepared, start) | (range_.until <= range_.first)
            start = with_fields(start, index=range_.first, finished=over)
        skips = tiles.skips(index, rays, scene.march.step)
        at = into_range(prepared, rays, start, range_, shifts=shifts)
        after = march_rays(prepared, rays, finish_blind(skips, at), tiles.tiling, skips, shifts=shifts).at
        after = eqx.tree_at(lambda at: at.track.until, after, start.track.until)
        # a restarted ray may go back
        over = opaque(prepared, after) if restart else start.finished | ended(prepared, rays, after)
        return RayStates(rays, with_fields(after, finished=over))

    return tiles.map(one, states, ranges)


def ended(scene: Scene, rays: Ray, at: Progress) -> Bool[Array, "groups rays"]:
    """True for rays that need no other cell of any brick."""
    past = vmap_rays(lambda ray, at: front(scene.march, ray, at) >= ray.length)(rays, at)
    return past | opaque(scene, at)


def opaque(scene: Scene, at: Progress) -> Bool[Array, "groups rays"]:
    """True for rays that are stopped by their opacity."""
    return vmap_rays(partial(stopped, scene))(at.composite)


def resolve_brick(
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    march: March,
    before: Progress,
    after: RayStates,
    pixels: Array | None,
) -> Array:
    """Pixels of a mode that selects a sample: `pixels`, recomputed where this brick changed the selected
    sample. `before`: progress before the brick. `march`: the march of the rays."""
    tiles = RayTiles.of(scene.source, options.tiling)
    rendering = _assembled(scene._replace(march=march), tiles, after)
    states = zip(jax.tree.leaves(before.composite), jax.tree.leaves(after.at.composite), strict=True)
    changed = tiles.assemble(jnp.any(jnp.stack([old != new for old, new in states]), axis=0))[..., None]
    marched = jnp.where(changed, rendering.rgba, 0), rendering.depth, rendering.details.selected
    resolved = resolve_image(scene, options, acceleration, marched)
    return resolved if pixels is None else jnp.where(changed, resolved, pixels)


def _assembled(scene: Scene, tiles: RayTiles, states: RayStates) -> Rendering:
    prepared = scene._replace(lighting=None).prepared()
    renderings = jax.vmap(vmap_rays(partial(end, prepared)))(states.rays, states.at)
    return jax.tree.map(tiles.assemble, renderings)


def join_segments(scene: Scene, segments: RayStates) -> RayStates:
    """Combines independently marched segments of rays, front to back along the first axis, to rays that have
    passed all bricks. Segments behind a stopped ray are ignored."""
    prepared = scene._replace(lighting=None).prepared()

    def join(front: Progress, back: Progress) -> Progress:
        stats = None
        if front.stats is not None and back.stats is not None:
            samples = front.stats.samples + back.stats.samples
            stats = replace(front.stats, samples=samples, aligned=front.stats.aligned | back.stats.aligned)
        combined = replace(
            front,
            index=jnp.maximum(front.index, back.index),
            composite=joined(front.composite, back.composite),
            finished=front.finished & back.finished,
            stats=stats,
        )
        stops = stopped(prepared, front.composite)
        return jax.tree.map(lambda a, b: jnp.where(stops, a, b), front, combined)

    at = _passed(scene.march, segments.at)
    parts = [jax.tree.map(lambda leaf, i=i: leaf[i], at) for i in range(at.finished.shape[0])]
    rays = jax.tree.map(lambda leaf: leaf[0], segments.rays)
    return RayStates(rays, reduce(jax.vmap(vmap_rays(join)), parts))


def finish_image(scene: Scene, options: RenderOptions, states: RayStates) -> Rendering:
    """The image of rays that have passed all bricks."""
    states = RayStates(states.rays, _passed(scene.march, states.at))
    return _assembled(scene, RayTiles.of(scene.source, options.tiling), states)


def _passed(march: March, at: Progress) -> Progress:
    """Finishes rays that have passed all bricks, unless they ran out of samples."""
    return with_fields(at, finished=at.finished | (at.index < march.most_samples))
