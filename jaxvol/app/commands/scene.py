"""What do the options of a scene mean? What is looked at, how it looks, from where, and what is cut away."""

import argparse
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from ...bricks import VoxelSource
from ...compositing.blending import Compositing, Over
from ...compositing.isosurface import Isosurface
from ...compositing.modes import MODES, compositing_of
from ...compositing.projections import Average
from ...fitting import read_transfer
from ...io.formats import says_where_it_lies
from ...lighting import Lighting, Phong
from ...march.march import Transform
from ...march.transforms.clip import Clip
from ...scene.camera import Camera
from ...scene.presets import SHADED, colormap, preset
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from ..automatic import (
    FRONT,
    automatic_transfer,
    framed,
    front_of,
    labels_shown,
    transfer_by_copy,
    upright,
    visible_points,
)
from .data import copy_of, middle_of, source_of, volume_of
from .orbit import views_shown
from .progress import working


Z = 0.0, 0.0, 1.0


class Scene(NamedTuple):
    """What is looked at, and how. Of a volume that is read in bricks from `source`, `volume` is a copy of
    every n-th voxel in the same place."""

    volume: Volume
    transfer: Transfer
    camera: Camera
    compositing: Compositing[Any]
    lighting: Lighting | None
    background: tuple[float, float, float]
    clip: tuple[Transform, ...]
    source: VoxelSource | None


def scene_of(options: argparse.Namespace) -> Scene:
    """The scene that the options describe."""
    mode = _mode(options)
    background = background_of(options)
    clip = _clip(options)
    given = transfer_given(options)
    source = None
    with working(f"reading {options.file}"):
        if options.memory is None:
            volume = volume_of(options)
        else:
            source = source_of(options)
            volume = copy_of(source, options.memory)
        if is_automatic(options) and source is None and (shown := labels_shown(volume)) is not None:
            volume, transfer = shown
        else:
            part = middle_of(source) if source is not None and is_automatic(options) else None
            transfer = transfer_of(options, volume, part) if given is None else given
        points = visible_points(volume, transfer) if is_automatic(options) else None
    camera = _view(options, volume, points)
    return Scene(volume, transfer, camera, mode, _lighting(options, mode), background, clip, source)


def is_automatic(options: argparse.Namespace) -> bool:
    """Whether nothing is said of the transfer function."""
    names = ("preset", "cmap", "transfer", "kept_transfer", "opacity", "clim", "unit_distance")
    said = any(getattr(options, name, None) is not None for name in names)
    return getattr(options, "compositing", "over") == "over" and not said


def background_of(options: argparse.Namespace) -> tuple[float, float, float]:
    """Linear RGB behind what is shown. The greater the values of a projection, the lighter it is: on white,
    the greatest could not be seen.

    **Raises:** `ValueError` for numbers that no image file can hold."""
    if options.background is not None:
        red, green, blue = options.background
        if not all(0 <= each <= 1 for each in options.background):
            raise ValueError(
                "--background must be three numbers from 0 to 1 (linear RGB); "
                f"got {red:g} {green:g} {blue:g}."
            )
        return red, green, blue
    projects = getattr(options, "compositing", "over") in MODES.keys() - {"over"}
    level = 0.0 if projects else 1.0
    return level, level, level


def _mode(options: argparse.Namespace) -> Compositing[Any]:
    """The compositing mode that the options name."""
    shows_surface, value = options.compositing == "isosurface", options.isovalue
    if shows_surface and value is None:
        raise ValueError("--compositing isosurface needs the value on the surface: --isovalue VALUE.")
    if value is not None and not shows_surface:
        raise ValueError(
            f"--isovalue goes with --compositing isosurface; got --compositing {options.compositing}."
        )
    return Isosurface(value) if shows_surface else compositing_of(options.compositing)


def _lighting(options: argparse.Namespace, mode: Compositing[Any]) -> Lighting | None:
    """The light that the options ask for, or that is usual for what they show."""
    shade = options.shade
    if shade and isinstance(mode, Average):
        raise ValueError("--shade needs a place that is shaded; leave it out with --compositing average.")
    if shade is None:
        surfaces = options.preset in SHADED or is_automatic(options)
        shade = (surfaces and isinstance(mode, Over)) or isinstance(mode, Isosurface)
    return Phong() if shade else None


def transfer_given(options: argparse.Namespace) -> Transfer | None:
    """The transfer function that the options give by themselves, before anything is read of the volume; None
    where it depends on that. What is wrong with them is told in either case."""
    kept = getattr(options, "kept_transfer", None)
    if options.transfer or kept is not None:
        for name in ("clim", "opacity", "unit_distance"):
            if getattr(options, name) is not None:
                raise ValueError(
                    f"--{name.replace('_', '-')} is for presets and colormaps; a transfer function from a "
                    "file or a picture needs none."
                )
        return read_transfer(options.transfer) if kept is None else kept
    if is_automatic(options):
        return None
    if options.preset and options.opacity is not None:
        raise ValueError("--opacity is for colormaps; a preset has its own.")
    if options.preset:
        return preset(options.preset, options.clim, _unit_distance(options))
    over_range = _colormap(options, options.clim or (0, 1))
    return over_range if options.clim else None


def transfer_of(
    options: argparse.Namespace, volume: Volume, part: Shaped[np.ndarray, "nx ny nz"] | None = None
) -> Transfer:
    """The transfer function for a volume, where the options alone do not give one. `part`: of the voxels as
    they are, where the volume is a copy."""
    if is_automatic(options):
        return automatic_transfer(volume) if part is None else transfer_by_copy(volume, part)
    return _colormap(options, (float(volume.data.min()), float(volume.data.max())))


def _unit_distance(options: argparse.Namespace) -> float:
    return 1.0 if options.unit_distance is None else options.unit_distance


def _colormap(options: argparse.Namespace, clim: tuple[float, float]) -> Transfer:
    """The colormap that the options name, over a range of values."""
    surface = getattr(options, "compositing", "over") == "isosurface"
    cmap = options.cmap or ("white" if surface else "gray")
    return colormap(cmap, clim, options.opacity or "linear", _unit_distance(options))


def _view(options: argparse.Namespace, volume: Volume, points: Float[np.ndarray, "n 3"] | None) -> Camera:
    """Where it is looked at from. `points`: what the camera is to show, by default the volume, unless its
    position is given."""
    if options.camera and options.parallel:
        raise ValueError(
            "--parallel goes with --direction, which shows the whole volume; leave out --camera."
        )
    if options.camera and options.direction:
        raise ValueError("--camera sets the position; leave out --direction.")
    up, side = options.view_up, options.direction
    free = up is side is options.camera is None
    if free and not says_where_it_lies(options.file) and (found := upright(volume)) is not None:
        up, side = found, front_of(found)
    view: dict[str, Any] = {
        "view_up": Z if up is None else up,
        "view_angle": options.view_angle,
        "size": tuple(options.size),
    }
    if options.camera:
        camera = Camera(options.camera[:3], options.camera[3:], **view)
    else:
        camera = Camera.looking_at(volume, FRONT if side is None else side, parallel=options.parallel, **view)
        if points is not None:
            camera = framed(camera, points, views_shown(options, camera))
    return camera.zoom(options.zoom)


def _clip(options: argparse.Namespace) -> tuple[Transform, ...]:
    """What is cut away, if anything is."""
    planes = [(plane[:3], plane[3:]) for plane in options.clip_plane]
    if options.clip_box is None and not planes:
        if options.clip_inside_out:
            raise ValueError("--clip-inside-out goes with --clip-box or --clip-plane.")
        return ()
    return (Clip(options.clip_box, planes, inside_out=options.clip_inside_out),)
