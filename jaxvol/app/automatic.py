"""Default transfer functions: from a volume's histogram, or with a colour for each of its labels."""

import math
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped

from .._util.checks import Arrayable, described
from .._util.srgb import from_srgb
from .._util.texts import warn_caller
from .._util.voxels import faces_of, is_flat
from ..ray import check_arguments
from ..scene.labels import LabelTransferFunction
from ..scene.presets import colormap
from ..scene.transfer import Transfer, TransferFunction, extinction_of, voxel_size
from ..scene.volume import Volume, check_one_channel
from ..xla.memo import memoized_of
from ..xla.platform import is_traced


SAMPLED = 2**21  # most voxels of a sample
CUT = 0.25  # least fraction of object voxels at the faces of a volume that cuts through the object
BODY = 0.15  # least fraction of a body's voxels with all neighbours in it: 0.25 in scans, 0.09 in angiograms

IN_FRONT, THROUGH, THIN = 0.3, 1.2, 0.15
"""Largest optical depth of the object in front of dense material and all through it, as the median of rays
along the axes; and the opacity above which the object is thin."""

ROUGH, NOISY = 0.7, 0.1
"""Least second differences of grain, over first ones (scans: 0.6) and over the thresholds' distance."""

MOST_LABELS = 256  # most labels, or distinct integers that may be labels, as in a `LabelTransferFunction`
SPARSE = 0.06  # largest fraction of voxels above the background in angiograms
MIN_KINDS = 16  # distinct values left after strays are removed, at least
SMALL = 0.1  # voxel size below which presets, made for some 0.5 to 3 mm, would be nearly transparent
INSIDE = 255  # value of labelled voxels in the volume that is shown

EDGE, SKIN, TISSUE = (70, 30, 18), (214, 130, 92), (190, 92, 62)
DENSE, BRIGHT = (236, 208, 160), (255, 246, 226)
"""Colours, 8-bit sRGB: foot of the border, border, object, dense material, densest material."""

RARE, FAR, BEYOND = 1e-4, 0.25, 6.0
"""Strays: the largest fraction of the voxels, and the least gap to the range of all others, as a fraction of
that range; `BEYOND` is the least gap of a fill value above the others (below them: `FAR`)."""


class Spread(NamedTuple):
    """Range of values without strays: first percentile `usual`, background `fill` above or inf, `warning`."""

    low: float
    high: float
    usual: float
    fill: float
    warning: str

    def tame(self, data: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
        """Data with strays below the range and fill values at `usual`, and strays above it at `high`."""
        if not self.warning:
            return data
        usual, high = map(data.dtype.type, (self.usual, self.high))
        return np.where((data < self.low) | (data >= self.fill), usual, np.minimum(data, high))


def spread_of(values: Shaped[np.ndarray, "..."]) -> Spread:
    """The range of values without those far from all others: rare ones (hot or dead voxels), and single ones
    of any count (padding of CT). A single value above all others is background only beyond six times their
    range: a saturated object is no fill value."""
    kinds, counts = np.unique(values, return_counts=True)
    kinds, limit, removed, fill, more = kinds.astype(np.float64), RARE * counts.sum(), [], math.inf, True
    while more:
        if more := _strays(kinds, counts, limit):
            removed.append((kinds[0], counts[:more].sum()))
            kinds, counts = kinds[more:], counts[more:]
        above = _strays(-kinds[::-1], counts[::-1], limit)
        far = above == 1 and kinds[-1] - kinds[-2] > BEYOND * (kinds[-2] - kinds[0])
        if above and (far or counts[-above:].sum() <= limit):
            removed.append((kinds[-1], counts[-above:].sum()))
            fill = kinds[-1] if far else fill
            kinds, counts, more = kinds[:-above], counts[:-above], True
    parts = [f"{n / np.size(values):.2g} of the voxels hold {value:g}" for value, n in removed]
    warning = f"{', '.join(parts)}, far from all others: taken as background" if removed else ""
    usual = kinds[np.searchsorted(np.cumsum(counts), 0.01 * counts.sum())]
    return Spread(float(kinds[0]), float(kinds[-1]), float(usual), fill, warning)


def _strays(kinds: Float[np.ndarray, " n"], counts: np.ndarray, limit: float) -> int:
    """Number of the lowest values far below all others: one, or more in at most `limit` voxels."""
    n = min(max(int(np.searchsorted(np.cumsum(counts), limit, "right")), 1), len(kinds) - MIN_KINDS)
    far = np.flatnonzero(np.diff(kinds)[:n] > FAR * (kinds[-1] - kinds[1 : n + 1])) if n > 0 else np.empty(0)
    return int(far[-1]) + 1 if far.size else 0


def stride_of(shape: tuple[int, ...], max_voxels: int = SAMPLED) -> int:
    """Least stride along each axis that leaves at most `max_voxels` voxels."""
    stride = 1
    while math.prod(-(-n // stride) for n in shape) > max_voxels:
        stride += 1
    return stride


def sampled(volume: Volume, data: Arrayable = None) -> Shaped[np.ndarray, "nx ny nz *c"]:
    """Strided voxels of the volume, or of `data` on its grid."""
    stride = stride_of(volume.shape)
    return np.asarray(volume.data if data is None else data)[::stride, ::stride, ::stride]


def unit_of(volume: Volume) -> float:
    """Length to which opacities refer in any unit of the volume: a hundredth of its diagonal."""
    across = (np.array(volume.shape) - 1) * np.asarray(volume.spacing)
    across = across if volume.direction is None else np.asarray(volume.direction) @ across
    return float(np.linalg.norm(across)) / 100


def preset_unit(volume: Volume) -> float:
    """Length to which a preset's opacities refer: 1 mm, or the voxel size if that is far smaller."""
    size = float(voxel_size(volume))
    return size if size < SMALL else 1.0


def automatic_transfer(volume: Volume) -> TransferFunction:
    """A transfer function from a volume's histogram.

    Two thresholds (Otsu) divide the values into three classes of least variance: background, object, and
    dense material. The border of the object is shown translucent, dense material nearly opaque. Only dense
    material is shown where the object would hide it: where the volume's faces cut the object, as in most CT
    scans, and where the middle class is grain, as in ultrasound, or only the border of dense material, as in
    angiograms. Opacities do not depend on the volume's units.

    Args:
        volume: the `Volume`. Above 2 million voxels, every n-th along each axis counts.

    Returns:
        The `TransferFunction`.

    Raises:
        ValueError: for another type, and for a traced volume.

    Source: Otsu, "A Threshold Selection Method from Gray-Level Histograms", 1979.
    """
    if not isinstance(volume, Volume):
        raise ValueError(f"volume must be a jaxvol Volume; got {described(volume)}.")
    check_one_channel(volume, "automatic_transfer")
    check_known("automatic_transfer", volume)
    with jax.ensure_compile_time_eval():  # also inside jax.jit, of a volume from outside
        has_arrays = all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(volume))
        transfer, warnings = memoized_of(volume, _of_histogram) if has_arrays else _of_histogram(volume)
    for warning in warnings:
        warn_caller(warning)
    return transfer


def check_known(caller: str, *values: Any) -> None:
    """Refuse traced arguments of a function that reads voxels on the host."""
    if is_traced(values):
        raise ValueError(f"{caller} needs numbers, and some arguments are traced: call it outside jax.jit.")


def _of_histogram(volume: Volume) -> tuple[TransferFunction, list[str]]:
    """The transfer function, and warnings."""
    spread = spread_of(sampled(volume))
    notes = [spread.warning] if spread.warning else []
    if notes:
        volume = eqx.tree_at(lambda v: v.data, volume, jnp.asarray(spread.tame(np.asarray(volume.data))))
    values = sampled(volume).ravel().astype(np.float32)
    low, high = float(values.min()), float(values.max())
    if side := side_of_distance(volume):
        notes.append("values on both sides of 0 with a slope of one are a distance: shown where they are 0")
        d = side * float(voxel_size(volume)) / 2
        points = [(-d, BRIGHT, 0.9), (d, DENSE, 0.0)][::side]
    elif not low < high:
        points = [(low, TISSUE, 0.5), (low + max(abs(low), 1.0), TISSUE, 0.5)]
    else:
        first, second = thresholds(values)
        data = np.asarray(volume.data)
        d = (second - first) / 4
        points = [(second, DENSE, 0.45), (max((second + high) / 2, second + d / 2), BRIGHT, 0.9)]
        if np.mean(faces_of(data) > first) < CUT and is_body(data, first, second):
            depth, usual = depth_of_object(volume, first, second)
            w = min(first - low, second - first) / 3
            border = [(first - w, EDGE, 0.0), (first, SKIN, 0.3), (first + w, SKIN, max(0.07, depth))]
            if depth > THIN:  # such as leaves: no border, which noise also crosses
                border = [(first, EDGE, 0.0), (min(usual, second - 2 * d), SKIN, depth)]
            points = [*border, (second - d, TISSUE, depth), *points]
        else:
            foot, opacity = second - 2 * d, 0.02
            if np.mean(values > first) < SPARSE:  # vessels; thin ones are darker
                foot, opacity = first, 0.2
            points = [(foot, EDGE, 0.0), (second - d, TISSUE, opacity), *points]
    if spread.fill < math.inf:  # transparent, as the background
        last, opacity = max(high, points[-1][0]), points[-1][2]
        points += [(last + (high - low) * s, BRIGHT, level) for s, level in ((0.01, opacity), (0.02, 0.0))]
    at, colors, opacities = zip(*points, strict=True)
    linear = np.asarray(from_srgb(np.array(colors) / 255))
    return TransferFunction(np.array(at), linear, extinction_of(opacities, unit_of(volume))), notes


def side_of_distance(volume: Volume) -> int:
    """Sign outside of the surface, if values are signed distances from a surface, else 0."""
    data, step = sampled(volume).astype(np.float32), np.asarray(volume.spacing) * stride_of(volume.shape)
    if not (data.min() < 0 < data.max()) or min(data.shape) < 3:
        return 0
    slope = np.sqrt(sum(np.square(derivative) for derivative in np.gradient(data, *step.tolist())))
    if np.mean(np.abs(slope[slope > 0] - 1) < 0.1) < 0.7:
        return 0
    return 1 if np.mean(faces_of(data) > 0) > 0.5 else -1


def depth_of_object(volume: Volume, first: float, second: float) -> tuple[float, float]:
    """Opacity along `unit_of` of the object, values between two thresholds, at which dense material is seen
    through it, and a thin object is visible; and the object's mean value."""
    data, unit = sampled(volume), unit_of(volume)
    middle, dense = (data > first) & (data <= second), data > second
    in_front, through = [np.zeros(1)], []
    if not middle.any():
        return THIN, (first + second) / 2
    extent = np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    for axis, step in enumerate(extent / (np.maximum(np.array(data.shape) - 1, 1) * unit)):
        object_, stop = np.moveaxis(middle, axis, 0), np.moveaxis(dense, axis, 0)
        through.append(step * object_.sum(0)[object_.any(0)])
        for side in (1, -1):
            before, ends = np.cumsum(object_[::side], 0, np.int32), stop[::side].argmax(0)[None]
            in_front.append(step * np.take_along_axis(before, ends, 0)[0][stop.any(0)])
    depths = (IN_FRONT, in_front), (THROUGH, through)
    depth = min(limit / max(float(np.median(np.concatenate(lengths))), limit) for limit, lengths in depths)
    return -math.expm1(-depth), float(data[middle].mean(dtype=np.float64))


def thresholds(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Otsu's two thresholds, moved to the middle between the means of the adjacent classes."""
    from skimage.filters import threshold_multiotsu

    low, high = (float(end) for end in np.percentile(values, (0, 99.9)))
    high = high if high > low else float(values.max())
    clipped = np.clip(values, low, high)
    try:
        first, second = threshold_multiotsu(clipped, 3, nbins=256)
    except ValueError:  # fewer than three values
        first, second = low + (high - low) / 3, low + 2 * (high - low) / 3
    for _ in range(3):  # strays at the edge of a class join the nearer one
        classes = [clipped[clipped <= first], clipped[(clipped > first) & (clipped <= second)]]
        classes.append(clipped[clipped > second])
        if min(map(len, classes)) == 0:
            break
        means = [float(members.mean(dtype=np.float64)) for members in classes]
        first, second = (means[0] + means[1]) / 2, (means[1] + means[2]) / 2
    return float(first), float(second)


def range_of_object(volume: Volume) -> tuple[float, float]:
    """The range from the lower of the `thresholds` to the 99.5th percentile above it; not empty."""
    values = sampled(volume)
    spread = spread_of(values)
    if spread.warning:
        warn_caller(spread.warning)
    values = spread.tame(values).ravel().astype(np.float32)
    low, lowest = thresholds(values)[0], float(values.min())
    high = float(np.percentile(values[values >= low], 99.5))
    return (low, high) if low < high else (lowest, lowest + max(abs(lowest), 1.0))


def xray_transfer(volume: Volume, cmap: Arrayable, clim: tuple[float, float]) -> TransferFunction:
    """Extinction that grows over a range, scaled so that the brightest pixel along an axis is 1."""
    colors = colormap(cmap, clim)
    slope, brightest = np.linspace(0, 1, len(colors.values)), np.max(np.asarray(colors.colors), axis=1)
    emitted = np.interp(sampled(volume), colors.values, slope * brightest)
    steps = np.asarray(volume.spacing) * stride_of(volume.shape)
    peak = max(np.percentile(step * emitted.sum(axis), 99.9) for axis, step in enumerate(steps))
    return TransferFunction(colors.values, colors.colors, slope / (float(peak) or 1.0))


def brightest_mean(volume: Volume, low: float) -> float:
    """Greatest mean value along an axis (99.9th percentile of the rays); above `low`."""
    data = sampled(volume)
    highest = max(float(np.percentile(data.mean(axis, dtype=np.float64), 99.9)) for axis in range(3))
    return highest if highest > low else low + 1


def is_body(data: Shaped[np.ndarray, "nx ny nz"], first: float, second: float) -> bool:
    """True if values between the thresholds fill a body, rather than grain or borders."""
    if min(data.shape) < 3:
        return True
    stride = stride_of(data.shape)
    inner = [np.arange(1, n - 1, stride) for n in data.shape]

    def shifted(axis: int, by: int) -> Shaped[np.ndarray, "mx my mz"]:
        places = (places + by * (axis == number) for number, places in enumerate(inner))
        return data[np.ix_(*places)].astype(np.float32)

    center = shifted(0, 0)
    middle = (center > first) & (center <= second)
    if not middle.any():
        return True
    inside, bends, slopes = middle.copy(), 0.0, 0.0
    for axis in range(3):
        before, after = shifted(axis, -1), shifted(axis, 1)
        for neighbour in (before, after):
            inside &= (neighbour > first) & (neighbour <= second)
        bends += float(np.abs(2 * center - before - after)[middle].mean(dtype=np.float64)) / 3
        slopes += float(np.abs(after - before)[middle].mean(dtype=np.float64)) / 3
    is_grain = bends > ROUGH * slopes and bends > NOISY * (second - first)
    return bool(inside.sum() >= BODY * middle.sum()) and not is_grain


def labels_shown(volume: Volume, around: Transfer | None = None) -> tuple[Volume, LabelTransferFunction]:
    """A volume and a transfer function that show labels, each in a distinct colour, and can be lit: the
    volume's labels, or its values, if they seem to be labels.

    In and near labels, the values of the returned volume are smooth: from the least value to the greatest,
    which labelled voxels have. Labels reach two voxels farther, and are numbered from 1: label k has the id
    `label_ids[k]`.

    Args:
        volume: the `Volume`.
        around: the transfer function where the volume's labels are 0; by default that of
            `automatic_transfer`.

    Returns:
        The volume and its transfer function. If values are shown as labels, the lowest is transparent.

    Raises:
        ValueError: for another type, or a traced volume; and if the volume has no labels, or more than 256,
            and its values are not integers of 3 to 256 kinds, most of which equal their neighbour.
    """
    check_arguments("labels_shown(volume)", volume=volume)
    check_known("labels_shown", volume, around)
    if (labelled := labels_if_any(volume, around)) is None:
        count = 0 if volume.labels is None else len(np.unique(np.asarray(volume.labels)))
        raise ValueError(f"volume must have up to 256 labels, or values like labels; got {count or 'none'}.")
    return labelled


def labels_if_any(
    volume: Volume, around: Transfer | None = None
) -> tuple[Volume, LabelTransferFunction] | None:
    """The result of `labels_shown`, or None where it raises an error."""
    has_labels, data = volume.labels is not None, np.asarray(volume.data)
    ids = np.asarray(volume.labels) if has_labels else data
    if not has_labels and (ids.dtype.kind not in "iu" or not is_flat(ids)):
        return None
    kinds = np.unique(np.append(ids, 0) if has_labels else ids)
    if len(kinds) > MOST_LABELS or not (has_labels or len(kinds) > 2):
        return None

    import matplotlib
    from matplotlib.colors import ListedColormap, hsv_to_rgb
    from scipy.ndimage import gaussian_filter, maximum_filter

    labels = np.searchsorted(kinds, ids).astype(np.uint8)
    # smoothed, so that the border of a label has a gradient
    inside = gaussian_filter(np.where(labels > 0, np.float32(1), np.float32(0)), 0.8)
    beyond = np.where(labels > 0, labels, maximum_filter(labels, size=5))
    low, high, kind = (data.min(), data.max(), data.dtype) if has_labels else (0, INSIDE, np.dtype(np.uint8))
    low, high = float(low), float(high)
    smooth = low + (high - low) * inside
    smooth = (smooth if kind.kind == "f" else np.round(smooth)).astype(kind)
    shown = np.where(beyond > 0, smooth, data if has_labels else kind.type(0))
    tab20 = np.array(cast(ListedColormap, matplotlib.colormaps["tab20"]).colors)
    dark_then_light = np.delete(np.concatenate([tab20[::2], tab20[1::2]]), (7, 17), axis=0)  # without greys
    more = np.arange(max(len(kinds) - len(dark_then_light), 0))
    spread = np.stack([0.618034 * more % 1, 1 - 0.25 * (more % 3), 1 - 0.2 * (more % 4)], axis=-1)
    colors = np.asarray(from_srgb(np.concatenate([dark_then_light, hsv_to_rgb(spread)])))
    values = low + (high - low) * np.array([0, 0.35, 0.65])
    opacity = extinction_of([0.0, 0.0, 0.9], unit_of(volume))
    functions: dict[int, Any] = {
        label: TransferFunction(values, [colors[label - 1]] * 3, opacity) for label in range(1, len(kinds))
    }
    if has_labels:
        functions[0] = automatic_transfer(volume) if around is None else around
    label_ids = kinds.tolist() if volume.label_ids is None else [volume.label_ids[kind] for kind in kinds]
    place = volume.spacing, volume.origin, beyond
    labelled = Volume(shown, *place, direction=volume.direction, label_ids=label_ids)
    return labelled, LabelTransferFunction(functions)
