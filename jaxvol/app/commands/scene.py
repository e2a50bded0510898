"""What do the options of a scene mean? What is looked at, how it looks, from where, and what is cut away."""

import argparse
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from ...bricks import VoxelSource
from ...compositing.blending import Compositing, Over
from ...compositing.isosurface import Isosurface
from ...compositing.modes import MODES, compositing_of
from ...compositing.projections import Average
from ...fitting import read_transfer
from ...lighting import Lighting, Phong
from ...march.march import Transform
from ...march.transforms.clip import Clip
from ...scene.camera import Camera
from ...scene.presets import SHADED, colormap, preset
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from ..automatic import FRONT, automatic_transfer, framed, labels_shown, transfer_by_copy, visible_points
from .data import copy_of, middle_of, source_of, volume_of


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


def scene_of(
    options: argparse.Namespace, orbit: Callable[[Camera], Sequence[Camera]] = lambda camera: [camera]
) -> Scene:
    """The scene that the options describe. `orbit`: the views of a camera that turns, in which the automatic
    camera shows all that is visible."""
    mode, background, clip = _compositing(options), background_of(options), _clip(options)
    automatic, source = is_automatic(options), None
    if options.memory is None:
        volume = volume_of(options)
        shown = (labels_shown(volume) if automatic else None) or (volume, transfer_of(options, volume))
        volume, transfer = shown
    else:
        source = source_of(options)
        volume = copy_of(source, options.memory)
        transfer = transfer_of(options, volume, middle_of(source) if automatic else None)
    camera = _camera(options, volume)
    if automatic and options.camera is None:
        camera = framed(camera, visible_points(volume, transfer), orbit(camera))
    camera = camera.zoom(options.zoom)
    return Scene(volume, transfer, camera, mode, _lighting(options, mode), background, clip, source)


def is_automatic(options: argparse.Namespace) -> bool:
    """Whether nothing is said of the transfer function."""
    names = ("preset", "cmap", "transfer", "recorded_transfer", "clim", "unit_distance")
    return options.compositing == "over" and all(getattr(options, name) is None for name in names)


def background_of(options: argparse.Namespace) -> tuple[float, float, float]:
    """Linear RGB behind what is shown. The greater the values of a projection, the lighter it is: on white,
    the greatest could not be seen.

    **Raises:** `ValueError` for numbers that no image file can hold."""
    if options.background is None:
        level = 0.0 if options.compositing in MODES.keys() - {"over"} else 1.0
        return level, level, level
    red, green, blue = options.background
    if not all(0 <= each <= 1 for each in options.background):
        raise ValueError(
            f"--background must be three numbers from 0 to 1 (linear RGB); got {red:g} {green:g} {blue:g}."
        )
    return red, green, blue


def _compositing(options: argparse.Namespace) -> Compositing[Any]:
    is_surface, value = options.compositing == "isosurface", options.isovalue
    if is_surface and value is None:
        raise ValueError("--compositing isosurface needs the value on the surface: --isovalue VALUE.")
    if value is not None and not is_surface:
        raise ValueError(
            f"--isovalue goes with --compositing isosurface; got --compositing {options.compositing}."
        )
    return Isosurface(value) if is_surface else compositing_of(options.compositing)


def _lighting(options: argparse.Namespace, mode: Compositing[Any]) -> Lighting | None:
    """The light that the options ask for, or that is usual for what they show."""
    shade = options.shade
    if shade and isinstance(mode, Average):
        raise ValueError("--shade needs a place that is shaded; leave it out with --compositing average.")
    if shade is None:
        shows_surfaces = options.preset in SHADED or is_automatic(options)
        shade = (shows_surfaces and isinstance(mode, Over)) or isinstance(mode, Isosurface)
    return Phong() if shade else None


def transfer_of(
    options: argparse.Namespace, volume: Volume, part: Shaped[np.ndarray, "nx ny nz"] | None = None
) -> Transfer:
    """The transfer function for a volume. `part`: of the voxels as they are, where the volume is a copy."""
    if is_automatic(options):
        return automatic_transfer(volume) if part is None else transfer_by_copy(volume, part)
    if options.recorded_transfer is not None:
        return options.recorded_transfer
    if options.transfer is not None:
        return read_transfer(options.transfer)
    unit = 1.0 if options.unit_distance is None else options.unit_distance
    if options.preset is not None:
        return preset(options.preset, options.clim, unit)
    clim = options.clim or (float(volume.data.min()), float(volume.data.max()))
    cmap = options.cmap or ("white" if options.compositing == "isosurface" else "gray")
    return colormap(cmap, clim, unit_distance=unit)


def _camera(options: argparse.Namespace, volume: Volume) -> Camera:
    """Where the volume is looked at from, all of it unless the position is given."""
    view: dict[str, Any] = {
        "view_up": options.view_up,
        "view_angle": options.view_angle,
        "size": tuple(options.size),
    }
    if options.camera:
        return Camera(options.camera[:3], options.camera[3:], **view)
    return Camera.looking_at(volume, options.direction or FRONT, parallel=options.parallel, **view)


def _clip(options: argparse.Namespace) -> tuple[Transform, ...]:
    """What is cut away, if anything is."""
    planes = [(plane[:3], plane[3:]) for plane in options.clip_plane]
    if options.clip_box is None and not planes:
        if options.clip_inside_out:
            raise ValueError("--clip-inside-out goes with --clip-box or --clip-plane.")
        return ()
    return (Clip(options.clip_box, planes, inside_out=options.clip_inside_out),)
