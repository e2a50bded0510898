"""Renders a volume that need not fit into memory, brick by brick."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from .._util.checks import Arrayable, described, integer
from .._util.memory import memory_of_device
from ..compositing.blending import Compositing
from ..compositing.modes import Mode, compositing_of
from ..compositing.selection import Selection
from ..engine import brick_march
from ..engine.acceleration import NO_ACCELERATION, VolumeAcceleration
from ..engine.devices import Devices, mesh_of, on_all
from ..engine.image import RenderOutputs
from ..engine.resolve import resolve_image, with_pixels
from ..engine.tiling import RenderOptions
from ..lighting.shading import Lighting
from ..march.march import March
from ..march.transforms.space_leaping import SpaceLeaping
from ..march.transforms.toroidal_map import ToroidalMap
from ..ray import Scene, bands_of, check_arguments
from ..scene.camera import Camera
from ..scene.labels import LabelTransferFunction
from ..scene.occupancy import BLOCK
from ..scene.rendering import Rendering
from ..scene.transfer import Transfer, sized
from ..scene.volume import Volume, part_of
from ..xla.compiling import compiled
from ..xla.platform import is_traced
from ..xla.trees import strong
from .distributed import check_joins, render_distributed
from .opening import Openable, level_for, levels_of
from .sources import VoxelSource
from .traversal import METHODS, Method, Request, Traversal


def render_bricks(
    source: Openable,
    transfer: Transfer,
    camera: Camera,
    march: March,
    *,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    memory: int | None = None,
    bricks: Sequence[int] | None = None,
    method: Method = "overlap",
    compositing: Mode | Compositing[Any] = "over",
    lighting: Lighting | None = None,
    outputs: RenderOutputs = "all",
    level: int | Literal["auto"] = "auto",
    progress: Callable[[int, int], object] | None = None,
    devices: Devices | None = None,
    **options: Any,
) -> Rendering:
    """Renders an image of a volume that need not fit into memory: on disk, or in the memory of the host.

    The volume is split into bricks, which are read, rendered and dropped front to back, while the next one is
    read. Bricks in which nothing is visible, outside of the view, or hidden by opaque material are not read.
    The image is that of `render`, for any bricks: in float32, colours, opacity and the components of a normal
    agree to 2e-5, and depth to a relative 1e-6 (3e-5 for `Maximum` under a transfer function that rises
    within an eightieth of the values). `samples` and `error` may differ, and `exhausted` if `max_samples` is
    too small.

    Args:
        source: see `bricks.levels_of`. The first image takes one pass over all voxels to find their ranges. A
            `bricks.VoxelSource` keeps the ranges for later images: open it once, by `bricks.source_of`.
        transfer: as for `render`.
        camera: as for `render`.
        march: as for `render`, without `SpaceLeaping("min_distance")` and with the default `block`.
        spacing: as in `Volume`; by default that of the source.
        origin: as in `Volume`; by default that of the source.
        memory: bytes for the rendered brick and the next one, with derived arrays; by default a quarter of
            the device's. An image takes some 550 bytes for each pixel in addition, and compiled programs some
            300 MiB.
        bricks: number of bricks along x, y and z, at most 65 536 in all; these may exceed `memory`. An axis
            of too few voxels has fewer. By default the fewest bricks that fit into `memory`.
        method: treatment of curved rays (`ToroidalMap`), which may come back to a brick. `"overlap"`: bricks
            are read with a margin, so that each is read once, if `memory` suffices. `"reload"`: bricks are
            read again. A function: a custom schedule (`bricks.traversal.Schedule`).
        compositing: as for `render`.
        lighting: `Phong`, `ScattererTemplates` as published, or any lighting with a finite
            `Lighting.farthest_read`.
        outputs: as for `render`.
        level: index of a level of detail, or `"auto"`: the coarsest level whose voxels are no larger than a
            pixel (`bricks.level_for`); under a `ToroidalMap` the finest, 0.
        progress: called after each brick with the number of bricks rendered so far and the number of bricks
            with visible blocks. Some of these may be hidden, or be read again.
        devices: as for `render`, with `memory` bytes each. Bricks are distributed over the devices instead of
            rays: a device reads its bricks, marches all rays through them, and the partial images are joined
            front to back. This needs rays that are straight in the grid, compositing by `"over"`, and no
            `EmptySpaceJitter`. `EarlyTermination` acts per device: up to `opacity_left` of the colours behind
            are added, and depth changes with them; without it, depth agrees to a relative 1e-5.
        **options: of the source (`shape`, `dtype`, `time`, `channel`, `nan`), see `bricks.levels_of`.

    Returns:
        As `render`; `Rendering.bricks` reports the bricks that were read.

    Raises:
        ValueError: naming the argument, as `render`; for a source that is truncated, damaged or unknown, or
            whose file changed; if the smallest bricks exceed `memory`; for features that need the complete
            volume (labels, light by transport); and for scenes that several devices cannot render.

    There are no gradients, `jax.jit` or `jax.vmap`, since the source is read while the function runs. Fit
    with `render` to a copy that fits into memory (`VoxelSource.subsampled`).

    Source: bricks and overlap by Kim, Kwon and Shin 2008, section 3, who left skipping empty bricks by ranges
    of values to future work. Here the overlap follows from the rays of the image; `bricks.overlap_of` is
    their formula. Where it fails: `experiments/stability.py`, "wrong order",
    "overlaps shorter than published".
    """
    if isinstance(source, list | tuple) or isinstance(transfer, list | tuple):
        raise ValueError(
            "source and transfer must be of a single volume; got a list. Several are for render."
        )
    order = "render_bricks(source, transfer, camera, march)"
    check_arguments(order, transfer=transfer, camera=camera, march=march, lighting=lighting)
    words = [("outputs", outputs, get_args(RenderOutputs))]
    words += [] if callable(method) else [("method", method, tuple(METHODS))]
    for name, word, known in words:
        if not isinstance(word, str) or word not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}; got {word!r}.")
    if progress is not None and not callable(progress):
        raise ValueError(f"progress must be a function of two numbers, or None; got {described(progress)}.")
    mesh = mesh_of(devices)
    if is_traced((transfer, camera, march, lighting, spacing, origin)):
        raise ValueError(
            "render_bricks reads its source while it runs, so not inside jax.jit, jax.vmap or jax.grad. "
            "Gradients are those of jv.render, of a copy that fits (VoxelSource.subsampled)."
        )
    levels = levels_of(source, spacing=spacing, origin=origin, **options)
    room = memory_of_device() // 4
    if memory is not None:
        room = integer("memory", memory, 1, otherwise=", a number of bytes")
    chosen = _level(levels, level, camera, march)
    if len(levels) > 1:
        transfer = sized(transfer, levels[0])  # all levels are equally opaque
    scene = on_all(mesh, scene_of(chosen, transfer, camera, march, compositing, lighting))
    request = Request(chosen, room, bricks, method, progress, outputs, mesh)
    if mesh is not None:
        check_joins(scene, method)
    traversal = Traversal(request, scene)
    rendering = _image(scene, traversal)
    details = rendering.details._replace(bricks=traversal.report())
    return Rendering(rendering.rgba, rendering.exhausted, details)


def scene_of(
    source: VoxelSource,
    transfer: Transfer,
    camera: Camera,
    march: March,
    compositing: object,
    lighting: Lighting | None,
) -> Scene:
    """The scene of a source, without its voxels."""
    if isinstance(transfer, LabelTransferFunction):
        raise ValueError("transfer must not be of labels: bricks have no labels. Use jv.render.")
    if any(isinstance(t, SpaceLeaping) and t.method == "min_distance" for t in march.transforms):
        raise ValueError('march: SpaceLeaping("min_distance") needs the whole volume; use "blocks".')
    if march.block_side != BLOCK:
        raise ValueError(
            f"march: SpaceLeaping(block={march.block_side}) needs the whole volume; use {BLOCK}."
        )
    if march.grows:
        name = type(march.overriding("depth")[0]).__name__
        raise ValueError(f"march: {name}.depth: cells of bricks have equal steps. Use jv.render.")
    if lighting is not None and lighting.farthest_read is None:
        raise ValueError(
            "lighting must read up to a finite distance (Lighting.farthest_read); got "
            f"{type(lighting).__name__}, which needs the whole volume. Use jv.render."
        )
    place = source.spacing, source.origin
    volume = Volume(np.zeros((2, 2, 2), source.dtype), *place, direction=source.direction)
    # in the axes' storage order, so that no voxel is moved
    volume = part_of(volume, jnp.zeros(3, jnp.int32), source.shape, source.order)
    bands_of(transfer, volume, lighting)
    return strong(
        Scene(volume, sized(transfer, volume), camera, march, compositing_of(compositing), lighting)
    )


_begin_image, _march_brick = compiled(brick_march.begin_image), compiled(brick_march.march_brick)
_finish_image, _resolve_image = compiled(brick_march.finish_image), compiled(resolve_image)
_resolve_brick = compiled(brick_march.resolve_brick)


def _image(scene: Scene, traversal: Traversal) -> Rendering:
    mode, selects = scene.compositing, isinstance(scene.compositing, Selection)
    request, marched, options = traversal.request, traversal.scene, traversal.options
    if request.mesh is not None:
        return render_distributed(traversal, request.mesh)
    underway, pixels = _begin_image(marched, options), None
    for brick, cells in traversal.bricks(underway.rays, underway.at):
        before, restart = underway.at, callable(request.method)
        underway = _march_brick(*_on(brick, marched, options), underway, cells, restart)
        if selects:
            pixels = _resolve_brick(*_on(brick, scene, options), marched.march, before, underway, pixels)
            jax.block_until_ready(pixels)
        traversal.at = underway.at
        del brick
    rendering = _finish_image(marched, options, underway)
    if not mode.resolves:
        return rendering
    if not selects:
        pixels = _resolve_image(scene, options, NO_ACCELERATION, (rendering.rgba, rendering.depth, None))
    elif pixels is None:  # no brick was read
        shape, bands = rendering.rgba.shape[:-1], bands_of(scene.transfer, scene.volume)
        pixels = jnp.zeros((*shape, bands + 2), rendering.rgba.dtype).at[..., bands + 1].set(jnp.inf)
    return with_pixels(scene, rendering, pixels, request.outputs)


def _on(
    brick: Volume, scene: Scene, options: RenderOptions
) -> tuple[Scene, RenderOptions, VolumeAcceleration]:
    """The scene with a brick of its volume."""
    acceleration = VolumeAcceleration.of(brick, scene.transfer, scene.march, scene.lighting)
    return scene._replace(volume=brick), options, acceleration


def _level(
    levels: tuple[VoxelSource, ...], level: int | Literal["auto"], camera: Camera, march: March
) -> VoxelSource:
    mapped = any(isinstance(transform, ToroidalMap) for transform in march.transforms)
    last = 0 if mapped else len(levels) - 1  # a map's ranges are those of the finest level
    if level != "auto":
        return levels[integer("level", level, 0, last, otherwise=', or "auto"')]
    return levels[level_for(levels, camera) if last else 0]
