"""Renders a volume that need not fit into memory, brick by brick."""

from collections.abc import Callable
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
from ..march.transforms import SpaceLeaping, ToroidalMap
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
from .opening import level_for, levels_of
from .sources import VoxelSource
from .traversal import METHODS, Method, Request, Traversal


def render_bricks(
    source: VoxelSource | Volume | str | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    march: March | Any,
    *,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    memory: int | Any | None = None,
    bricks: tuple[int, int, int] | Any | None = None,
    method: Method | Any = "overlap",
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    outputs: RenderOutputs | Any = "all",
    level: int | Literal["auto"] | Any = "auto",
    progress: Callable[[int, int], Any] | Any | None = None,
    devices: Devices | Any | None = None,
    **options: Any,
) -> Rendering:
    """Renders an image of a volume that need not fit into memory: on disk, or in the memory of the host.

    The volume is split into bricks, which are read, rendered and dropped, front to back, while the next one
    is read. A brick that no ray needs is not read: one in which nothing is visible, outside of the view, or
    behind what is opaque. The image is that of `render`, whatever the bricks: in float32, colours, opacity
    and the components of a normal agree to 2e-5, and depth to 1e-6 of itself (by `Maximum`, under a transfer
    function that rises within an eightieth of the values, 3e-5). `samples`, `error`, and `exhausted` where a
    `max_samples` is too small, may differ.

    Args:
        source: see `bricks.levels_of`. One pass over all voxels finds their ranges before the first image. A
            `bricks.VoxelSource` keeps them for the next: open it once, by `bricks.source_of`.
        transfer: as for `render`.
        camera: as for `render`.
        march: as for `render`; all transforms but `SpaceLeaping("min_distance")`, and with the default
            `block`.
        spacing: as in `Volume`; by default what the source says.
        origin: as in `Volume`; by default what the source says.
        memory: bytes for voxels and what is made of them: the brick that is rendered and the next one; by
            default a quarter of the device's. In addition an image takes some 550 bytes for each pixel, and
            compiled programs some 300 MiB.
        bricks: number of bricks along x, y and z, in place of the fewest that fit into `memory`, which these
            may exceed. There are fewer along an axis of too few voxels, and no more than 65 536 in all.
        method: where rays are curved in the grid (`ToroidalMap`), a ray may come back to a brick that it has
            left. `"overlap"`: bricks are read larger than they are, so that each is read once, as far as
            `memory` goes. `"reload"`: bricks are read again. Or a function that chooses the next brick
            (`bricks.traversal.Schedule`).
        compositing: as for `render`.
        lighting: `Phong`, `ScattererTemplates` as published, or another one that says how far it reads
            (`Lighting.farthest_read`).
        outputs: as for `render`.
        level: of a source with several levels of detail, which one, or `"auto"`: the coarsest whose voxels
            are no larger than a pixel (`bricks.level_for`); under a `ToroidalMap` the finest, 0.
        progress: called after each brick, with the numbers of bricks rendered so far and of those that hold
            anything visible, some of which may not be needed, or be read again.
        devices: as for `render`, each of which has `memory`, but bricks are dealt out to them, not rays: each
            reads its own bricks, marches all rays through them, and the partial images are combined front to
            back. Rays must be straight in the grid, and what a ray shows must not depend on what lies in
            front but by its transmittance (no `EmptySpaceJitter`; compositing by `"over"`). An
            `EarlyTermination` sees only what is in front on the same device: up to `opacity_left` of the
            colours behind are added, and depth changes with them; without it, depth agrees to 1e-5 of itself.
        **options: for the source (`shape`, `dtype`, `time`, `channel`, `nan`), see `bricks.levels_of`.

    Returns:
        As `render`, and in `Rendering.bricks` what it took.

    Raises:
        ValueError: naming the argument, as `render`; for a source that is truncated, damaged or unknown, or
            whose file changed; for less memory than the smallest bricks take; for what needs the whole volume
            at once (labels, light by transport); and for what several devices cannot render.

    It has no gradients, since it reads its source while it runs; nor can it be called inside `jax.jit` or
    `jax.vmap`. Fit with `render` to a copy that fits (`VoxelSource.subsampled`).

    Source: bricks and overlap by Kim, Kwon and Shin 2008, section 3; their future work are ranges of values,
    by which empty bricks are not read. Unlike there, how far bricks overlap follows from the rays of the
    image; `bricks.overlap_of` has their formula. Where it fails: `experiments/stability.py`, "wrong order".
    """
    if isinstance(source, list | tuple) or isinstance(transfer, list | tuple):
        raise ValueError(
            "source and transfer must be of a single volume; got a list. Several are for render."
        )
    order = "render_bricks(source, transfer, camera, march)"
    check_arguments(order, transfer=transfer, camera=camera, march=march, lighting=lighting)
    words = [("outputs", outputs, get_args(RenderOutputs))]
    words += [] if callable(method) else [("method", method, tuple(METHODS))]
    for name, given, known in words:
        if not isinstance(given, str) or given not in known:
            raise ValueError(f"{name} must be one of {', '.join(known)}; got {given!r}.")
    if progress is not None and not callable(progress):
        raise ValueError(f"progress must be a function of two numbers, or None; got {described(progress)}.")
    mesh = mesh_of(devices)
    if is_traced((transfer, camera, march, lighting, spacing, origin)):
        raise ValueError(
            "render_bricks reads its source while it runs, so not inside jax.jit, jax.vmap or jax.grad. "
            "Gradients are those of jv.render, of a copy that fits (VoxelSource.subsampled)."
        )
    levels = levels_of(source, spacing=spacing, origin=origin, **options)
    room, chosen = budget(memory), _level(levels, level, camera, march)
    if len(levels) > 1:
        transfer = sized(transfer, levels[0])  # so that all levels are equally opaque
    scene = on_all(mesh, scene_of(chosen, transfer, camera, march, compositing, lighting))
    request = Request(chosen, room, bricks, method, progress, outputs, mesh)
    if mesh is not None:
        check_joins(scene, method)
    traversal = Traversal(request, scene)
    rendering = _image(scene, traversal)
    details = rendering.details._replace(bricks=traversal.report())
    return Rendering(rendering.rgba, rendering.exhausted, details)


def budget(memory: int | Any | None) -> int:
    """Bytes that bricks may take: by default a quarter of the device's memory."""
    if memory is None:
        return memory_of_device() // 4
    return integer("memory", memory, 1, otherwise=", a number of bytes")


def scene_of(
    source: VoxelSource,
    transfer: Transfer,
    camera: Camera,
    march: March,
    compositing: Mode | Compositing[Any] | Any,
    lighting: Lighting | None,
) -> Scene:
    """The scene of a source, without its voxels."""
    if isinstance(transfer, LabelTransferFunction):
        raise ValueError("transfer must be of values: bricks have no labels, which jv.render shows.")
    if any(isinstance(t, SpaceLeaping) and t.method == "min_distance" for t in march.transforms):
        raise ValueError('march: SpaceLeaping("min_distance") needs the whole volume; use "hierarchy".')
    if march.block_side != BLOCK:
        raise ValueError(
            f"march: SpaceLeaping(block={march.block_side}) needs the whole volume; use {BLOCK}."
        )
    if lighting is not None and lighting.farthest_read is None:
        needs = f"{type(lighting).__name__}, which needs the whole volume"
        raise ValueError(f"lighting must say how far it reads (Lighting.farthest_read); got {needs}.")
    place = source.spacing, source.origin
    volume = Volume(np.zeros((2, 2, 2), source.dtype), *place, direction=source.direction)
    # its voxels are kept as they are stored, so that none is moved
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
    levels: tuple[VoxelSource, ...], level: int | Literal["auto"] | Any, camera: Camera, march: March
) -> VoxelSource:
    mapped = any(isinstance(transform, ToroidalMap) for transform in march.transforms)
    most = 0 if mapped else len(levels) - 1  # a map's ranges are those of the finest level
    if level != "auto":
        return levels[integer("level", level, 0, most, otherwise=', or "auto"')]
    return levels[level_for(levels, camera) if most else 0]
