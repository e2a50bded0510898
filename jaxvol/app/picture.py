"""Builds the scene that options of a command or of `show` describe, plans its march, and renders it."""

import warnings
from argparse import Namespace
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._util.checks import Arrayable, described, finite_array, flag, number
from .._util.memory import require_room
from .._util.progress import progress
from .._util.srgb import linear_color
from .._util.voxels import faces_of
from ..compositing.blending import Compositing, Over
from ..compositing.isosurface import Isosurface
from ..compositing.modes import MODES, compositing_of
from ..fitting import read_transfer
from ..io.formats import labelled, load
from ..lighting import Lighting, Phong
from ..march.march import March, Transform
from ..march.transforms.alpha_correction import AlphaCorrection
from ..march.transforms.clip import Clip
from ..march.transforms.early_termination import EarlyTermination
from ..march.transforms.jitter import EmptySpaceJitter
from ..march.transforms.space_leaping import SpaceLeaping
from ..planning import Plan, plan
from ..render import PLANNED, render
from ..scene.camera import Camera, image_size
from ..scene.presets import SHADED, colormap, fitted_range, preset, preset_name
from ..scene.rendering import Rendering
from ..scene.several import with_others
from ..scene.transfer import Transfer, TransferFunction
from ..scene.volume import Volume
from .automatic import (
    automatic_transfer,
    brightest_mean,
    labels_if_any,
    labels_shown,
    preset_unit,
    range_of_object,
    sampled,
    spread_of,
    unit_of,
    xray_transfer,
)
from .framing import FAINT, VISIBLE, automatic_camera, clipped_points, framed, visible_points, warn_of_gap
from .settings import COLOR_OPTIONS, header_of


PIXEL = 160  # bytes per pixel of an image while it is rendered and written


def quick_march(step: Arrayable, transforms: Sequence[Transform] = ()) -> March:
    """The march of a step that was not planned."""
    return March(step, (*transforms, SpaceLeaping(), AlphaCorrection(), EarlyTermination()), "midpoint")


class PictureRequest(NamedTuple):
    """Arguments of `render`. `march`: None until it is planned. `extra_pairs`: further volumes, each with its
    transfer function."""

    volume: Volume
    transfer: Transfer
    camera: Camera
    compositing: Compositing[Any]
    lighting: Lighting | None
    background: tuple[float, float, float]
    transforms: tuple[Transform, ...]
    march: Any = None
    extra_pairs: tuple[tuple[Volume, Transfer], ...] = ()

    def render(self, camera: Camera) -> Rendering:
        """Render an image with `march`."""
        pair = with_others(self.volume, self.transfer, self.extra_pairs)
        look: dict[str, Any] = {"compositing": self.compositing, "lighting": self.lighting}
        return jax.block_until_ready(render(*pair, camera, self.march, **look))

    def picture(self, quiet: bool) -> Rendering:
        """Render the image of `camera`, with progress on stderr."""
        with progress(f"drawing {self.camera.size[0]} x {self.camera.size[1]} pixels", quiet=quiet):
            return self.render(self.camera)

    def plans(self, cameras: Sequence[Camera], tolerance: float | None) -> list[Plan]:
        """The cheapest march within a tolerance, for each camera."""
        if self.extra_pairs:
            raise ValueError("others: several volumes are not planned for; render them by a step.")
        kwargs: dict[str, Any] = {"transforms": self.transforms, "once": len(cameras) == 1}
        kwargs |= {"compositing": self.compositing, "lighting": self.lighting}
        tolerance = PLANNED if tolerance is None else tolerance
        return [plan(self.volume, self.transfer, camera, tolerance, **kwargs) for camera in cameras]


def scene_of(options: Namespace, orbit: Callable[[Camera], Sequence[Camera]] | None = None) -> PictureRequest:
    """The scene of the options (`DEFAULTS`, `recorded_transfer`, and `file`, a path or `Volume`) without a
    march. `orbit`: views of a camera that turns; the automatic camera fits the visible part into all."""
    width, height = image_size(getattr(options.camera, "size", options.size))
    require_room(width * height * PIXEL, f"size {width} x {height}")
    is_surface, background = options.compositing == "isosurface", background_of(options)
    if is_surface == (options.isovalue is None):
        raise ValueError("compositing isosurface and isovalue go together; one is missing.")
    mode = Isosurface(options.isovalue) if is_surface else compositing_of(options.compositing)
    # jitter turns the rings of wood grain into noise
    transforms: tuple[Transform, ...] = (EmptySpaceJitter(seed=0),)
    rows = np.atleast_2d(options.clip_plane) if len(options.clip_plane) else np.empty((0, 6))
    rows = np.asarray(finite_array("clip_plane", rows, (None, 6))).tolist()
    planes = [(row[:3], row[3:]) for row in rows]
    if options.clip_box is not None or planes:
        transforms = (Clip(options.clip_box, planes, inside_out=options.clip_inside_out), *transforms)
    elif options.clip_inside_out:
        raise ValueError("clip_inside_out goes with clip_box or clip_plane.")

    several = options.others if isinstance(options.others, list | tuple) else [options.others]
    pairs = tuple(map(other_of, several))
    name = "volume" if isinstance(options.file, Volume) else options.file
    with progress(f"reading {name}", quiet=options.quiet):
        volume, transfer = look_of(options)
    warn_of_gap(volume, pairs)
    lighting = _lighting(options, mode, alone=not pairs)
    camera = _camera(options, [(volume, transfer), *pairs], orbit, planes).zoom(options.zoom)
    look = mode, lighting, background, transforms
    return PictureRequest(volume, transfer, camera, *look, extra_pairs=pairs)


def look_of(options: Namespace) -> tuple[Volume, Transfer]:
    """The volume, smoothed where labels are shown, and its transfer function."""
    volume, automatic = volume_of(options), is_automatic(options)
    if volume.channels > 1 and not isinstance(options.transfer, Transfer):
        last = volume.channels - 1
        raise ValueError(
            f"{last + 1} values in each voxel: choose one by channel, 0 to {last}. (--channel 0)"
        )
    transfer = None if automatic else transfer_of(options, volume)
    if volume.labels is not None and not np.any(volume.labels):
        warnings.warn("labels: all voxels have the label 0, the background", stacklevel=4)
    if options.labels is not None:
        return labels_shown(volume, transfer)
    if automatic:
        volume, transfer = labels_if_any(volume) or (volume, transfer)
    return volume, automatic_transfer(volume) if transfer is None else transfer


def _camera(
    options: Namespace,
    pairs: Sequence[tuple[Volume, Transfer]],
    orbit: Callable[[Camera], Sequence[Camera]] | None,
    planes: Sequence[Any],
) -> Camera:
    """The camera of the options; by default one framed on the visible part that the clip leaves."""
    kwargs = {"view_angle": options.view_angle, "size": options.size}
    if isinstance(options.camera, Camera):
        return options.camera
    if options.camera is not None:
        finite_array("camera", options.camera, (6,))
        up, place = options.view_up, (options.camera[:3], options.camera[3:])
        height = np.linalg.norm(np.subtract(*place)) * np.tan(np.deg2rad(options.view_angle) / 2)
        scale = height if options.parallel else None  # of the same view height at the focal point
        return Camera(*place, (0.0, 0.0, 1.0) if up is None else up, parallel_scale=scale, **kwargs)
    if options.compositing == "isosurface":  # visible is the side with fewer of the volume's faces
        volume = pairs[0][0]
        step, outer = np.full(2, options.isovalue), faces_of(np.asarray(volume.data))
        opacity = np.array([0.0, 1e6 / unit_of(volume)])[:: -1 if np.mean(outer > step[0]) > 0.5 else 1]
        pairs = [(volume, TransferFunction(step, np.ones((2, 3)), opacity)), *pairs[1:]]
    min_opacity = VISIBLE if is_automatic(options) else FAINT
    kwargs |= {"parallel": options.parallel, "least": min_opacity}
    scene = with_others(*pairs[0], pairs[1:])
    camera = automatic_camera(*scene, options.direction, options.view_up, **kwargs)
    planes = () if options.clip_inside_out else planes
    has_box = options.clip_box is not None and not options.clip_inside_out
    if orbit is None and not has_box and not planes:
        return camera
    points = []
    for volume, transfer in pairs:
        with suppress(ValueError):  # the box holds no part of the volume
            part = volume.crop(options.clip_box) if has_box else volume
            points.append(visible_points(part, transfer, min_opacity))
    points = clipped_points(np.concatenate(points), planes) if points else np.empty((0, 3))
    return framed(camera, points, orbit(camera) if orbit else ()) if len(points) else camera


def other_of(entry: Volume | str | Path | Sequence[Any]) -> tuple[Volume, Transfer]:
    """Volume and transfer function of an entry of `others`: FILE, or (FILE, transfer or CMAP, LOW, HIGH)."""
    file, *look = entry if isinstance(entry, Sequence) and not isinstance(entry, str) else (entry,)
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


def with_march(scene: PictureRequest, options: Namespace, cameras: Sequence[Camera] = ()) -> PictureRequest:
    """The scene with the step of the options, or the shortest planned for `cameras`, by default its own."""
    step = options.step
    if step is None and scene.extra_pairs:
        if options.tolerance is not None:
            raise ValueError("tolerance is for one volume; give a step.")
        volumes = scene.volume, *(volume for volume, _ in scene.extra_pairs)
        step = min(float(np.min(volume.spacing)) for volume in volumes) / 2
    if step is not None:
        return scene._replace(march=quick_march(step, scene.transforms))
    with progress("planning", quiet=options.quiet):
        plans = scene.plans(cameras or [scene.camera], options.tolerance)
    shortest = min(plans, key=lambda plan: float(plan.march.step))
    # a view that needs preintegration needs it at any step
    integrated = any(plan.march.quadrature == "preintegrated" for plan in plans)
    march = shortest.march
    if integrated:
        march = March(march.step, march.transforms, "preintegrated")
    if not all(plan.within for plan in plans):
        bound = f"an RMSE of {shortest.tolerance:.2g}"
        warnings.warn(f"not proven to be within {bound}; jaxvol plan tells more", stacklevel=3)
    return scene._replace(march=march)


def volume_of(options: Namespace) -> Volume:
    """The volume of `file` and `labels`."""
    header, labels = header_of(options), options.labels
    if not isinstance(labels, str | Path | None):
        raise ValueError(f"labels must be a file; got {described(labels)}. Or jv.Volume(data, labels=...).")
    if not isinstance(options.file, Volume):
        return load(options.file, **header, labels=labels)
    if names := [name for name, value in header.items() if value is not None]:
        raise ValueError(f"{names[0]} is of files; volume is a Volume.")
    return options.file if labels is None else labelled(options.file, labels)


def is_automatic(options: Namespace) -> bool:
    """True if no option sets the transfer function."""
    names = (*COLOR_OPTIONS, "recorded_transfer")
    return options.compositing == "over" and all(getattr(options, name) is None for name in names)


def background_of(options: Namespace) -> tuple[float, float, float]:
    """Linear RGB, by default black for projections, whose greatest values are light, else white."""
    if options.background is None:
        is_dark = options.preset is not None and preset_name(options.preset).endswith("MIP")
        level = 0.0 if is_dark or options.compositing in MODES.keys() - {"over"} else 1.0
        return level, level, level
    red, green, blue = np.asarray(linear_color("background", options.background), np.float64).tolist()
    if not all(0 <= channel <= 1 for channel in (red, green, blue)):
        got = f"{red:g} {green:g} {blue:g}"
        hint = " 8-bit colours are written '#336699'." if max(red, green, blue) > 1 else ""
        raise ValueError(f"background must be three numbers from 0 to 1 (linear RGB); got {got}.{hint}")
    return red, green, blue


def transfer_of(options: Namespace, volume: Volume) -> Transfer:
    """The transfer function of the options."""
    if options.recorded_transfer is not None:
        return options.recorded_transfer
    if options.transfer is not None:
        transfer = options.transfer
        return read_transfer(transfer) if isinstance(transfer, str | Path) else transfer
    unit, clim = options.unit_distance, options.clim
    if (options.window is None) != (options.level is None):
        raise ValueError("window and level go together; one is missing.")
    if options.window is not None:
        window = float(number("window", options.window, above=0))
        level = float(number("level", options.level))
        clim = level - window / 2, level + window / 2
    if options.preset is not None:
        if clim is None:
            clim, warning = fitted_range(options.preset, sampled(volume))
            if warning:
                warnings.warn(warning, stacklevel=5)
        return preset(options.preset, clim, preset_unit(volume) if unit is None else unit)
    if clim is None:
        data = np.asarray(volume.data)
        ends = [data.min(), data.max()]  # which `sampled` may leave out
        low, high = spread_of(np.append(sampled(volume).ravel(), ends))[:2]
        clim = low, high if high > low else low + 1
        if options.compositing == "over":  # the background would be fog
            clim = range_of_object(volume)
    cmap = options.cmap or ("white" if options.compositing == "isosurface" else "gray")
    if options.compositing == "average" and options.clim is None and options.window is None:
        clim = clim[0], brightest_mean(volume, clim[0])
    if options.compositing == "integral" and unit is None:
        return xray_transfer(volume, cmap, clim)
    return colormap(cmap, clim, unit_distance=volume if unit is None else unit)


def _lighting(options: Namespace, mode: Compositing[Any], *, alone: bool) -> Lighting | None:
    """The light of the options: by default on surfaces, never on several volumes."""
    shade = None if options.shade is None else flag("shade", options.shade)
    if shade and not alone:
        raise ValueError("shade: several volumes are shown without light; leave it out.")
    if shade is None:
        shows_surfaces = is_automatic(options) or (options.preset and preset_name(options.preset) in SHADED)
        shade = alone and ((shows_surfaces and isinstance(mode, Over)) or isinstance(mode, Isosurface))
    return Phong() if shade else None
