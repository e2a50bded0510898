"""Marches an image through one part of a volume after the other.

A volume that does not fit into memory is marched part by part. Of each ray, it is kept where it has come to;
each part marches those cells of it that lie there (`CellRange`), from where the part before it left off. What
is made of voxels, the packed copy, ranges of blocks and windows, is made of each part.
"""

from dataclasses import replace
from functools import partial, reduce

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..march.march import March
from ..ray import Pipeline, Progress, begin, end, front, stopped
from ..scene.rendering import Rendering
from ..scene.space import Ray
from .acceleration import VolumeAcceleration, empty_space_of
from .batch import Beams, CellRange, with_fields
from .devices import on_devices
from .image import RenderOptions, fault_of, pipeline_of
from .rays import RayTiles, vmap_rays
from .resolve import resolve_pixels
from .scene import Scene
from .wavefront import march_rays


NOTHING = VolumeAcceleration(None, None, None, None)


class Underway(eqx.Module):
    """The rays of an image, and where they have come to, (tiles, groups, rays in a group)."""

    rays: Ray
    at: Progress


@on_devices("dealt")
def set_out(scene: Scene, options: RenderOptions) -> Underway:
    """All rays at their entries. Of the volume, no voxel is read."""
    tiles, fault = RayTiles.of(scene.source, options.tiling), fault_of(scene)
    space, pipeline = pipeline_of(scene._replace(lighting=None), NOTHING)

    def one(each: tuple[Int[Array, ""]]) -> Underway:
        rays = tiles.rays(scene.source, space, each[0], fault)
        at = vmap_rays(lambda ray: begin(pipeline, ray, options.outputs))(rays)
        return Underway(rays, with_fields(at, finished=rays.length <= 0))

    return tiles.map(one)


@on_devices("dealt", dealt=("underway", "ranges"))
def march_part(
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    underway: Underway,
    ranges: CellRange,
    anew: bool = False,
    exact: bool = False,
) -> Underway:
    """The rays behind these of their cells. `scene`: with a part of the volume, which holds what they meet
    there, and in a segment more. `exact`: they take no cell behind these. `anew`: nor does it count whether
    they have come to the first of these, or past it: all of them are marched."""
    tiles, packed = RayTiles.of(scene.source, options.tiling), acceleration.packed(scene)
    index = empty_space_of(packed, acceleration, options.tiling)
    _, pipeline = pipeline_of(packed, acceleration)

    def one(each: tuple[Int[Array, ""], Underway, CellRange]) -> Underway:
        number, (rays, at), range_ = each[0], (each[1].rays, each[1].at), each[2]
        beams = Beams(rays, tiles.beam_count, tiles.box(scene.source, rays, number), range_)
        start = at
        if anew:
            seen = opaque(pipeline, at) | (range_.until <= range_.first)
            start = with_fields(at, index=range_.first, finished=seen)
        after, _ = march_rays(
            pipeline, index, beams, options.tiling, options.outputs, resumed=start, exact=anew or exact
        )
        # where marched anew, a ray may go back
        over = opaque(pipeline, after) if anew else at.finished | ended(pipeline, rays, after)
        return Underway(rays, with_fields(after, finished=over))

    return tiles.map(one, underway, ranges)


def ended(pipeline: Pipeline, rays: Ray, at: Progress) -> Bool[Array, "groups rays"]:
    """Which rays need no other cell, wherever it lies."""
    past = vmap_rays(lambda ray, at: front(pipeline.march, at) >= ray.length)(rays, at)
    return past | opaque(pipeline, at)


def opaque(pipeline: Pipeline, at: Progress) -> Bool[Array, "groups rays"]:
    """Which rays are stopped by what lies in front."""
    return vmap_rays(partial(stopped, pipeline))(at.composite)


@on_devices("whole", dealt=("before", "after"))
def resolve_part(
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    march: March,
    before: Progress,
    after: Underway,
    pixels: Array | None,
) -> Array:
    """Pixels of a mode that chooses a sample: computed anew, from this part of the volume, where another one
    was chosen in it than `before`. `march`: of the rays."""
    tiles = RayTiles.of(scene.source, options.tiling)
    rendering = _assembled(scene, march, tiles, after)
    changed = jnp.zeros(after.rays.length.shape, bool)
    for old, new in zip(jax.tree.leaves(before.composite), jax.tree.leaves(after.at.composite), strict=True):
        changed |= old != new
    changed = tiles.assemble(changed)
    rgba = rendering.rgba * changed[..., None].astype(rendering.rgba.dtype)
    found = rgba, rendering.depth, rendering.details.selected
    resolved = resolve_pixels(scene, options, acceleration, found)
    return resolved if pixels is None else jnp.where(changed[..., None], resolved, pixels)


def _assembled(scene: Scene, march: March, tiles: RayTiles, underway: Underway) -> Rendering:
    _, pipeline = pipeline_of(scene._replace(march=march, lighting=None), NOTHING)
    renderings = jax.vmap(vmap_rays(partial(end, pipeline)))(underway.rays, underway.at)
    return jax.tree.map(tiles.assemble, renderings)


def joined(scene: Scene, parts: Underway) -> Underway:
    """Rays that have passed all parts of a volume, from several that were each marched through some of them,
    front to back, and from a beginning of their own: along the first axis. Where a ray was stopped in front,
    it does not show what is behind."""
    _, pipeline = pipeline_of(scene._replace(lighting=None), NOTHING)

    def join(front: Progress, back: Progress) -> Progress:
        both = replace(
            front,
            index=jnp.maximum(front.index, back.index),
            composite=scene.compositing.joined(front.composite, back.composite),
            finished=front.finished & back.finished,
        )
        if front.stats is not None and back.stats is not None:
            samples, aligned = (
                front.stats.samples + back.stats.samples,
                front.stats.aligned | back.stats.aligned,
            )
            both = replace(both, stats=replace(front.stats, samples=samples, aligned=aligned))
        stops = stopped(pipeline, front.composite)
        return jax.tree.map(lambda a, b: jnp.where(stops, a, b), front, both)

    # a ray that met nothing here, or all that it may, is not held up here
    over = parts.at.finished | (parts.at.index < scene.march.most_samples)
    at = with_fields(parts.at, finished=over)
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], at) for i in range(over.shape[0])]
    return Underway(jax.tree.map(lambda leaf: leaf[0], parts.rays), reduce(jax.vmap(vmap_rays(join)), each))


@on_devices("whole", dealt=("underway",))
def arrive(scene: Scene, options: RenderOptions, underway: Underway) -> Rendering:
    """The image of rays that have passed all parts."""
    at = underway.at
    # nothing lies behind the last part, whether or not a ray went on to its end
    over = at.finished | (at.index < scene.march.most_samples)
    underway = Underway(underway.rays, with_fields(at, finished=over))
    return _assembled(scene, scene.march, RayTiles.of(scene.source, options.tiling), underway)
