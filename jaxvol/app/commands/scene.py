"""From options to images: what is looked at, how it looks, from where, and by which march."""

import argparse
from collections.abc import Callable, Sequence
from os.path import realpath  # unlike `Path.resolve`, it raises nothing for links in a circle
from typing import Any, NamedTuple

import jax
import numpy as np

from ...bricks import VoxelSource, levels_of, render_bricks
from ...compositing.blending import Compositing, Over
from ...compositing.isosurface import Isosurface
from ...compositing.modes import MODES, compositing_of
from ...fitting import read_transfer
from ...io.formats import files_of, load
from ...lighting import Lighting, Phong
from ...march.march import March, Transform
from ...march.transforms import AlphaCorrection, Clip, EarlyTermination, SpaceLeaping
from ...planning import Plan, plan
from ...planning.memory import IN_MEMORY
from ...render import PLANNED, render
from ...scene.camera import Camera
from ...scene.presets import SHADED, colormap, preset
from ...scene.rendering import Rendering
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from ..automatic import SAMPLED, automatic_transfer, labels_shown, stride_of, transfer_by_copy
from ..framing import FRONT, framed, visible_points


FAST = SpaceLeaping(), AlphaCorrection(), EarlyTermination()  # of a march whose step is given


class Scene(NamedTuple):
    """What is looked at, and how. Of a volume that is read in bricks from `source`, with so many bytes of
    memory, `volume` is a copy of every n-th voxel in the same place. `march`: a `March`, once it is known."""

    volume: Volume
    transfer: Transfer
    camera: Camera
    compositing: Compositing[Any]
    lighting: Lighting | None
    background: tuple[float, float, float]
    clip: tuple[Transform, ...]
    source: VoxelSource | None
    memory: int | None
    march: Any = None

    def render(self, camera: Camera) -> Rendering:
        """An image by `march`."""
        how = {"compositing": self.compositing, "lighting": self.lighting}
        if self.source is None:
            found = render(self.volume, self.transfer, camera, self.march, **how)
        else:
            how["memory"] = self.memory
            found = render_bricks(self.source, self.transfer, camera, self.march, **how)
        return jax.block_until_ready(found)

    def plans(self, cameras: Sequence[Camera], tolerance: float | None) -> list[Plan]:
        """The cheapest way to render the scene within a tolerance, for each camera."""
        what: Any = self.volume if self.source is None else self.source
        how: dict[str, Any] = {"transforms": self.clip, "once": len(cameras) == 1}
        how |= {"compositing": self.compositing, "lighting": self.lighting}
        if self.source is not None:
            how["memory"] = self.memory
        tolerance = PLANNED if tolerance is None else tolerance
        return [plan(what, self.transfer, camera, tolerance, **how) for camera in cameras]


def scene_of(
    options: argparse.Namespace, orbit: Callable[[Camera], Sequence[Camera]] = lambda camera: [camera]
) -> Scene:
    """The scene that the options describe, without a march.

    Args:
        options: of a command that has those of `add_scene`.
        orbit: the views of a camera that turns, in which the automatic camera shows all that is visible.
    """
    is_surface, background = options.compositing == "isosurface", background_of(options)
    if is_surface == (options.isovalue is None):
        raise ValueError("--compositing isosurface and --isovalue VALUE go together; one is missing.")
    mode = Isosurface(options.isovalue) if is_surface else compositing_of(options.compositing)
    clip: tuple[Transform, ...] = ()
    planes = [(plane[:3], plane[3:]) for plane in options.clip_plane]
    if options.clip_box is not None or planes:
        clip = (Clip(options.clip_box, planes, inside_out=options.clip_inside_out),)
    elif options.clip_inside_out:
        raise ValueError("--clip-inside-out goes with --clip-box or --clip-plane.")

    automatic, source = is_automatic(options), None
    if options.memory is None:
        volume = volume_of(options)
        shown = (labels_shown(volume) if automatic else None) or (volume, transfer_of(options, volume))
        volume, transfer = shown
    else:
        header = {name: value for name, value in header_of(options).items() if value is not None}
        if index := {name[0]: header.pop(name) for name in ("time", "channel") if name in header}:
            header["index"] = index
        try:
            source = levels_of(options.file, **header)[0]
        except TypeError as fault:  # such as a shape of what is no raw file
            raise ValueError(f"{', '.join(header)}: not for {options.file} ({fault}).") from fault
        volume = copy_of(source, options.memory)
        transfer = _transfer_of_bricks(volume, source) if automatic else transfer_of(options, volume, source)

    size, view = tuple(options.size), (options.view_up, options.view_angle)
    if options.camera:
        camera = Camera(options.camera[:3], options.camera[3:], *view, size=size)
    else:
        side = options.direction or FRONT
        camera = Camera.looking_at(volume, side, *view, parallel=options.parallel, size=size)
        if automatic:
            camera = framed(camera, visible_points(volume, transfer), orbit(camera))
    camera, lighting = camera.zoom(options.zoom), _lighting(options, mode)
    return Scene(volume, transfer, camera, mode, lighting, background, clip, source, options.memory)


def with_march(scene: Scene, options: argparse.Namespace, cameras: Sequence[Camera]) -> Scene:
    """The scene with the given step; without one, with the shortest of those planned for the cameras."""
    if options.step is not None:
        return scene._replace(march=March(options.step, (*scene.clip, *FAST), "midpoint"))
    found = min(scene.plans(cameras, options.tolerance), key=lambda plan: float(plan.march.step))
    if not found.within:
        print(f"not proven to be within an RMSE of {found.tolerance:.2g}; jaxvol plan tells more")
    source = None if found.bricks is None else found.source
    return scene._replace(volume=found.volume, march=found.march, source=source)


def volume_of(options: argparse.Namespace) -> Volume:
    return load(options.file, **header_of(options))


def header_of(options: argparse.Namespace) -> dict[str, Any]:
    """What the options say of the file."""
    return {name: getattr(options, name) for name in ("shape", "dtype", "spacing", "nan", "time", "channel")}


def refuse_to_replace(options: argparse.Namespace, *names: str) -> None:
    """Refuse to write a file (an option of these names) that is the volume, one of its slices, or another."""
    used = [options.file, *(files_of(options.file) if options.file.is_dir() else [])]
    for name in names:
        path = getattr(options, name)
        if path is not None and realpath(path) in map(realpath, used):
            raise ValueError(f"--{name}: {path} is the volume, or written by another option; write another.")
        used += [] if path is None else [path]


def is_automatic(options: argparse.Namespace) -> bool:
    """Whether nothing is said of the transfer function."""
    names = ("preset", "cmap", "transfer", "recorded_transfer", "clim", "unit_distance")
    return options.compositing == "over" and all(getattr(options, name) is None for name in names)


def background_of(options: argparse.Namespace) -> tuple[float, float, float]:
    """Linear RGB. The greater values of projections are lighter: on white, the greatest would be hidden."""
    if options.background is None:
        level = 0.0 if options.compositing in MODES.keys() - {"over"} else 1.0
        return level, level, level
    red, green, blue = options.background
    if not all(0 <= each <= 1 for each in options.background):
        got = f"{red:g} {green:g} {blue:g}"
        raise ValueError(f"--background must be three numbers from 0 to 1 (linear RGB); got {got}.")
    return red, green, blue


def transfer_of(options: argparse.Namespace, volume: Volume, source: VoxelSource | None = None) -> Transfer:
    """The transfer function that the options ask for. `source`: of which `volume` is a copy with fewer
    voxels."""
    if is_automatic(options):
        return automatic_transfer(volume)
    if options.recorded_transfer is not None:
        return options.recorded_transfer
    if options.transfer is not None:
        return read_transfer(options.transfer)
    unit = options.unit_distance
    if options.preset is not None:
        return preset(options.preset, options.clim, 1.0 if unit is None else unit)
    clim = options.clim or (float(volume.data.min()), float(volume.data.max()))
    cmap = options.cmap or ("white" if options.compositing == "isosurface" else "gray")
    return colormap(cmap, clim, unit_distance=(source or volume) if unit is None else unit)


def _transfer_of_bricks(copy: Volume, source: VoxelSource) -> Transfer:
    """The automatic one, from a copy and the middle of the volume at full resolution."""
    low = [max(0, (n - 128) // 2) for n in source.shape]
    high = [min(n, begin + 128) for n, begin in zip(source.shape, low, strict=True)]
    return transfer_by_copy(copy, np.asarray(source.read(low, high)))


def _lighting(options: argparse.Namespace, mode: Compositing[Any]) -> Lighting | None:
    """The light that the options ask for, or that is usual for what they show."""
    shade = options.shade
    if shade is None:
        shows_surfaces = options.preset in SHADED or is_automatic(options)
        shade = (shows_surfaces and isinstance(mode, Over)) or isinstance(mode, Isosurface)
    return Phong() if shade else None


def copy_of(source: VoxelSource, memory: int) -> Volume:
    """A copy of every n-th voxel, stretched to the bounds of the whole: of those by which colours are chosen
    for the whole, if they fit into so many bytes, and of fewer if not."""
    most = min(SAMPLED, max(8, memory // (IN_MEMORY * source.dtype.itemsize)))
    copy = source.subsampled(min(stride_of(source.shape, most), min(source.shape) // 2))
    whole = [(n - 1) * s / (m - 1) for n, s, m in zip(source.shape, source.spacing, copy.shape, strict=True)]
    return Volume(copy.data, whole, copy.origin)
