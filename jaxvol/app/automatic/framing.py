"""Where is what a transfer function shows, and from how far does a camera see all of it?"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ...scene.camera import Camera, axes_of
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import Transfer, TransferFunction
from ...scene.volume import Volume
from .labels import INSIDE
from .sampling import sampled, stride_of, unit_of


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


def visible_points(volume: Volume, transfer: Transfer) -> Float[np.ndarray, "n 3"]:
    """Corners in the world of the hull of what a transfer function shows, specks left out; those of the whole
    volume where nothing is visible.

    A piece is what hangs together within REACH voxels, of every n-th in a large volume. Transfer functions
    are those made by `automatic_transfer` and `labels_shown`."""
    from scipy.ndimage import label, maximum_filter

    data = sampled(volume)
    if isinstance(transfer, LabelTransferFunction):
        seen = data > INSIDE / 2
    else:
        assert isinstance(transfer, TransferFunction)
        extinction = np.interp(data, np.asarray(transfer.values), np.asarray(transfer.extinction))
        seen = -np.expm1(-extinction * unit_of(volume)) > SEEN
    if not seen.any():
        return _in_world(volume, _corners(np.zeros(3), np.array(volume.shape) - 1.0))
    found: Any = label(maximum_filter(seen, REACH))  # scipy's types allow a number, too
    pieces = seen * found[0]
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    kept = sizes >= SPECK * sizes.max()
    corners = stride_of(volume.shape) * _hull(kept[pieces])
    around = (corners[:, None] + _corners(-np.ones(3), np.ones(3))).reshape(-1, 3)  # a voxel ends at the next
    return _in_world(volume, np.clip(around, 0, np.array(volume.shape) - 1))


def _hull(seen: Bool[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "n 3"]:
    """Corners of the convex hull of voxels, or all of them where they lie in a plane."""
    from scipy.spatial import ConvexHull, QhullError

    # of a row along z, only its ends can be corners
    rows = seen.any(axis=2)
    x, y = np.nonzero(rows)
    ends = [seen[..., ::step].argmax(axis=2)[rows] for step in (1, -1)]
    ends[1] = seen.shape[2] - 1 - ends[1]
    points = np.concatenate([np.stack([x, y, z], axis=1) for z in ends]).astype(np.float64)
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        return points


def _corners(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Float[np.ndarray, "8 3"]:
    return np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)


def _in_world(volume: Volume, grid: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction, np.float64)
    return np.asarray(volume.origin, np.float64) + (grid * np.asarray(volume.spacing, np.float64)) @ turn.T


def framed(camera: Camera, points: Float[np.ndarray, "n 3"], views: Sequence[Camera] | None = None) -> Camera:
    """A camera with the directions, the angle and the size of another, placed so that the points just fill
    its picture, the whole window.

    From a perspective camera at distance D from its focal point f, a point that lies x to the right of f, and
    z nearer to the camera than f, is in the picture if |x| <= t (D - z), where t is the tangent of half the
    angle. So D must be at least max(x / t + z) and max(-x / t + z), and a shift of f to the right by t / 2
    times their difference makes both equal to their mean. In the same way upwards; the greater mean is taken,
    and f shifted so that on both sides as much is left free. For parallel rays, z does not count, and D is
    the half height of the view.

    `views`: the camera turned about its focal point in all ways that are to show the points, by default as it
    is. The focal point of several is the middle of the points, without a shift.
    """
    views = [camera] if views is None else views
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
        alone = len(views) == 1
        distance = max(distance, float(nearer.max()) + free)
        distance = max(distance, *((one + other) / 2 if alone else np.maximum(one, other)).tolist())
        if alone:
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
