"""How does a volume look of which nothing is known? A transfer function from its histogram, and colours for
labels."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from ._util.checks import described, is_traced
from .display import from_srgb
from .labels import LabelTransferFunction
from .transfer import Transfer, TransferFunction, extinction_of
from .volume import Volume


SAMPLED = 2**21
"""Voxels, at most, of which the histogram is made."""

BINS = 256

ACROSS = 100
"""Opacities below refer to this part of the volume's diagonal."""

CUT = 0.25
"""Part of the voxels at the volume's faces from which on they cut through what they hold."""


def automatic_transfer(volume: Volume | Any) -> TransferFunction:
    """A transfer function that shows what a volume holds, from its histogram.

    Two thresholds part the values into three classes so that the variance within each is least (Otsu): what
    is around the object, the object, and what is dense in it. The border of the object is shown translucent,
    what is dense in it nearly opaque. Where the volume's faces cut through the object, as through the body in
    most CT scans, the object would be a block: only what is dense is shown then, and its surroundings are
    faint.

    It is a guess. Opacities refer to a part of the volume's diagonal, so that they do not depend on its
    units.

    **Arguments:** `volume`: the `Volume`. Of more than 2 million voxels, every n-th is looked at.

    **Returns:** the `TransferFunction`.

    **Raises:** `ValueError` for what is no volume, or traced.

    Source: Otsu, "A Threshold Selection Method from Gray-Level Histograms", 1979.
    """
    if not isinstance(volume, Volume) or is_traced(volume.data):
        raise ValueError(f"volume must be a jaxvol Volume, not traced; got {described(volume)}.")
    values = _sampled(np.asarray(volume.data))
    low, high = float(values.min()), float(values.max())
    if not low < high:
        ends = [low, low + max(abs(low), 1.0)]
        return TransferFunction(ends, [_linear(TISSUE)] * 2, extinction_of([0.5] * 2, _unit(volume)))
    first, second = thresholds(values)
    faces = _faces(np.asarray(volume.data))
    points = _shell(low, first, second, high) if np.mean(faces > first) < CUT else _dense(first, second, high)
    at, colors, opacities = zip(*points, strict=True)
    return TransferFunction(
        np.array(at), np.array([_linear(c) for c in colors]), extinction_of(opacities, _unit(volume))
    )


EDGE, SKIN, TISSUE, DENSE, BRIGHT = (
    (70, 30, 18),
    (214, 130, 92),
    (190, 92, 62),
    (236, 208, 160),
    (255, 246, 226),
)
"""Colours, 8-bit sRGB: of the border's foot, the border, the object, what is dense, and what is densest."""


def _shell(low: float, first: float, second: float, high: float) -> list[tuple[float, Any, float]]:
    w = min(first - low, second - first) / 3
    d = (second - first) / 4
    return [
        (first - w, EDGE, 0.0),
        (first, SKIN, 0.3),
        (first + w, SKIN, 0.07),
        (second - d, TISSUE, 0.04),
        (second, DENSE, 0.45),
        (max((second + high) / 2, second + d / 2), BRIGHT, 0.9),
    ]


def _dense(first: float, second: float, high: float) -> list[tuple[float, Any, float]]:
    d = (second - first) / 4
    return [
        (second - 2 * d, EDGE, 0.0),
        (second - d, TISSUE, 0.02),
        (second, DENSE, 0.45),
        (max((second + high) / 2, second + d / 2), BRIGHT, 0.9),
    ]


def thresholds(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Otsu's two thresholds. Between classes that are far apart any threshold is as good: the middle of their
    means is taken, where the border between them lies in a scan."""
    from skimage.filters import threshold_multiotsu

    low, high = (float(end) for end in np.percentile(values, (0, 99.9)))
    high = high if high > low else float(values.max())
    kept = np.clip(values, low, high)
    try:
        first, second = threshold_multiotsu(kept, 3, nbins=BINS)
    except ValueError:  # of fewer than three values
        first, second = low + (high - low) / 3, low + 2 * (high - low) / 3
    for _ in range(3):  # strays at the edge of a class join the nearer one
        classes = [kept[kept <= first], kept[(kept > first) & (kept <= second)], kept[kept > second]]
        if min(map(len, classes)) == 0:
            break
        means = [float(each.mean(dtype=np.float64)) for each in classes]
        first, second = (means[0] + means[1]) / 2, (means[1] + means[2]) / 2
    return float(first), float(second)


FEWEST_FLAT = 0.8
"""Part of the voxels, of those that are not the lowest, whose neighbour has the same value: above it, whole
numbers are taken for labels. It was 0.92 in a segmented frog, 0.25 at most in twelve scans and simulations,
and 0.46 at most in phantoms."""

MOST_LABELS = 64

INSIDE = 255
"""Value of what has a label, in the volume that is shown."""


def labels_shown(volume: Volume) -> tuple[Volume, LabelTransferFunction] | None:
    """How a volume is shown whose voxels are labels; None if they seem to be none.

    Voxels are taken for labels if they are whole numbers of few kinds, and nearly all of a kind lie beside
    others of it. The lowest is what is around.

    **Returns:** a volume in the same place, whose values are smooth, 255 inside of all labels, and whose
    labels reach one voxel beyond; and a transfer function that shows what is inside, each label in its own
    colour."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    data = np.asarray(volume.data)
    kinds = _kinds(data)
    if kinds is None:
        return None
    labels = np.searchsorted(kinds, data).astype(np.uint8)
    share = gaussian_filter((labels > 0).astype(np.float32), LABEL_BLUR)
    beyond = np.where(labels > 0, labels, maximum_filter(labels, size=5))
    shown = Volume(
        *(np.round(INSIDE * share).astype(np.uint8), volume.spacing, volume.origin, beyond),
        direction=volume.direction,
    )
    functions = {}
    for label in range(1, len(kinds)):
        color = _linear(np.array(COLORS[(label - 1) % len(COLORS)]))
        opacity = extinction_of([0.0, 0.0, 0.9], _unit(volume))
        functions[label] = TransferFunction([0, 0.35 * INSIDE, 0.65 * INSIDE], [color] * 3, opacity)
    return shown, LabelTransferFunction(functions)


LABEL_BLUR = 0.8
"""Voxels by which the border of what has a label is smoothed, so that it has a gradient."""

COLORS = (
    *((31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75)),
    *((227, 119, 194), (188, 189, 34), (23, 190, 207), (174, 199, 232), (255, 187, 120), (152, 223, 138)),
    *((255, 152, 150), (197, 176, 213), (196, 156, 148), (247, 182, 210), (219, 219, 141), (158, 218, 229)),
)
"""Colours of labels, 8-bit sRGB: those of matplotlib's tab20 without its greys, one of each pair first."""


def _kinds(data: Shaped[np.ndarray, "nx ny nz"]) -> Shaped[np.ndarray, " n"] | None:
    """The labels, in order, if the voxels are labels."""
    if data.dtype.kind not in "iu":
        return None
    inside = data[:-1] != data.min()
    if not inside.any() or np.mean(data[:-1][inside] == data[1:][inside]) < FEWEST_FLAT:
        return None
    kinds = np.unique(data)
    return kinds if 2 < len(kinds) <= MOST_LABELS else None


SEEN = 0.1
"""Opacity, of a part ACROSS of the diagonal, from which on a voxel counts as visible."""

STRAYS = 0.3
"""Percent of the visible voxels that may lie outside on each side."""


def visible_box(volume: Volume, transfer: Transfer) -> Volume:
    """The box in which nearly all lies that a transfer function shows, as a volume of 2³ voxels to look at:
    that of the whole volume, where nothing is visible. Transfer functions are those made here."""
    stride = _stride(volume.shape)
    data = np.asarray(volume.data)[::stride, ::stride, ::stride]
    if isinstance(transfer, LabelTransferFunction):
        seen = data > INSIDE / 2
    else:
        assert isinstance(transfer, TransferFunction)
        extinction = np.interp(data, np.asarray(transfer.values), np.asarray(transfer.extinction))
        seen = -np.expm1(-extinction * _unit(volume)) > SEEN
    places = [stride * axis for axis in np.nonzero(seen)]
    if not len(places[0]):
        return volume
    low, high = np.array([np.percentile(axis, (STRAYS, 100 - STRAYS)) for axis in places]).T
    margin = np.maximum(0.04 * (high - low), 1)
    low = np.maximum(low - margin, 0)
    high = np.minimum(high + margin, np.array(volume.shape) - 1)
    spacing = np.asarray(volume.spacing)
    turn = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    origin = np.asarray(volume.origin) + turn @ (low * spacing)
    return Volume(np.zeros((2, 2, 2), np.uint8), (high - low) * spacing, origin, direction=volume.direction)


def _unit(volume: Volume) -> float:
    low, high = (np.asarray(corner) for corner in volume.corners)
    return float(np.linalg.norm(high - low)) / ACROSS


def _linear(color: Any) -> Any:
    return np.asarray(from_srgb(np.array(color) / 255))


def _sampled(data: Shaped[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, " n"]:
    stride = _stride(data.shape)
    return data[::stride, ::stride, ::stride].ravel().astype(np.float32)


def _stride(shape: tuple[int, ...]) -> int:
    """Of which voxels along each axis at most SAMPLED are left."""
    stride = 1
    while math.prod(-(-n // stride) for n in shape) > SAMPLED:
        stride += 1
    return stride


def _faces(data: Shaped[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, " n"]:
    faces = [data[end].ravel() for end in (0, -1)] + [data[:, end].ravel() for end in (0, -1)]
    faces += [data[..., end].ravel() for end in (0, -1)]
    return np.concatenate(faces).astype(np.float32)
