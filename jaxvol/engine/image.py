"""Marches all rays of an image, tile by tile."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.sharding import varying
from ..lighting.shading import classification
from ..reference import begin, end, has_fault, step
from ..rendering import Outputs, Rendering
from ..space import Ray, Space, invalid
from .acceleration import Scene, VolumeAcceleration, empty_space_of
from .batch import Beams, CellRange
from .packing import with_words
from .replay import VisibleRangeRecorder
from .shading import shade_pixels
from .tiles import RayTiles, line, vmap_rays
from .tiling import Tiling
from .wavefront import march_rays


class RenderOptions(eqx.Module):
    """What is computed, and how work is divided."""

    outputs: Outputs = eqx.field(static=True)
    tiling: Tiling = eqx.field(static=True)


def march_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, *, record: bool = False
) -> tuple[Rendering, CellRange | None]:
    """The image, by the fast engine; and, to `record`, each ray's visible cells, where rays leap."""
    volume, transfer, source, march, lighting = scene
    tiling = options.tiling
    tiles = RayTiles.of(source, tiling)
    volume = with_words(volume, acceleration.words)
    index = empty_space_of((volume, transfer, source, march, None), acceleration, tiling)
    space = march.locate(volume)
    seen = classification(volume, transfer, space, lighting)

    def marched(tile: Int[Array, ""], rays: Ray) -> tuple[Rendering, CellRange | None]:
        beams = Beams(rays, tiles.beams, tiles.box(source, rays, tile))
        recorder = VisibleRangeRecorder(rays.length.shape) if record and index is not None else None
        at, (ranges, *_) = march_rays(march, volume, seen, index, beams, tiling, options.outputs, recorder)
        return vmap_rays(end)(rays, at), ranges

    return _over_tiles(scene, space, tiles, marched)


def scan_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, length: int
) -> Rendering:
    """The image, by `length` steps of the reference engine along each ray, which JAX can differentiate."""
    volume, transfer, source, march, lighting = scene
    tiles = RayTiles.of(source, options.tiling, direct=True)
    volume = with_words(volume, acceleration.words)
    space = march.locate(volume)
    seen = classification(volume, transfer, space, lighting)

    def scanned(_: Int[Array, ""], rays: Ray) -> Rendering:
        one = vmap_rays(lambda ray, at: step(march, ray, volume, seen, at))
        start = varying(vmap_rays(lambda ray: begin(march, ray, options.outputs))(rays), rays)
        at, _ = jax.lax.scan(lambda at, none: (one(rays, at), none), start, None, length=length)
        return vmap_rays(end)(rays, at)

    return _over_tiles(scene, space, tiles, lambda tile, rays: (scanned(tile, rays), None))[0]


def _over_tiles(
    scene: Scene, space: Space, tiles: RayTiles, one: Callable[[Int[Array, ""], Ray], tuple[Rendering, Any]]
) -> tuple[Rendering, Any]:
    """`one` of the rays of each tile in turn, with the renderings assembled to an image."""
    volume, transfer, source, march, lighting = scene
    fault = has_fault(volume, transfer, march, lighting)

    def tile(number: Int[Array, ""]) -> tuple[Rendering, Any]:
        return one(number, invalid(tiles.rays(source, space, number), fault))

    renderings, more = jax.lax.map(tile, jnp.arange(tiles.number))
    return jax.tree.map(tiles.assemble, renderings), more


def shade_image(
    scene: Scene,
    acceleration: VolumeAcceleration,
    rgba: Float[Array, "*rays 4"],
    depth: Float[Array, "*rays"],
) -> Float[Array, "*rays 4"]:
    """The image as shaded by a lighting for which `shades_pixels` holds."""
    volume, transfer, source, march, lighting = scene
    assert lighting is not None
    volume, space = with_words(volume, acceleration.words), march.locate(volume)
    seen = classification(volume, transfer, space, lighting)
    shaded = shade_pixels(lighting, seen, space, partial(line, source), rgba, depth)
    return shaded * jnp.where(has_fault(volume, transfer, march, lighting), jnp.nan, 1).astype(shaded.dtype)
