"""Marches all rays of an image, tile by tile."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Bool, Int

from ..compositing.blending import Outputs
from ..lighting.shading import lit_classification
from ..march import strides
from ..reference import Pipeline, begin, end, has_fault, step
from ..scene.rendering import Rendering
from ..scene.space import Ray, Space
from ..xla.sharding import varying
from .acceleration import VolumeAcceleration, empty_space_of
from .batch import Beams, CellRange, VisibleRangeRecorder
from .devices import on_devices
from .rays import RayTiles, vmap_rays
from .scene import Scene
from .tiling import Tiling
from .wavefront import march_rays


class RenderOptions(eqx.Module):
    """What is computed, and how work is divided."""

    outputs: Outputs = eqx.field(static=True)
    tiling: Tiling = eqx.field(static=True)


@on_devices("both")
def march_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, *, record: bool = False
) -> tuple[Rendering, CellRange | None]:
    """The image, by the fast engine; and, to `record`, each ray's visible cells, where rays leap."""
    tiling = options.tiling
    tiles = RayTiles.of(scene.source, tiling)
    scene = acceleration.packed(scene)
    index = empty_space_of(scene, acceleration, tiling)
    space, pipeline = pipeline_of(scene, acceleration)

    def marched(tile: Int[Array, ""], rays: Ray) -> tuple[Rendering, CellRange | None]:
        beams = Beams(rays, tiles.beam_count, tiles.box(scene.source, rays, tile))
        recorder = VisibleRangeRecorder(rays.length.shape) if record and index is not None else None
        at, (ranges, *_) = march_rays(pipeline, index, beams, tiling, options.outputs, recorder)
        return vmap_rays(partial(end, pipeline))(rays, at), ranges

    return _over_tiles(scene, space, tiles, marched)


@on_devices("whole")
def scan_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, length: int
) -> Rendering:
    """The image, by `length` steps of the reference engine along each ray, which JAX can differentiate."""
    tiles = RayTiles.of(scene.source, options.tiling, direct=True)
    scene = acceleration.packed(scene)
    space, pipeline = pipeline_of(scene, acceleration)

    def scanned(_: Int[Array, ""], rays: Ray) -> Rendering:
        one = vmap_rays(partial(step, pipeline))
        start = varying(vmap_rays(lambda ray: begin(pipeline, ray, options.outputs))(rays), rays)
        at, _ = jax.lax.scan(lambda at, none: (one(rays, at), none), start, None, length=length)
        return vmap_rays(partial(end, pipeline))(rays, at)

    return _over_tiles(scene, space, tiles, lambda tile, rays: (scanned(tile, rays), None))[0]


def pipeline_of(scene: Scene, acceleration: VolumeAcceleration) -> tuple[Space, Pipeline]:
    """The space of the volume, and the pipeline that the scene's rays go through."""
    volume, transfer, _, march, compositing, lighting = scene
    space = march.locate(volume)
    lit = lit_classification(volume, transfer, space, lighting, integrated=march.integrates)
    march = strides.predicted(march, space, acceleration.windows, partial(compositing.variation, transfer))
    return space, Pipeline(march, volume, lit, compositing)


def _over_tiles(
    scene: Scene, space: Space, tiles: RayTiles, one: Callable[[Int[Array, ""], Ray], tuple[Rendering, Any]]
) -> tuple[Rendering, Any]:
    """Calls `one(tile, rays)` for each tile in turn. Returns the renderings, assembled to an image, and what
    else it returned, stacked."""
    fault = fault_of(scene)

    def tile(each: tuple[Int[Array, ""]]) -> tuple[Rendering, Any]:
        return one(each[0], tiles.rays(scene.source, space, each[0], fault))

    renderings, more = tiles.map(tile)
    return jax.tree.map(tiles.assemble, renderings), more


def fault_of(scene: Scene) -> Bool[Array, ""]:
    """Whether a number on which all pixels depend makes them NaN."""
    return has_fault(scene.volume, scene.march, scene.transfer, scene.compositing, scene.lighting)
