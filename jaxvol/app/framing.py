"""Cameras framed on the visible part of a volume."""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, cast

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


VISIBLE = 0.1  # least opacity of a visible voxel, along a hundredth of the volume's diagonal
FAINT = 0.01  # the same under a user's transfer function, and to find the face that an object stands on
SPECK = 0.02  # pieces smaller than this fraction of the largest one are left out of the picture
REACH = 3  # side of the cube, in voxels, that connects visible voxels to a piece, as the leaves of a tree
NEAREST = 0.1  # least distance of the camera from the visible points, as a fraction of their diagonal
MARGIN = 1.06  # size of the picture over that of the visible points
CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T  # of the unit cube
FRONT = (0.5, -1.0, 0.4)  # from the volume to the camera, where z is up: to the right, in front, and higher
SLAB = 0.2  # shortest side over the middle one, below which a volume is seen from its broad side

CUT_FACE, OTHER_FACE = 0.1, 1 / 3
"""An object stands on a face of the volume of which it covers more than `CUT_FACE`, if it covers at most
`OTHER_FACE` times as much of the opposite one: the neck, or the pot of a plant."""


def automatic_camera(
    volume: Volume | Sequence[Volume],
    transfer: Transfer | Sequence[Transfer],
    direction: Arrayable | None = None,
    view_up: Arrayable | None = None,
    view_angle: Arrayable = 30.0,
    *,
    parallel: bool = False,
    size: Sequence[int] | int = (512, 512),
    least: float = VISIBLE,
    centered: bool = False,
) -> Camera:
    """A camera framed on the visible part of a volume, without specks, and upright.

    Args:
        volume: the volume; or a list of volumes, as for `render`, the first of which is upright.
        transfer: a `TransferFunction` or `LabelTransferFunction`; under other kinds, the whole volume counts
            as visible. For a list of volumes, a list with one for each.
        direction: from the volume to the camera; by default to the right, in front, and higher.
        view_up: by default z, or from straight above or below -y, where a patient's front is. For a volume
            with origin 0 and the world's axes, as of raw files: away from the face that the object stands on
            (the neck, the pot of a plant), if `automatic_transfer` shows much more on it than on the opposite
            one.
        view_angle: degrees.
        parallel: whether the camera is orthographic.
        size: (width, height) of the image in pixels.
        least: least opacity of a visible voxel, along a hundredth of the volume's diagonal; 0.01 for fog.
        centered: whether the focal point is the middle of the visible part, as for an orbit about it. The
            camera is then farther away (by 1.03 to 1.3 in eight scans), since perspective shows the near part
            larger.

    Returns:
        The `Camera`.

    Raises:
        ValueError: as `Camera.looking_at` does, for a `view_up` along `direction`, and for traced arguments.
    """
    pairs = cast(list[tuple[Volume, Transfer]], pairs_of(volume, transfer) or [(volume, transfer)])
    volume, transfer = pairs[0]
    check_arguments("automatic_camera(volume, transfer)", volume=volume, transfer=transfer)
    check_known("automatic_camera", pairs, direction, view_up, view_angle)
    with jax.ensure_compile_time_eval():  # also inside jax.jit
        side = upright(volume, transfer, direction, view_up)
        camera = Camera.looking_at(volume, *side, view_angle, parallel=parallel, size=size)
        points = np.concatenate([visible_points(*pair, least) for pair in pairs])
        return framed(camera, points, centered=flag("centered", centered))


def upright(
    volume: Volume, transfer: Transfer, direction: Arrayable | None, view_up: Arrayable | None
) -> tuple[Any, Any]:
    """Direction and view up; where they are None, the defaults of `automatic_camera`."""
    axis, sign = (2, 1.0) if view_up is not None else _up(volume, transfer)
    front = np.roll(FRONT, axis + 1)  # its height lies along the axis
    front[axis] *= sign
    extent = np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    thin = int(np.argmin(extent))
    if extent[thin] < SLAB * np.median(extent):
        front = 0.3 * front
        front[thin] = 1.0 if front[thin] >= 0 else -1.0
        axis, sign = (axis, sign) if axis != thin else (1, 1.0)
        front = front if volume.direction is None else np.asarray(volume.direction) @ front
    toward = np.asarray(finite_array("direction", front if direction is None else direction, (3,)))
    up = np.asarray(finite_array("view_up", sign * np.eye(3)[axis] if view_up is None else view_up, (3,)))
    is_along = np.linalg.norm(np.cross(toward, up)) <= 1e-3 * np.linalg.norm(toward) * np.linalg.norm(up)
    if is_along and view_up is not None and np.any(up) and np.any(toward):
        raise ValueError(f"view_up must not point along direction, {pasted(toward)}; got {pasted(up)}.")
    # a patient's front lies at -y; `Camera.looking_at` knows the default of other volumes
    return toward, -np.eye(3)[1] if is_along and view_up is None and is_placed(volume) else up


def is_placed(volume: Volume) -> bool:
    """True if a volume has a place in the world, as those of scanners do."""
    return volume.direction is not None or bool(np.any(np.asarray(volume.origin)))


def _up(volume: Volume, transfer: Transfer) -> tuple[int, float]:
    """The axis that points up, and its sign."""
    up = 2, 1.0
    if is_placed(volume):
        return up
    if isinstance(transfer, TransferFunction):  # the given one may show fog
        with warnings.catch_warnings(action="ignore"):  # which were given before
            transfer = automatic_transfer(volume)
    visible, threshold = _visible(volume, transfer, FAINT), CUT_FACE
    for axis in (2, 1, 0):
        low, high = (float(visible.take(end, axis).mean()) for end in (0, -1))
        cut, opposite, sign = (low, high, 1.0) if low >= high else (high, low, -1.0)
        if cut > threshold and opposite <= OTHER_FACE * cut:
            up, threshold = (axis, sign), cut
    return up


def visible_points(
    volume: Volume, transfer: Transfer, min_opacity: float = VISIBLE
) -> Float[np.ndarray, "n 3"]:
    """World points around the visible voxels, without specks; the volume's corners if there are none."""
    from scipy.ndimage import label, maximum_filter
    from scipy.spatial import ConvexHull, QhullError

    visible, last = _visible(volume, transfer, min_opacity), np.array(volume.shape) - 1
    grid = CORNERS * last
    if visible.any():
        labelled: Any = label(maximum_filter(visible, REACH))  # scipy's types allow a number, too
        pieces = visible * labelled[0]
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
    """Points of the hull of `points` clipped by planes (origin, normal); none if nothing remains."""
    for origin, normal in planes:
        height = (points - np.asarray(origin, float)) @ np.asarray(normal, float)
        kept, cut, above = points[height >= 0], points[height < 0], height[height >= 0][:, None]
        share = above / np.maximum(above - height[height < 0], 1e-30)
        crossing = kept[:, None] + share[..., None] * (cut[None] - kept[:, None])
        points = np.concatenate([kept, crossing.reshape(-1, 3)])
    return points


def _visible(volume: Volume, transfer: Transfer, min_opacity: float) -> Bool[np.ndarray, "nx ny nz"]:
    """Mask of the volume's `sampled` voxels that are more opaque than `min_opacity`."""
    data, shown = sampled(volume), sized(transfer, volume)
    if isinstance(shown, TransferFunction):
        extinction = np.interp(data, np.asarray(shown.values), np.asarray(shown.extinction))
    elif isinstance(shown, LabelTransferFunction) and volume.labels is not None:
        extinction, kinds = np.zeros(data.shape), sampled(volume, volume.labels)
        factors = np.asarray(shown.opacity) * np.asarray(shown.shown)
        functions = map(np.asarray, (shown.stacked.values, shown.stacked.extinction))
        for kind, function in enumerate(zip(*functions, strict=True)):
            extinction[kinds == kind] = factors[kind] * np.interp(data[kinds == kind], *function)
    else:
        return np.ones(data.shape[:3], bool)
    return -np.expm1(-extinction * unit_of(volume)) > min_opacity


def warn_of_gap(volume: Volume, pairs: Sequence[tuple[Volume, Transfer]]) -> None:
    """Warn of volumes of `pairs` that do not overlap the first one, mostly since a file has no origin."""
    for number, (added, _) in enumerate(pairs):  # bounds in here: without `pairs`, they compile nothing
        low, high = np.asarray(volume.bounds).reshape(3, 2).T
        first, last = np.asarray(added.bounds).reshape(3, 2).T
        if (last < low).any() or (first > high).any():
            place = f"others[{number}], from {pasted(first)} to {pasted(last)},"
            bounds = f"does not meet the volume, from {pasted(low)} to {pasted(high)}"
            warnings.warn(f"{place} {bounds}: do spacing and origin suit?", stacklevel=4)


def framed(
    camera: Camera, points: Float[np.ndarray, "n 3"], views: Sequence[Camera] = (), *, centered: bool = False
) -> Camera:
    """`camera` moved along its direction and across it so that the points just fill the whole window, with
    their middle in its middle if `centered`; or so that they fit into all `views` of an orbit about them.

    From a distance D, a point that lies x across from the focal point, and z nearer, is in the picture if
    |x| <= t (D - z), where t is the tangent of half the angle. For parallel rays, z does not count, and D is
    the half height of the view."""
    from scipy.optimize import brentq

    def excess(shift: float, across: Float[np.ndarray, " n"], depth: Float[np.ndarray, " n"]) -> float:
        position = (across - shift) / depth
        return float(position.max() + position.min())  # 0 if the margins of both sides are equal

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
        upper, lower = ((nearer[:, None] + side * across).max(axis=0) for side in (1, -1))
        needed = np.maximum(upper, lower) if centered else (upper + lower) / 2
        distance = max(distance, float(nearer.max()) + free * perspective, *needed.tolist())
        if not centered:
            depths = distance - nearer if perspective else np.ones(len(points))
            shifts = [brentq(excess, x.min(), x.max(), (x, depths)) for x in across.T]
            focal = middle + axes @ (t * np.array(shifts))
    toward = np.asarray(camera.position) - np.asarray(camera.focal_point, np.float64)
    # an orthographic camera must stand in front of all points, too
    length = distance if perspective else max(float(np.linalg.norm(toward)), front + free)
    return Camera(
        focal + toward * (length / np.linalg.norm(toward)),
        focal,
        camera.view_up,
        camera.view_angle,
        size=camera.size,
        parallel_scale=None if perspective else distance,
    )
