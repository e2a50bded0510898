"""Where does a camera stand that turns about its focal point?"""

import argparse
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...scene.camera import Camera


PLANNED_VIEWS = 4
"""Views of an orbit, evenly spaced, for which its march is planned."""

FRAMED_VIEWS = 24
"""Views of an orbit, evenly spaced, in which all that is visible is to be in the picture."""


def axis_of(options: argparse.Namespace, camera: Camera) -> Any:
    """The axis that the camera turns about: what is up, unless another is given."""
    given = options.view_up if options.axis is None else options.axis
    return camera.view_up if given is None else given


def turned(camera: Camera, degrees: float, axis: Any) -> Camera:
    """The camera, turned about an axis through its focal point."""
    if not degrees:
        return camera
    axis = np.asarray(axis, float)
    if not np.isfinite(axis).all() or not axis.any():
        raise ValueError(f"--axis must not be 0; got {' '.join(map(str, axis))}.")
    rotation = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    position, focal, up = (
        np.asarray(v, float) for v in (camera.position, camera.focal_point, camera.view_up)
    )
    return Camera(
        focal + rotation.apply(position - focal),
        focal,
        rotation.apply(up),
        camera.view_angle,
        size=camera.size,
        parallel_scale=camera.parallel_scale,
        window=camera.window,
    )


def angles_of(degrees: float, frames: int) -> list[float]:
    """Angles of the frames: evenly spaced from 0 on, to `degrees`; or, where that ends at the beginning, to
    one frame before it."""
    closed = degrees % 360 == 0
    return [degrees * i / max(frames if closed else frames - 1, 1) for i in range(frames)]


def views_of(
    options: argparse.Namespace, camera: Camera, degrees: float, count: int = PLANNED_VIEWS
) -> list[Camera]:
    """Views of an orbit, evenly spaced: the same for all of its frames."""
    return [turned(camera, angle, axis_of(options, camera)) for angle in angles_of(degrees, count)]


def views_shown(options: argparse.Namespace, camera: Camera) -> list[Camera]:
    """The views that a command shows: of the orbit that it makes, or that its picture is a frame of; else
    the one view, turned as asked for."""
    degrees = getattr(options, "degrees", None)
    if degrees is None:
        degrees = getattr(options, "orbit", None)
    if degrees is None:
        return [turned(camera, getattr(options, "turn", 0), axis_of(options, camera))]
    return views_of(options, camera, degrees, FRAMED_VIEWS)
