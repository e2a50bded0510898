"""Where is what a transfer function shows, and from how far does a camera see all of it?"""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from .._util.checks import Arrayable, finite_array, flag
from .._util.texts import pasted
from ..ray import check_arguments
from ..scene.camera import Camera, axes_of
from ..scene.labels import LabelTransferFunction
from ..scene.several import pairs_of
from ..scene.transfer import Transfer, TransferFunction, sized
from ..scene.volume import Volume
from .automatic import automatic_transfer, check_known, sampled, stride_of, unit_of


VISIBLE = 0.1  # opacity, along a hundredth of the diagonal, from which on a voxel counts as visible
FAINT = 0.01  # the same of a transfer function that was given, and where it is asked on which face it stands
SPECK = 0.02  # pieces smaller than this fraction of the largest one need not be in the picture
REACH = 3  # voxels of the cube around each visible one that connects it to others, as the leaves of a tree
NEAREST = 0.1  # least distance of the camera from what is visible, as a fraction of the diagonal of that
MARGIN = 1.06  # by how much more than what is visible the picture shows, in each direction

CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T
"""Of the unit cube."""

FRONT = (0.5, -1.0, 0.4)
"""From the volume to the camera, where z is up: to the right, in front, and higher."""


SLAB = 0.2
"""Shortest side of a volume, as a fraction of the middle one, below which it is seen from its broad side."""

CUT_FACE, OTHER_FACE = 0.1, 1 / 3
"""An object stands on a face of the volume that cuts through so much of it, if the opposite one cuts through
at most that part as much: the neck, or the pot of a plant."""


def automatic_camera(
    volume: Volume | Any,
    transfer: Transfer | Any,
    direction: Arrayable | None = None,
    view_up: Arrayable | None = None,
    view_angle: Arrayable = 30.0,
    *,
    parallel: bool | Any = False,
    size: tuple[int, int] | int | Any = (512, 512),
    least: float = VISIBLE,
    centered: bool | Any = False,
) -> Camera:
    """A camera as near as what a transfer function shows allows, specks left out, and upright.

    Args:
        volume: what is seen; or a list of several volumes, as for `render`, the first of which is upright.
        transfer: a `TransferFunction` or `LabelTransferFunction`; for another, all of the volume counts. Of
            several volumes, a list of one for each.
        direction: from the volume to the camera; by default to the right, in front, and higher.
        view_up: by default z, or -y from straight above or below, where a patient's front is; of a volume
            that does not say where it lies (its origin is 0, its axes are the world's, as of raw files), away
            from the face that cuts through most of what `automatic_transfer` shows, if the opposite one does
            not: the neck, or the pot of a plant, is below.
        view_angle: degrees.
        parallel: whether the camera is orthographic.
        size: (width, height) of the image in pixels.
        least: opacity along a hundredth of the volume's diagonal from which on a voxel counts; 0.01 where
            what is visible may be fog.
        centered: whether the focal point is the middle of what is seen, as to turn the camera about it. The
            camera is then farther away (by 1.03 to 1.3 in eight scans), since perspective shows the near part
            larger.

    Returns:
        The `Camera`.

    Raises:
        ValueError: as `Camera.looking_at` does, for a `view_up` along `direction`, and for what is traced.
    """
    pairs = pairs_of(volume, transfer) or [(volume, transfer)]
    volume, transfer = pairs[0]
    check_arguments("automatic_camera(volume, transfer)", volume=volume, transfer=transfer)
    check_known("automatic_camera", pairs, direction, view_up, view_angle)
    with jax.ensure_compile_time_eval():  # also where something else is traced
        side = upright(volume, transfer, direction, view_up)
        camera = Camera.looking_at(volume, *side, view_angle, parallel=parallel, size=size)
        points = np.concatenate([visible_points(*pair, least) for pair in pairs])
        return framed(camera, points, centered=flag("centered", centered))


def upright(
    volume: Volume, transfer: Transfer, direction: Arrayable | None, view_up: Arrayable | None
) -> tuple[Any, Any]:
    """Direction and view up, where they are None as `automatic_camera` has them."""
    axis, sign = (2, 1.0) if view_up is not None else _up(volume, transfer)
    front = np.roll(FRONT, axis + 1)  # so that what is above lies along this axis
    front[axis] *= sign
    extent = np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    thin = int(np.argmin(extent))
    if extent[thin] < SLAB * np.median(extent):  # seen from its broad side
        front = 0.3 * front
        front[thin] = 1.0 if front[thin] >= 0 else -1.0
        axis, sign = (axis, sign) if axis != thin else (1, 1.0)
        front = front if volume.direction is None else np.asarray(volume.direction) @ front
    toward = np.asarray(finite_array("direction", front if direction is None else direction, (3,)))
    up = np.asarray(finite_array("view_up", sign * np.eye(3)[axis] if view_up is None else view_up, (3,)))
    along = np.linalg.norm(np.cross(toward, up)) <= 1e-3 * np.linalg.norm(toward) * np.linalg.norm(up)
    if along and view_up is not None and np.any(up) and np.any(toward):
        raise ValueError(f"view_up must not point along direction, {pasted(toward)}; got {pasted(up)}.")
    # a patient's front lies at -y; of others, `Camera.looking_at` knows
    return toward, -np.eye(3)[1] if along and view_up is None and is_placed(volume) else up


def is_placed(volume: Volume) -> bool:
    """Whether a volume says where it lies, as those of scanners do."""
    return volume.direction is not None or bool(np.any(np.asarray(volume.origin)))


def _up(volume: Volume, transfer: Transfer) -> tuple[int, float]:
    """The axis that points up, and whether it does so forward or backward."""
    known = is_placed(volume)
    if not known and isinstance(transfer, TransferFunction):  # what is given may be fog
        with warnings.catch_warnings(action="ignore"):  # which were given before
            transfer = automatic_transfer(volume)
    visible, found, most = _visible(volume, transfer, FAINT), (2, 1.0), CUT_FACE
    for axis in () if known else (2, 1, 0):
        low, high = (float(visible.take(end, axis).mean()) for end in (0, -1))
        cut, other, sign = (low, high, 1.0) if low >= high else (high, low, -1.0)
        if cut > most and other <= OTHER_FACE * cut:
            found, most = (axis, sign), cut
    return found


def visible_points(volume: Volume, transfer: Transfer, least: float = VISIBLE) -> Float[np.ndarray, "n 3"]:
    """World points around what is shown, without specks; else the volume's corners."""
    from scipy.ndimage import label, maximum_filter
    from scipy.spatial import ConvexHull, QhullError

    visible, last = _visible(volume, transfer, least), np.array(volume.shape) - 1
    grid = CORNERS * last
    if visible.any():
        found: Any = label(maximum_filter(visible, REACH))  # scipy's types allow a number, too
        pieces = visible * found[0]
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        shown = (sizes >= SPECK * sizes.max())[pieces]
        rows = shown.any(axis=2)  # of voxels along z, of which only the ends count
        ends = shown.argmax(axis=2)[rows], shown.shape[2] - 1 - shown[..., ::-1].argmax(axis=2)[rows]
        voxels = np.concatenate([np.column_stack([*np.nonzero(rows), z]) for z in ends]).astype(np.float64)
        with suppress(QhullError):  # voxels in a plane have no hull, and all are kept
            voxels = voxels[ConvexHull(voxels).vertices]
        around = stride_of(volume.shape) * voxels[:, None] + 2 * CORNERS - 1  # a voxel ends at the next
        grid = np.clip(around.reshape(-1, 3), 0, last)
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction, np.float64)
    return np.asarray(volume.origin, np.float64) + (grid * np.asarray(volume.spacing, np.float64)) @ turn.T


def clipped_points(
    points: Float[np.ndarray, "n 3"], planes: Sequence[tuple[Any, Any]]
) -> Float[np.ndarray, "m 3"]:
    """Points whose hull is what planes (point, normal) leave of the given hull, if anything."""
    for at, normal in planes:
        height = (points - np.asarray(at, float)) @ np.asarray(normal, float)
        kept, cut, above = points[height >= 0], points[height < 0], height[height >= 0][:, None]
        share = above / np.maximum(above - height[height < 0], 1e-30)
        crossing = kept[:, None] + share[..., None] * (cut[None] - kept[:, None])
        points = np.concatenate([kept, crossing.reshape(-1, 3)])
    return points


def _visible(volume: Volume, transfer: Transfer, least: float) -> Bool[np.ndarray, "nx ny nz"]:
    """Which of the volume's `sampled` voxels a transfer function shows with at least this opacity."""
    data, shown = sampled(volume), sized(transfer, volume)
    if isinstance(shown, TransferFunction):
        extinction = np.interp(data, np.asarray(shown.values), np.asarray(shown.extinction))
    elif isinstance(shown, LabelTransferFunction) and volume.labels is not None:
        extinction, kinds = np.zeros(data.shape), sampled(volume, volume.labels)
        factors = np.asarray(shown.opacity) * np.asarray(shown.shown)
        functions = map(np.asarray, (shown.stacked.values, shown.stacked.extinction))
        for kind, (values, own) in enumerate(zip(*functions, strict=True)):
            extinction[kinds == kind] = factors[kind] * np.interp(data[kinds == kind], values, own)
    else:
        return np.ones(data.shape[:3], bool)
    return -np.expm1(-extinction * unit_of(volume)) > least


def warn_of_distance(volume: Volume, others: Sequence[tuple[Volume, Transfer]]) -> None:
    """Say so of a volume that does not meet the first one: mostly a file does not say where it lies."""
    for number, (other, _) in enumerate(others):
        low, high = np.asarray(volume.bounds).reshape(3, 2).T
        first, last = np.asarray(other.bounds).reshape(3, 2).T
        if (last < low).any() or (first > high).any():
            ends = (f"{pasted(a)} to {pasted(b)}" for a, b in ((first, last), (low, high)))
            told = f"others[{number}], from {next(ends)}, does not meet the volume, from {next(ends)}"
            warnings.warn(f"{told}: do spacing and origin suit?", stacklevel=4)


def framed(
    camera: Camera,
    points: Float[np.ndarray, "n 3"],
    views: Sequence[Camera] = (),
    *,
    centered: bool = False,
) -> Camera:
    """A camera with the directions, the angle and the size of another, placed so that the points just fill
    its picture, the whole window, their middle in its middle if `centered`; or those of all `views` of it,
    turned about that.

    From a distance D, a point that lies x across from the focal point, and z nearer, is in the picture if
    |x| <= t (D - z), where t is the tangent of half the angle. For parallel rays, z does not count, and D is
    the half height of the view."""
    from scipy.optimize import brentq

    def excess(shift: float, across: Float[np.ndarray, " n"], depth: Float[np.ndarray, " n"]) -> float:
        seen = (across - shift) / depth  # 0 where as much is free on both sides
        return float(seen.max() + seen.min())

    centered, views = centered or len(views) > 1, views or [camera]
    width, height = camera.size
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    perspective = camera.parallel_scale is None
    tangent = np.tan(np.deg2rad(float(camera.view_angle)) / 2) if perspective else 1.0
    t = tangent / MARGIN * np.array([width / height, 1])
    focal, distance = middle, 0.0
    free, front = NEAREST * float(np.linalg.norm(np.ptp(points, axis=0))), 0.0
    for view in views:
        right, up, forward = (np.asarray(axis, np.float64) for axis in axes_of(view, np))
        axes = np.stack([right, up], axis=1)
        across, depth = (points - middle) @ axes / t, -(points - middle) @ forward
        nearer, front = depth * perspective, max(front, float(depth.max()))
        one, other = ((nearer[:, None] + side * across).max(axis=0) for side in (1, -1))
        needed = np.maximum(one, other) if centered else (one + other) / 2
        distance = max(distance, float(nearer.max()) + free * perspective, *needed.tolist())
        if not centered:
            away = distance - nearer if perspective else np.ones(len(points))
            shifts = [brentq(excess, x.min(), x.max(), (x, away)) for x in across.T]
            focal = middle + axes @ (t * np.array(shifts))
    away = np.asarray(camera.position) - np.asarray(camera.focal_point, np.float64)
    # an orthographic camera shows what is before it, too
    length = distance if perspective else max(float(np.linalg.norm(away)), front + free)
    return Camera(
        focal + away * (length / np.linalg.norm(away)),
        focal,
        camera.view_up,
        camera.view_angle,
        size=camera.size,
        parallel_scale=None if perspective else distance,
    )
