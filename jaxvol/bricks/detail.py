"""Which level of detail is fine enough for an image?

Either by size: voxels no larger than a pixel. Or by content: values that the transfer function tells apart
are in the coarse level where they are in the finest one.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._util.checks import number
from ..camera import Camera, axes_of
from ..transfer import Transfer
from ..variation import Windows
from .sources import VoxelSource
from .summary import Summary, over_intervals


Edges = list[np.ndarray]
"""Along x, y, z: the ends of blocks, (2, blocks)."""


def level_for(
    levels: Sequence[VoxelSource],
    camera: Camera,
    transfer: Transfer | None = None,
    summaries: Sequence[Summary] | None = None,
    *,
    pixels: float = 1.0,
    tolerance: float | None = None,
) -> int:
    """The index of the coarsest level that is fine enough.

    Without `tolerance`: the coarsest whose voxels are not larger than `pixels` pixels at the nearest point
    that may be visible (`nearest_pixel`). An axis along which a level is as fine as the finest does not count
    against it. With `tolerance`: the coarsest whose `range_error` does not exceed it, whatever its size.

    **Arguments:**

    - `levels`: of the same volume, finest first, all with spacing and origin (`levels_of`).
    - `camera`: the view.
    - `transfer`, `summaries`: the transfer function, and the summary of each level (with `tolerance`) or at
      least of the finest. Without them, every point of the volume may be visible.
    - `pixels`: how many pixels a voxel may cover.
    - `tolerance`: an opacity, in (0, 1).

    **Returns:** the index, 0 for the finest.

    **Raises:** `ValueError` for several levels of which one has no place in the world, and for a tolerance
    without transfer function and summaries.
    """
    if len(levels) == 1:
        return 0
    for number_of, level in enumerate(levels):
        if level.spacing is None or level.origin is None:
            raise ValueError(
                f"levels must have spacing and origin; level {number_of} ({level.name}) has none."
            )
    if tolerance is not None:
        most = float(number("tolerance", tolerance, above=0, below=1))
        if transfer is None or summaries is None or len(summaries) != len(levels):
            raise ValueError(
                f"tolerance needs a transfer function and one summary for each of {len(levels)} levels; got "
                f"transfer={transfer!r} and {0 if summaries is None else len(summaries)} summaries."
            )
        return max(k for k in range(len(levels)) if range_error(levels, summaries, k, transfer) <= most)
    pixel = float(number("pixels", pixels, above=0)) * nearest_pixel(
        levels[0], camera, transfer, None if summaries is None else summaries[0]
    )
    finest = np.array(levels[0].spacing)
    allowed = np.maximum(pixel, finest) * (1 + 1e-6)  # spacings of equal length may be rounded
    return max(k for k, level in enumerate(levels) if k == 0 or np.all(np.array(level.spacing) <= allowed))


def nearest_pixel(
    source: VoxelSource,
    camera: Camera,
    transfer: Transfer | None = None,
    summary: Summary | None = None,
) -> float:
    """Side of a pixel, world length, at the nearest point of a volume that may be visible: in the view, and
    in a block in which the transfer function shows anything. Infinite if nothing is visible; 0 for a camera
    within such a block.

    It is the shorter side of the pixel's intersection with a plane parallel to the image."""
    shown = _Camera.of(camera)
    if transfer is None or summary is None:
        edges = [np.array([[0.0], [n - 1.0]]) for n in source.shape]
        visible = np.ones((1, 1, 1), bool)
    else:
        edges = [_nodes(summary, axis) for axis in range(3)]
        visible = summary.where(transfer.visible)
    edges = _in_world(source, edges)
    for normal, offset in shown.sides:
        visible = visible & (_greatest(normal, edges) + offset >= 0)
    nearest, farthest = (sign * _greatest(sign * shown.forward, edges) - shown.depth for sign in (-1, 1))
    visible = visible & (farthest > 0)
    if not visible.any():
        return np.inf
    return shown.pixel * (max(float(nearest[visible].min()), 0.0) if shown.perspective else 1.0)


def range_error(
    levels: Sequence[VoxelSource], summaries: Sequence[Summary], level: int, transfer: Transfer
) -> float:
    """How much of what the transfer function shows a level loses or adds, in [0, 1].

    The value varies continuously, so that a block shows the extinction and emission (extinction × colour) of
    every value in its range. Take a value that one level has in a block: how far is its extinction or
    emission from that of the nearest value that the other level has there, at the most? This is bounded by
    the variation of extinction and emission over the part of the one range that the other does not reach.
    The greatest of these bounds over all blocks, both ways, is a difference of extinction, e; the error is
    the opacity of a layer of that extinction as thick as a block of the finest level:
    1 - exp(-e · thickness).

    So an error of 0 means that everything is there within a block of its place: a thin vessel that averaging
    has dimmed counts, a surface that has moved by less than a block does not. It is no bound of the
    difference of two images. Ranges of blocks that only overlap a block count as its own, which forgives
    displacements of up to a block. 1 for a transfer function that reads the gradient, of which ranges of
    values tell nothing, and where it tells nothing of its variation.

    **Arguments:**

    - `levels`, `summaries`: of the same volume, finest first, and the summary of each.
    - `level`: the index of the one that is compared with the finest.
    - `transfer`: the transfer function.

    **Returns:** the opacity.
    """
    fine, coarse = ((levels[k], summaries[k]) for k in (0, level))
    if level == 0 or transfer.reads_gradient:
        return float(level > 0)
    e = max(_unmatched(transfer, *fine, *coarse), _unmatched(transfer, *coarse, *fine))
    thickness = summaries[0].cell * max(_known(levels[0].spacing))
    return float(-np.expm1(-e * thickness))


def _unmatched(
    transfer: Transfer, source: VoxelSource, summary: Summary, other: VoxelSource, others: Summary
) -> float:
    """The greatest variation, 1/length, over the values of a block of one level that are outside the range
    which the other level has there."""
    edges = _in_world(source, [_nodes(summary, axis) for axis in range(3)])
    low, high = others.ranges["low"], others.ranges["high"]
    for axis, edge in enumerate(edges):
        index = (edge - _known(other.origin)[axis]) / _known(other.spacing)[axis]
        first, last = np.floor(index[0] + 1e-5), np.ceil(index[1] - 1e-5)
        ends = np.clip([first, last], 0, other.shape[axis] - 1).astype(int)
        touched = [others.blocks_of(a, b, other.shape[axis]) for a, b in ends.T.tolist()]
        low, high = (
            over_intervals(low, axis, touched, np.minimum),
            over_intervals(high, axis, touched, np.maximum),
        )
    own_low, own_high = (jnp.asarray(summary.ranges[name], jnp.float32) for name in ("low", "high"))
    low, high = (jnp.asarray(part, jnp.float32) for part in (low, high))
    greatest = 0.0
    for begin, end in (
        (own_low, jnp.maximum(own_low, low)),
        (jnp.minimum(own_high, high), own_high),
    ):
        total = transfer.variation(Windows(begin, end, jnp.zeros_like(begin))).total
        greatest = max(greatest, float(jnp.max(jnp.where(begin < end, total, 0))))
    return greatest


class _Camera(NamedTuple):
    """What of a camera tells how large a pixel is.

    - `forward`, `depth`: the depth of a point p is forward · p - depth.
    - `sides`: a point is in the view if normal · p + offset is not negative for each of them.
    - `pixel`: shorter side of a pixel: at depth 1 in perspective, else everywhere.
    """

    forward: np.ndarray
    depth: float
    sides: list[tuple[np.ndarray, float]]
    pixel: float
    perspective: bool

    @classmethod
    def of(cls, camera: Camera) -> "_Camera":
        right, up, forward = (np.asarray(axis, float) for axis in axes_of(camera))
        position, window = np.asarray(camera.position, float), np.asarray(camera.window, float)
        perspective, half = camera.parallel_scale is None, np.deg2rad(float(camera.view_angle)) / 2
        scale = float(np.tan(half)) if camera.parallel_scale is None else float(camera.parallel_scale)
        sides = []
        for axis, (first, last) in ((right, window[:2]), (up, window[2:])):
            for sign, edge in ((1, first), (-1, last)):
                normal = sign * (axis - scale * edge * forward) if perspective else sign * axis
                sides.append((normal, -normal @ position - (0 if perspective else sign * scale * edge)))
        width, height = camera.size
        pixel = scale * min((window[1] - window[0]) / width, (window[3] - window[2]) / height)
        return cls(forward, float(forward @ position), sides, float(pixel), perspective)


def _nodes(summary: Summary, axis: int) -> np.ndarray:
    """The first and the last node of each block along an axis, (2, blocks)."""
    last = summary.shape[axis] - 1
    first = np.arange(0, last, summary.cell, dtype=float)
    return np.stack([first, np.minimum(first + summary.cell, last)])


def _in_world(source: VoxelSource, edges: Edges) -> Edges:
    place = zip(_known(source.origin, 0.0), _known(source.spacing), edges, strict=True)
    return [origin + spacing * nodes for origin, spacing, nodes in place]


def _greatest(normal: np.ndarray, edges: Edges) -> np.ndarray:
    """The greatest normal · p over the points p of each block."""
    x, y, z = (np.maximum(*(n * edge)) for n, edge in zip(normal, edges, strict=True))
    return x[:, None, None] + y[:, None] + z


def _known(place: tuple[float, float, float] | Any, default: float = 1.0) -> tuple[float, float, float]:
    return (default, default, default) if place is None else place
