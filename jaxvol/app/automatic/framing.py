"""Where is what a transfer function shows, and from how far does a camera see all of it?"""

import itertools
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from jaxtyping import Float

from ...scene.camera import Camera, axes_of
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import Transfer, TransferFunction
from ...scene.volume import Volume
from .histogram import sampled, stride_of, unit_of
from .labels import INSIDE


SEEN = 0.1
"""Opacity, of a part ACROSS of the diagonal, from which on a voxel counts as visible."""

SPECK = 0.02
"""Part of the largest connected piece below which another is a speck, which need not be in the picture."""

NEAREST = 0.1
"""Distance of the camera from what is nearest to it, at least, as part of the diagonal of what is visible."""

REACH = 3
"""Voxels of the cube around each visible one that connects it to others, such as the leaves of a tree."""

MARGIN = 1.06
"""By how much more than what is visible the picture shows, in each direction."""

CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
"""Of the unit cube."""

FRONT = (0.5, -1.0, 0.4)
"""From the volume to the camera, where z is up: to the right, in front, and higher."""


def visible_points(volume: Volume, transfer: Transfer) -> Float[np.ndarray, "n 3"]:
    """Points in the world around what a transfer function of `automatic_transfer` or `labels_shown` shows,
    specks left out; the corners of the volume where nothing is visible."""
    from scipy.ndimage import label, maximum_filter
    from scipy.spatial import ConvexHull, QhullError

    data = sampled(volume)
    if isinstance(transfer, LabelTransferFunction):
        seen = data > INSIDE / 2
    else:
        assert isinstance(transfer, TransferFunction)
        extinction = np.interp(data, np.asarray(transfer.values), np.asarray(transfer.extinction))
        seen = -np.expm1(-extinction * unit_of(volume)) > SEEN
    if not seen.any():
        return _in_world(volume, CORNERS * (np.array(volume.shape) - 1))
    found: Any = label(maximum_filter(seen, REACH))  # scipy's types allow a number, too
    pieces = seen * found[0]
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    shown = (sizes >= SPECK * sizes.max())[pieces]
    rows = shown.any(axis=2)  # of voxels along z, of which only the ends count
    ends = shown.argmax(axis=2)[rows], shown.shape[2] - 1 - shown[..., ::-1].argmax(axis=2)[rows]
    voxels = np.concatenate([np.column_stack([*np.nonzero(rows), z]) for z in ends]).astype(np.float64)
    with suppress(QhullError):  # voxels in a plane have no hull, and all are kept
        voxels = voxels[ConvexHull(voxels).vertices]
    around = stride_of(volume.shape) * voxels[:, None] + 2 * CORNERS - 1  # a voxel ends at the next
    return _in_world(volume, np.clip(around.reshape(-1, 3), 0, np.array(volume.shape) - 1))


def _in_world(volume: Volume, grid: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction, np.float64)
    return np.asarray(volume.origin, np.float64) + (grid * np.asarray(volume.spacing, np.float64)) @ turn.T


def framed(camera: Camera, points: Float[np.ndarray, "n 3"], views: Sequence[Camera] = ()) -> Camera:
    """A camera with the directions, the angle and the size of another, placed so that the points just fill
    its picture, the whole window; or those of all `views` of it, turned about the middle of the points.

    From a distance D, a point that lies x beside the focal point, and z nearer than it, is in the picture if
    |x| <= t (D - z), where t is the tangent of half the angle. For parallel rays, z does not count, and D is
    the half height of the view."""
    views = views or [camera]
    width, height = camera.size
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    perspective = camera.parallel_scale is None
    tangent = np.tan(np.deg2rad(float(camera.view_angle)) / 2) if perspective else 1.0
    t = tangent / MARGIN * np.array([width / height, 1])
    focal, distance = middle, 0.0
    free = NEAREST * float(np.linalg.norm(np.ptp(points, axis=0))) * perspective
    for view in views:
        right, up, forward = (np.asarray(axis, np.float64) for axis in axes_of(view))
        axes = np.stack([right, up], axis=1)
        across, nearer = (points - middle) @ axes / t, -(points - middle) @ forward * perspective
        one, other = ((nearer[:, None] + side * across).max(axis=0) for side in (1, -1))
        needed = (one + other) / 2 if len(views) == 1 else np.maximum(one, other)
        distance = max(distance, float(nearer.max()) + free, *needed.tolist())
        if len(views) == 1:
            depth = distance - nearer if perspective else np.ones(len(points))
            focal = middle + axes @ (t * [_centering(each, depth) for each in across.T])
    away = np.asarray(camera.position - camera.focal_point, np.float64)
    return Camera(
        focal + (away * (distance / np.linalg.norm(away)) if perspective else away),
        focal,
        camera.view_up,
        camera.view_angle,
        size=camera.size,
        parallel_scale=None if perspective else distance,
    )


def _centering(across: Float[np.ndarray, " n"], depth: Float[np.ndarray, " n"]) -> float:
    """The shift that leaves as much free on both sides of what lies so far across at such depths."""
    from scipy.optimize import brentq

    def excess(shift: float) -> float:
        seen = (across - shift) / depth
        return float(seen.max() + seen.min())

    return float(brentq(excess, across.min(), across.max()))  # pyright: ignore[reportArgumentType]
