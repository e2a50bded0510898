"""Marches an image through one brick of a volume after the other, and pulls it back in a second march.

Of each ray, it is kept where it has come to; in each brick it marches those of its cells that lie there
(`CellRange`), from where the brick before left off.
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
from .wavefront import CellRange, blinded, into_range, march_rays


class RayStates(eqx.Module):
    """The rays of an image, and where they have come to, (tiles, groups, rays in a group)."""

    rays: Ray
    at: Progress


def begin_image(scene: Scene, options: RenderOptions) -> RayStates:
    """All rays at their entries. Of the volume, no voxel is read."""
    tiles, fault = RayTiles.of(scene.source, options.tiling), scene.has_fault
    prepared, tiling = scene._replace(lighting=None).prepared(), options.tiling

    def one(each: tuple[Int[Array, ""]]) -> RayStates:
        rays = tiles.rays(scene.source, prepared.space, each[0], fault)
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
    """Marches each ray through `ranges`. `scene`: with a brick of the volume, which holds what rays meet
    there. `restart`: from where their ranges begin, unless they are opaque."""
    tiles = RayTiles.of(scene.source, options.tiling)
    index = empty_space_of(acceleration.packed(scene), acceleration, options.tiling)
    prepared, shifts = by_rules(acceleration.prepared(scene)), scene.march.may_shift

    def one(each: tuple[Int[Array, ""], RayStates, CellRange]) -> RayStates:
        _, states, range_ = each
        rays, start = states.rays, states.at
        if restart:
            over = opaque(prepared, start) | (range_.until <= range_.first)
            start = with_fields(start, index=range_.first, finished=over)
        skips = tiles.skips(index, rays, scene.march.step)
        here = into_range(prepared, rays, start, range_, shifts=shifts)
        after = march_rays(prepared, rays, blinded(skips, here), tiles.tiling, skips, shifts=shifts).at
        after = eqx.tree_at(lambda at: at.track.until, after, start.track.until)
        # where it was restarted, a ray may go back
        over = opaque(prepared, after) if restart else start.finished | ended(prepared, rays, after)
        return RayStates(rays, with_fields(after, finished=over))

    return tiles.map(one, states, ranges)


def ended(scene: Scene, rays: Ray, at: Progress) -> Bool[Array, "groups rays"]:
    """Which rays need no other cell, wherever it lies."""
    past = vmap_rays(lambda ray, at: front(scene.march, at) >= ray.length)(rays, at)
    return past | opaque(scene, at)


def opaque(scene: Scene, at: Progress) -> Bool[Array, "groups rays"]:
    """Which rays are stopped by what lies in front."""
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
    """Pixels of a mode that chooses a sample: `pixels`, computed again from this brick where it holds another
    sample than the one chosen `before`. `march`: of the rays."""
    tiles = RayTiles.of(scene.source, options.tiling)
    rendering = _assembled(scene._replace(march=march), tiles, after)
    states = zip(jax.tree.leaves(before.composite), jax.tree.leaves(after.at.composite), strict=True)
    changed = tiles.assemble(jnp.any(jnp.stack([old != new for old, new in states]), axis=0))[..., None]
    found = jnp.where(changed, rendering.rgba, 0), rendering.depth, rendering.details.selected
    resolved = resolve_image(scene, options, acceleration, found)
    return resolved if pixels is None else jnp.where(changed, resolved, pixels)


def _assembled(scene: Scene, tiles: RayTiles, states: RayStates) -> Rendering:
    prepared = scene._replace(lighting=None).prepared()
    renderings = jax.vmap(vmap_rays(partial(end, prepared)))(states.rays, states.at)
    return jax.tree.map(tiles.assemble, renderings)


def join_segments(scene: Scene, segments: RayStates) -> RayStates:
    """Combines independently marched segments of rays, front to back, along the first axis, to rays that have
    passed all bricks. What is behind does not show where a ray was stopped in front."""
    prepared = scene._replace(lighting=None).prepared()

    def join(front: Progress, back: Progress) -> Progress:
        stats = None
        if front.stats is not None and back.stats is not None:
            samples = front.stats.samples + back.stats.samples
            stats = replace(front.stats, samples=samples, aligned=front.stats.aligned | back.stats.aligned)
        both = replace(
            front,
            index=jnp.maximum(front.index, back.index),
            composite=joined(front.composite, back.composite),
            finished=front.finished & back.finished,
            stats=stats,
        )
        stops = stopped(prepared, front.composite)
        return jax.tree.map(lambda a, b: jnp.where(stops, a, b), front, both)

    at = _passed(scene.march, segments.at)
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], at) for i in range(at.finished.shape[0])]
    return RayStates(
        jax.tree.map(lambda leaf: leaf[0], segments.rays), reduce(jax.vmap(vmap_rays(join)), each)
    )


def finish_image(scene: Scene, options: RenderOptions, states: RayStates) -> Rendering:
    """The image of rays that have passed all bricks."""
    states = RayStates(states.rays, _passed(scene.march, states.at))
    return _assembled(scene, RayTiles.of(scene.source, options.tiling), states)


def _passed(march: March, at: Progress) -> Progress:
    """Finishes rays, behind whose last brick nothing lies, unless they ran out of samples."""
    return with_fields(at, finished=at.finished | (at.index < march.most_samples))
