"""From options to images: what is looked at, how it looks, from where, and by which march."""

import argparse
from collections.abc import Callable, Sequence
from os.path import realpath  # unlike `Path.resolve`, it raises nothing for links in a circle
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ..._util.srgb import linear_color
from ...bricks import VoxelSource, levels_of, render_bricks
from ...compositing.blending import Compositing, Over
from ...compositing.isosurface import Isosurface
from ...compositing.modes import MODES, compositing_of
from ...fitting import read_transfer
from ...io.formats import files_of, load
from ...lighting import Lighting, Phong
from ...march.march import March, Transform
from ...march.transforms import AlphaCorrection, Clip, EarlyTermination, EmptySpaceJitter, SpaceLeaping
from ...planning import Plan, plan
from ...planning.memory import IN_MEMORY
from ...render import PLANNED, render
from ...scene.camera import Camera
from ...scene.presets import SHADED, colormap, fitted_range, preset, preset_name
from ...scene.rendering import Rendering
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from ..automatic import (
    SAMPLED,
    automatic_transfer,
    labels_shown,
    sampled,
    stride_of,
    thresholds,
    transfer_by_copy,
)
from ..framing import automatic_camera, framed, upright, visible_points


FAST = SpaceLeaping(), AlphaCorrection(), EarlyTermination()  # of a march whose step is given


class Scene(NamedTuple):
    """What is looked at, and how. Of a volume that is read in bricks from `source`, with so many bytes of
    memory, `volume` is a copy of every n-th voxel in the same place. `others`: volumes in the same image,
    with their transfer functions. `transforms`: those that belong to the scene. `march`: a `March`, once it
    is known. `notes`: what the user should know."""

    volume: Volume
    transfer: Transfer
    camera: Camera
    compositing: Compositing[Any]
    lighting: Lighting | None
    background: tuple[float, float, float]
    transforms: tuple[Transform, ...]
    source: VoxelSource | None = None
    memory: int | None = None
    march: Any = None
    others: tuple[tuple[Volume, Transfer], ...] = ()
    notes: tuple[str, ...] = ()

    def render(self, camera: Camera) -> Rendering:
        """An image by `march`."""
        how = {"compositing": self.compositing, "lighting": self.lighting}
        if self.others:
            volumes, transfers = zip((self.volume, self.transfer), *self.others, strict=True)
            found = render(volumes, transfers, camera, self.march, **how)
        elif self.source is None:
            found = render(self.volume, self.transfer, camera, self.march, **how)
        else:
            how["memory"] = self.memory
            found = render_bricks(self.source, self.transfer, camera, self.march, **how)
        return jax.block_until_ready(found)

    def plans(self, cameras: Sequence[Camera], tolerance: float | None) -> list[Plan]:
        """The cheapest way to render the scene within a tolerance, for each camera."""
        what: Any = self.volume if self.source is None else self.source
        how: dict[str, Any] = {"transforms": self.transforms, "once": len(cameras) == 1}
        how |= {"compositing": self.compositing, "lighting": self.lighting}
        if self.source is not None:
            how["memory"] = self.memory
        tolerance = PLANNED if tolerance is None else tolerance
        return [plan(what, self.transfer, camera, tolerance, **how) for camera in cameras]


def scene_of(options: argparse.Namespace, orbit: Callable[[Camera], Sequence[Camera]] | None = None) -> Scene:
    """The scene that the options describe, without a march.

    Args:
        options: of a command that has those of `add_scene`. `file` may be a `Volume`, `transfer` a
            `Transfer`, and entries of `with` volumes with their transfer functions.
        orbit: the views of a camera that turns, in which the automatic camera shows all that is visible.
    """
    is_surface, background = options.compositing == "isosurface", background_of(options)
    if is_surface == (options.isovalue is None):
        raise ValueError("--compositing isosurface and --isovalue VALUE go together; one is missing.")
    mode = Isosurface(options.isovalue) if is_surface else compositing_of(options.compositing)
    # by jitter, which the aligned last cell belongs to, the rings of wood grain become noise
    transforms: tuple[Transform, ...] = (EmptySpaceJitter(seed=0),)
    planes = [(plane[:3], plane[3:]) for plane in options.clip_plane]
    if options.clip_box is not None or planes:
        transforms = (Clip(options.clip_box, planes, inside_out=options.clip_inside_out), *transforms)
    elif options.clip_inside_out:
        raise ValueError("--clip-inside-out goes with --clip-box or --clip-plane.")

    automatic, source, note, more = is_automatic(options), None, None, vars(options)["with"]
    if options.memory is None:
        volume = volume_of(options)
        transfer, note = (None, None) if automatic else transfer_of(options, volume)
        if automatic or options.labels is not None:
            volume, transfer = labels_shown(volume, transfer) or (volume, transfer)
        transfer = automatic_transfer(volume) if transfer is None else transfer
    else:
        if options.labels is not None or more:
            raise ValueError("--memory reads one volume, without --labels and --with.")
        header = {name: value for name, value in header_of(options).items() if value is not None}
        if index := {name[0]: header.pop(name) for name in ("time", "channel") if name in header}:
            header["index"] = index
        try:
            source = levels_of(options.file, **header)[0]
        except TypeError as fault:  # such as a shape of what is no raw file
            raise ValueError(f"{', '.join(header)}: not for {options.file} ({fault}).") from fault
        volume = copy_of(source, options.memory)
        if automatic:
            transfer = _transfer_of_bricks(volume, source)
        else:
            transfer, note = transfer_of(options, volume, source)

    others = tuple(_other(*each) for each in more)
    lighting = _lighting(options, mode, alone=not others)
    camera = _camera(options, volume, transfer, orbit, automatic=automatic).zoom(options.zoom)
    scene = Scene(volume, transfer, camera, mode, lighting, background, transforms, source, options.memory)
    return scene._replace(others=others, notes=() if note is None else (note,))


def _camera(
    options: argparse.Namespace,
    volume: Volume,
    transfer: Transfer,
    orbit: Callable[[Camera], Sequence[Camera]] | None,
    *,
    automatic: bool,
) -> Camera:
    """That of the options; or else, `automatic`, one as near as what is visible allows, or of all."""
    given = {"view_angle": options.view_angle, "size": options.size}
    if options.camera:
        up = options.view_up or (0.0, 0.0, 1.0)
        return Camera(options.camera[:3], options.camera[3:], up, **given)
    given["parallel"] = options.parallel
    if not automatic:
        side = upright(volume, transfer, options.direction, options.view_up)
        return Camera.looking_at(volume, *side, **given)
    camera = automatic_camera(volume, transfer, options.direction, options.view_up, **given)
    return framed(camera, visible_points(volume, transfer), orbit(camera)) if orbit else camera


def _other(file: str | Volume, *look: Any) -> tuple[Volume, Transfer]:
    """One more volume, a file or a `Volume`, and its transfer function: given, or a colormap ("hot") over LOW
    and HIGH, or over what stands out of the background."""
    volume = file if isinstance(file, Volume) else load(file)
    if look and isinstance(look[0], Transfer):
        return volume, look[0]
    cmap, *clim = look or ("hot",)
    if len(clim) not in (0, 2):
        raise ValueError(
            f"--with takes FILE, FILE CMAP or FILE CMAP LOW HIGH; got {' '.join(map(str, look))}."
        )
    if not clim:
        values = sampled(volume).ravel().astype(np.float32)
        clim = thresholds(values)[0], float(np.percentile(values, 99.9))
    try:
        low, high = map(float, clim)
    except ValueError as fault:
        raise ValueError(f"--with: LOW and HIGH must be numbers; got {' '.join(map(str, clim))}.") from fault
    return volume, colormap(cmap, (low, max(high, float(np.nextafter(np.float32(low), np.inf)))))


def with_march(scene: Scene, options: argparse.Namespace, cameras: Sequence[Camera]) -> Scene:
    """The scene with the given step; without one, with the shortest of those planned for the cameras (of
    several volumes, with half of their shortest spacing)."""
    step = options.step
    if step is None and scene.others:
        step = min(float(np.min(each.spacing)) for each, _ in ((scene.volume, None), *scene.others)) / 2
    if step is not None:
        return scene._replace(march=March(step, (*scene.transforms, *FAST), "midpoint"))
    found = min(scene.plans(cameras, options.tolerance), key=lambda plan: float(plan.march.step))
    source = None if found.bricks is None else found.source
    scene = scene._replace(volume=found.volume, march=found.march, source=source)
    if found.within:
        return scene
    told = f"not proven to be within an RMSE of {found.tolerance:.2g}; jaxvol plan tells more"
    return scene._replace(notes=(*scene.notes, told))


def volume_of(options: argparse.Namespace) -> Volume:
    if isinstance(options.file, Volume):
        return options.file
    return load(options.file, labels=vars(options).get("labels"), **header_of(options))


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
    names = ("preset", "cmap", "transfer", "recorded_transfer", "clim", "window", "level", "unit_distance")
    return options.compositing == "over" and all(getattr(options, name) is None for name in names)


def background_of(options: argparse.Namespace) -> tuple[float, float, float]:
    """Linear RGB. The greater values of projections are lighter: on white, the greatest would be hidden."""
    if options.background is None:
        level = 0.0 if options.compositing in MODES.keys() - {"over"} else 1.0
        return level, level, level
    given = options.background
    given = linear_color("--background", given) if isinstance(given, str) else given
    red, green, blue = np.asarray(given, np.float64).tolist()
    if not all(0 <= each <= 1 for each in (red, green, blue)):
        got = f"{red:g} {green:g} {blue:g}"
        hint = " 8-bit colours are written '#336699'." if max(red, green, blue) > 1 else ""
        raise ValueError(f"--background must be three numbers from 0 to 1 (linear RGB); got {got}.{hint}")
    return red, green, blue


def transfer_of(
    options: argparse.Namespace, volume: Volume, source: VoxelSource | None = None
) -> tuple[Transfer, str | None]:
    """The transfer function that the options ask for, and a word where a preset does not fit. `source`: of
    which `volume` is a copy with fewer voxels."""
    if options.recorded_transfer is not None:
        return options.recorded_transfer, None
    if options.transfer is not None:
        given = options.transfer
        return (read_transfer(given) if isinstance(given, str | Path) else given), None
    unit, clim = options.unit_distance, _clim_of(options)
    if options.preset is not None:
        name, note = preset_name(options.preset), None
        if clim is None:
            values = sampled(volume)
            clim, note = fitted_range(name, float(values.min()), float(np.percentile(values, 99.9)))
        return preset(name, clim, 1.0 if unit is None else unit), note
    data = np.asarray(volume.data)
    clim = clim or (float(data.min()), float(data.max()))
    cmap = options.cmap or ("white" if options.compositing == "isosurface" else "gray")
    return colormap(cmap, clim, unit_distance=(source or volume) if unit is None else unit), None


def _clim_of(options: argparse.Namespace) -> Any:
    """--clim, or what --window and --level say instead."""
    if (options.window is None) != (options.level is None):
        raise ValueError("--window and --level go together; one is missing.")
    if options.window is None:
        return options.clim
    return options.level - options.window / 2, options.level + options.window / 2


def _transfer_of_bricks(copy: Volume, source: VoxelSource) -> Transfer:
    """The automatic one, from a copy and the middle of the volume at full resolution."""
    low = [max(0, (n - 128) // 2) for n in source.shape]
    high = [min(n, begin + 128) for n, begin in zip(source.shape, low, strict=True)]
    return transfer_by_copy(copy, np.asarray(source.read(low, high)))


def _lighting(options: argparse.Namespace, mode: Compositing[Any], *, alone: bool) -> Lighting | None:
    """The light that the options ask for, or that is usual for what they show; none of several volumes."""
    shade = options.shade
    if shade is None:
        shows_surfaces = is_automatic(options) or (options.preset and preset_name(options.preset) in SHADED)
        shade = alone and ((shows_surfaces and isinstance(mode, Over)) or isinstance(mode, Isosurface))
    return Phong() if shade else None


def copy_of(source: VoxelSource, memory: int) -> Volume:
    """A copy of every n-th voxel, stretched to the bounds of the whole: of those by which colours are chosen
    for the whole, if they fit into so many bytes, and of fewer if not."""
    most = min(SAMPLED, max(8, memory // (IN_MEMORY * source.dtype.itemsize)))
    copy = source.subsampled(min(stride_of(source.shape, most), min(source.shape) // 2))
    whole = [(n - 1) * s / (m - 1) for n, s, m in zip(source.shape, source.spacing, copy.shape, strict=True)]
    return Volume(copy.data, whole, copy.origin)
