"""From options, of a command or of `show`, to images: what is looked at, how, from where, by which march."""

import math
import warnings
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._util.checks import described, finite_array, flag, integer, number
from .._util.memory import require_room
from .._util.srgb import linear_color
from .._util.voxels import faces_of
from ..bricks import VoxelSource, levels_of, render_bricks
from ..compositing.blending import Compositing, Over
from ..compositing.isosurface import Isosurface
from ..compositing.modes import MODES, compositing_of
from ..fitting import read_transfer
from ..io.formats import labelled, load
from ..lighting import Lighting, Phong
from ..march.march import March, Transform
from ..march.transforms import AlphaCorrection, Clip, EarlyTermination, EmptySpaceJitter, SpaceLeaping
from ..planning import Plan, plan
from ..render import PLANNED, render
from ..scene.camera import Camera, image_size
from ..scene.presets import SHADED, colormap, fitted_range, preset, preset_name
from ..scene.rendering import Rendering
from ..scene.several import with_others
from ..scene.transfer import Transfer, TransferFunction
from ..scene.volume import Volume
from .automatic import (
    SAMPLED,
    automatic_transfer,
    brightest_mean,
    labels_if_any,
    labels_shown,
    preset_unit,
    range_of_object,
    sampled,
    spread_of,
    stride_of,
    transfer_by_copy,
    unit_of,
    xray_transfer,
)
from .framing import (
    FAINT,
    VISIBLE,
    automatic_camera,
    clipped_points,
    framed,
    visible_points,
    warn_of_distance,
)
from .progress import progress
from .settings import OF_COLORS, header_of


def quick_march(step: Any, transforms: Sequence[Transform] = ()) -> March:
    """Of a step that is given."""
    fast = SpaceLeaping(), AlphaCorrection(), EarlyTermination()
    return March(step, (*transforms, *fast), "midpoint")


PIXEL = 160
"""Bytes that an image takes for each pixel, while it is rendered and written."""

IN_MEMORY = 9
"""Most bytes of `render` for each byte of voxels: on host and device, packed, and the blocks' ranges."""


class Scene(NamedTuple):
    """What is looked at. `volume` is a coarser copy of `source`, if that is read in bricks of `memory` bytes.
    `others`: further volumes, with their transfer functions. `march`: once it is known."""

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

    @property
    def coarser(self) -> float:
        """How many times as long the voxels of `volume` are as those of `source`; 1 where there is none."""
        own = np.min(np.asarray(self.volume.spacing))
        return 1.0 if self.source is None else float(own / np.min(self.source.spacing))

    def render(self, camera: Camera) -> Rendering:
        """An image by `march`."""
        how = {"compositing": self.compositing, "lighting": self.lighting}
        if self.source is None:
            what = with_others(self.volume, self.transfer, self.others)
            found = render(*what, camera, self.march, **how)
        else:
            how["memory"] = self.memory
            found = render_bricks(self.source, self.transfer, camera, self.march, **how)
        return jax.block_until_ready(found)

    def picture(self, quiet: bool) -> Rendering:
        """The image of `camera`, shown as it is made."""
        with progress(f"drawing {self.camera.size[0]} x {self.camera.size[1]} pixels", quiet=quiet):
            return self.render(self.camera)

    def plans(self, cameras: Sequence[Camera], tolerance: float | None) -> list[Plan]:
        """The cheapest way to render the scene within a tolerance, for each camera."""
        if self.others:
            raise ValueError("others: several volumes are not planned for; render them by a step.")
        how: dict[str, Any] = {"transforms": self.transforms, "once": len(cameras) == 1}
        how |= {"compositing": self.compositing, "lighting": self.lighting}
        tolerance = PLANNED if tolerance is None else tolerance
        return [plan(self.volume, self.transfer, camera, tolerance, **how) for camera in cameras]


def scene_of(options: Namespace, orbit: Callable[[Camera], Sequence[Camera]] | None = None) -> Scene:
    """The scene of the options (`DEFAULTS`, `recorded_transfer`, and `file`, a path or `Volume`) without a
    march. `orbit`: the views of a camera that turns, in which the automatic camera shows all that is
    visible."""
    width, height = image_size(getattr(options.camera, "size", options.size))
    require_room(width * height * PIXEL, f"size {width} x {height}")
    is_surface, background = options.compositing == "isosurface", background_of(options)
    if is_surface == (options.isovalue is None):
        raise ValueError("compositing isosurface and isovalue go together; one is missing.")
    mode = Isosurface(options.isovalue) if is_surface else compositing_of(options.compositing)
    # by jitter, which the aligned last cell belongs to, the rings of wood grain become noise
    transforms: tuple[Transform, ...] = (EmptySpaceJitter(seed=0),)
    given = np.atleast_2d(options.clip_plane) if len(options.clip_plane) else np.empty((0, 6))
    planes = finite_array("clip_plane", given, (None, 6))
    planes = [(plane[:3], plane[3:]) for plane in np.asarray(planes).tolist()]
    if options.clip_box is not None or planes:
        transforms = (Clip(options.clip_box, planes, inside_out=options.clip_inside_out), *transforms)
    elif options.clip_inside_out:
        raise ValueError("clip_inside_out goes with clip_box or clip_plane.")

    several = options.others if isinstance(options.others, list | tuple) else [options.others]
    source, others = None, tuple(map(other_of, several))
    if options.memory is None:
        name = "volume" if isinstance(options.file, Volume) else options.file
        with progress(f"reading {name}", quiet=options.quiet):
            volume, transfer = look_of(options)
    else:
        if options.labels is not None or others:
            raise ValueError("memory reads one volume, without labels and others.")
        if isinstance(options.file, Volume):
            raise ValueError("memory is of files; volume is a Volume.")
        integer("memory", options.memory, 1)
        header = {name: value for name, value in header_of(options).items() if value is not None}
        try:
            source = levels_of(options.file, **header)[0]
        except TypeError as fault:  # such as a shape of what is no raw file
            raise ValueError(f"{', '.join(header)}: not for {options.file} ({fault}).") from fault
        volume = copy_of(source, options.memory)
        automatic = is_automatic(options)
        transfer = _transfer_of_bricks(volume, source) if automatic else transfer_of(options, volume, source)
        if IN_MEMORY * source.dtype.itemsize * math.prod(source.shape) <= options.memory:
            volume, source = source.subsampled(1), None

    warn_of_distance(volume, others)
    lighting = _lighting(options, mode, alone=not others)
    seen = () if options.clip_inside_out else planes
    camera = _camera(options, volume, transfer, others, orbit, seen).zoom(options.zoom)
    how = mode, lighting, background, transforms, source, options.memory
    return Scene(volume, transfer, camera, *how, others=others)


def look_of(options: Namespace) -> tuple[Volume, Transfer]:
    """The volume, which may be another one where labels are shown, and its transfer function."""
    volume, automatic = volume_of(options), is_automatic(options)
    if volume.channels > 1 and not isinstance(options.transfer, Transfer):
        told = f"0 to {volume.channels - 1}" if volume.channels > 2 else "0 or 1"
        raise ValueError(
            f"{volume.channels} values in each voxel: choose one by channel, {told}. (--channel 0)"
        )
    transfer = None if automatic else transfer_of(options, volume)
    if volume.labels is not None and not np.any(volume.labels):
        warnings.warn("labels: all voxels have the label 0, which stands for what is around", stacklevel=4)
    if options.labels is not None:
        return labels_shown(volume, transfer)
    if automatic:
        volume, transfer = labels_if_any(volume) or (volume, transfer)
    return volume, automatic_transfer(volume) if transfer is None else transfer


def _camera(
    options: Namespace,
    volume: Volume,
    transfer: Transfer,
    others: Sequence[tuple[Volume, Transfer]],
    orbit: Callable[[Camera], Sequence[Camera]] | None,
    planes: Sequence[Any],
) -> Camera:
    """That of the options; or else one as near as what is visible on one side of `planes` allows."""
    given = {"view_angle": options.view_angle, "size": options.size}
    if isinstance(options.camera, Camera):
        return options.camera
    if options.camera is not None:
        finite_array("camera", options.camera, (6,))
        up, place = options.view_up, (options.camera[:3], options.camera[3:])
        height = np.linalg.norm(np.subtract(*place)) * np.tan(np.deg2rad(options.view_angle) / 2)
        scale = height if options.parallel else None  # as high at the focal point
        return Camera(*place, (0.0, 0.0, 1.0) if up is None else up, parallel_scale=scale, **given)
    if options.compositing == "isosurface":  # seen is what lies within, which most of the faces do not
        step, outer = np.full(2, options.isovalue), faces_of(np.asarray(volume.data))
        opacity = np.array([0.0, 1e6 / unit_of(volume)])[:: -1 if np.mean(outer > step[0]) > 0.5 else 1]
        transfer = TransferFunction(step, np.ones((2, 3)), opacity)
    given["parallel"] = options.parallel
    given["least"] = least = VISIBLE if is_automatic(options) else FAINT
    what = with_others(volume, transfer, others)
    camera = automatic_camera(*what, options.direction, options.view_up, **given)
    clipped = options.clip_box is not None and not options.clip_inside_out
    if orbit is None and not clipped and not planes:
        return camera
    points = []
    for each, its in ((volume, transfer), *others):
        with suppress(ValueError):  # of a box that holds nothing of it
            points.append(visible_points(each.crop(options.clip_box) if clipped else each, its, least))
    seen = clipped_points(np.concatenate(points), planes) if points else np.empty((0, 3))
    return framed(camera, seen, orbit(camera) if orbit else ()) if len(seen) else camera


def other_of(each: Any) -> tuple[Volume, Transfer]:
    """A further volume, and the given transfer function, or a colormap over LOW to HIGH."""
    file, *look = each if isinstance(each, Sequence) and not isinstance(each, str) else (each,)
    volume = file if isinstance(file, Volume) else load(file)
    if look and isinstance(look[0], Transfer):
        return volume, look[0]
    cmap, *clim = look or ("hot",)
    if not clim:
        clim = range_of_object(volume)
    try:
        low, high = map(float, clim)
    except (TypeError, ValueError) as fault:
        got = " ".join(map(str, look))
        raise ValueError(f"others are FILE, FILE CMAP or FILE CMAP LOW HIGH; got {got}.") from fault
    return volume, colormap(cmap, (low, high))


def with_march(scene: Scene, options: Namespace, cameras: Sequence[Camera]) -> Scene:
    """The scene with the given step, or the shortest one planned for the cameras."""
    step = options.step
    if step is None and scene.others:
        if options.tolerance is not None:
            raise ValueError("tolerance is for one volume; give a step.")
        step = min(float(np.min(each.spacing)) for each, _ in ((scene.volume, None), *scene.others)) / 2
    if step is not None:
        return scene._replace(march=quick_march(step, scene.transforms))
    with progress("planning", quiet=options.quiet):
        plans = scene.plans(cameras, options.tolerance)
    found = min(plans, key=lambda plan: float(plan.march.step))
    # a view in which cells must be integrated needs that at any step
    integrated = any(plan.march.quadrature == "preintegrated" for plan in plans)
    march, transforms = found.march, found.march.transforms
    if scene.source is not None and not any(isinstance(t, SpaceLeaping) for t in transforms):
        transforms = (*transforms, SpaceLeaping())  # a copy proves no block empty
    if integrated or scene.source is not None:
        quadrature = "preintegrated" if integrated else march.quadrature
        march = March(float(march.step) / scene.coarser, transforms, quadrature)
    if not all(plan.within for plan in plans):
        told = f"not proven to be within an RMSE of {found.tolerance:.2g}; jaxvol plan tells more"
        warnings.warn(told, stacklevel=3)
    return scene._replace(march=march)


def volume_of(options: Namespace) -> Volume:
    header, labels = header_of(options), options.labels
    if not isinstance(labels, str | Path | None):
        raise ValueError(f"labels must be a file; got {described(labels)}. Or jv.Volume(data, labels=...).")
    if not isinstance(options.file, Volume):
        return load(options.file, **header, labels=labels)
    if told := [name for name, value in header.items() if value is not None]:
        raise ValueError(f"{told[0]} is of files; volume is a Volume.")
    return options.file if labels is None else labelled(options.file, labels)


def is_automatic(options: Namespace) -> bool:
    """Whether nothing is said of the transfer function."""
    given = (getattr(options, name) for name in (*OF_COLORS, "recorded_transfer"))
    return options.compositing == "over" and all(each is None for each in given)


def background_of(options: Namespace) -> tuple[float, float, float]:
    """Linear RGB. The greater values of projections are lighter: on white, the greatest would be hidden."""
    if options.background is None:
        is_dark = options.preset is not None and preset_name(options.preset).endswith("MIP")
        level = 0.0 if is_dark or options.compositing in MODES.keys() - {"over"} else 1.0
        return level, level, level
    red, green, blue = np.asarray(linear_color("background", options.background), np.float64).tolist()
    if not all(0 <= each <= 1 for each in (red, green, blue)):
        got = f"{red:g} {green:g} {blue:g}"
        hint = " 8-bit colours are written '#336699'." if max(red, green, blue) > 1 else ""
        raise ValueError(f"background must be three numbers from 0 to 1 (linear RGB); got {got}.{hint}")
    return red, green, blue


def transfer_of(options: Namespace, volume: Volume, source: VoxelSource | None = None) -> Transfer:
    """The transfer function of the options. `source`: what `volume` is a coarser copy of."""
    if options.recorded_transfer is not None:
        return options.recorded_transfer
    if options.transfer is not None:
        given = options.transfer
        return read_transfer(given) if isinstance(given, str | Path) else given
    unit, clim = options.unit_distance, options.clim
    if (options.window is None) != (options.level is None):
        raise ValueError("window and level go together; one is missing.")
    if options.window is not None:
        window = float(number("window", options.window, above=0))
        level = float(number("level", options.level))
        clim = level - window / 2, level + window / 2
    if options.preset is not None:
        if clim is None:
            clim, told = fitted_range(options.preset, sampled(volume))
            if told:
                warnings.warn(told, stacklevel=5 if source is None else 4)
        return preset(options.preset, clim, preset_unit(source or volume) if unit is None else unit)
    if clim is None:
        data, over = np.asarray(volume.data), options.compositing == "over"
        # what is around the object would be fog
        ends = [data.min(), data.max()]  # which `sampled` may leave out
        low, high = spread_of(np.append(sampled(volume).ravel(), ends))[:2]
        clim = range_of_object(volume) if over else (low, high if high > low else low + 1)
    cmap = options.cmap or ("white" if options.compositing == "isosurface" else "gray")
    if options.compositing == "average" and options.clim is None and options.window is None:
        clim = clim[0], brightest_mean(volume, clim[0])
    if options.compositing == "integral" and unit is None:
        return xray_transfer(volume, cmap, clim)
    return colormap(cmap, clim, unit_distance=(source or volume) if unit is None else unit)


def _transfer_of_bricks(copy: Volume, source: VoxelSource) -> Transfer:
    """The automatic one, from a copy and the middle of the volume at full resolution."""
    low = [max(0, (n - 128) // 2) for n in source.shape]
    high = [min(n, begin + 128) for n, begin in zip(source.shape, low, strict=True)]
    return transfer_by_copy(copy, np.asarray(source.read(low, high)))


def _lighting(options: Namespace, mode: Compositing[Any], *, alone: bool) -> Lighting | None:
    """The light that the options ask for, or that is usual for what they show; none of several volumes."""
    shade = None if options.shade is None else flag("shade", options.shade)
    if shade and not alone:
        raise ValueError("shade: several volumes are shown without light; leave it out.")
    if shade is None:
        shows_surfaces = is_automatic(options) or (options.preset and preset_name(options.preset) in SHADED)
        shade = alone and ((shows_surfaces and isinstance(mode, Over)) or isinstance(mode, Isosurface))
    return Phong() if shade else None


def copy_of(source: VoxelSource, memory: int) -> Volume:
    """A copy of every n-th voxel that fits into memory, stretched to the whole's bounds."""
    most = min(SAMPLED, max(8, memory // (IN_MEMORY * source.dtype.itemsize)))
    copy = source.subsampled(min(stride_of(source.shape, most), min(source.shape) // 2))
    whole = [(n - 1) * s / (m - 1) for n, s, m in zip(source.shape, source.spacing, copy.shape, strict=True)]
    return Volume(copy.data, whole, copy.origin)
