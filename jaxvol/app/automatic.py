"""Default transfer functions: from a volume's histogram, or with a colour for each of its labels."""

import math
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped

from .._util.checks import described
from .._util.image_record import warn_caller
from .._util.srgb import from_srgb
from .._util.voxels import faces_of, is_flat
from ..ray import check_arguments
from ..scene.labels import LabelTransferFunction
from ..scene.presets import colormap
from ..scene.transfer import Transfer, TransferFunction, extinction_of, voxel_size
from ..scene.volume import Volume, check_one_channel
from ..xla.memo import memoized_of
from ..xla.platform import is_traced


SAMPLED = 2**21  # voxels that are looked at, at most
CUT = 0.25  # fraction of the voxels at the volume's faces from which on the faces cut through the object

BODY = 0.15
"""Least part of a body's voxels with all neighbours in it, too: 0.25 in scans, 0.09 in angiograms."""

IN_FRONT, THROUGH, THIN = 0.3, 1.2, 0.15
"""Optical depth of the object in front of what is dense, and all through it, at most, in the median of rays
along the axes; and opacity from which on it is thin."""

ROUGH, NOISY = 0.7, 0.1
"""Second differences of grain, at least, over first ones (scans 0.6), and over the thresholds' distance."""

MOST_LABELS = 256
"""Most labels, and most different whole numbers that count as such: as in a `LabelTransferFunction`."""

SPARSE = 0.06  # fraction of voxels that are no background, at most, of angiograms
MANY = 16  # different values that the others have at least, for one to be far from them

SMALL = 0.1  # voxels for which presets, made for some 0.5 to 3 mm, would be nearly transparent
INSIDE = 255  # value of what has a label, in the volume that is shown

EDGE, SKIN, TISSUE = (70, 30, 18), (214, 130, 92), (190, 92, 62)
DENSE, BRIGHT = (236, 208, 160), (255, 246, 226)
"""Colours, 8-bit sRGB: of the border's foot, the border, the object, what is dense, and what is densest."""


RARE, FAR, BEYOND = 1e-4, 0.25, 6.0
"""Fraction of the voxels that are strays at most; their gap to the others, as a fraction of the range of
these, at least, which is also that of a fill value below the others; and the same of one above the others."""


class Spread(NamedTuple):
    """Values without strays: first percentile `usual`, background `fill` above or inf, words on the rest."""

    low: float
    high: float
    usual: float
    fill: float
    told: str

    def tame(self, data: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
        """The data with what is left out at `usual`, and strays above the range at its end."""
        if not self.told:
            return data
        usual, high = map(data.dtype.type, (self.usual, self.high))
        return np.where((data < self.low) | (data >= self.fill), usual, np.minimum(data, high))


def spread_of(values: Shaped[np.ndarray, "..."]) -> Spread:
    """Find the range of values but for those far from all others: hot or dead voxels, and one value of any
    number, such as padding of CT. Above all others, it counts as background only beyond six times their
    range: a saturated object is no fill value."""
    kinds, counts = np.unique(values, return_counts=True)
    kinds, most, left, fill, more = kinds.astype(np.float64), RARE * counts.sum(), [], math.inf, True
    while more:
        if more := _strays(kinds, counts, most):
            left.append((kinds[0], counts[:more].sum()))
            kinds, counts = kinds[more:], counts[more:]
        above = _strays(-kinds[::-1], counts[::-1], most)
        far = above == 1 and kinds[-1] - kinds[-2] > BEYOND * (kinds[-2] - kinds[0])
        if above and (far or counts[-above:].sum() <= most):
            left.append((kinds[-1], counts[-above:].sum()))
            fill = kinds[-1] if far else fill
            kinds, counts, more = kinds[:-above], counts[:-above], True
    parts = [f"{n / np.size(values):.2g} of the voxels hold {value:g}" for value, n in left]
    told = f"{', '.join(parts)}, far from all others: taken as background" if left else ""
    usual = kinds[np.searchsorted(np.cumsum(counts), 0.01 * counts.sum())]
    return Spread(float(kinds[0]), float(kinds[-1]), float(usual), fill, told)


def _strays(kinds: Float[np.ndarray, " n"], counts: np.ndarray, most: float) -> int:
    """How many of the lowest values lie far below the others: one, or as many as `most` voxels have."""
    n = min(max(int(np.searchsorted(np.cumsum(counts), most, "right")), 1), len(kinds) - MANY)
    far = np.flatnonzero(np.diff(kinds)[:n] > FAR * (kinds[-1] - kinds[1 : n + 1])) if n > 0 else np.empty(0)
    return int(far[-1]) + 1 if far.size else 0


def stride_of(shape: tuple[int, ...], most: int = SAMPLED) -> int:
    """The least n so that every n-th voxel along each axis makes at most `most` voxels."""
    stride = 1
    while math.prod(-(-n // stride) for n in shape) > most:
        stride += 1
    return stride


def sampled(volume: Volume, data: Any = None) -> Shaped[np.ndarray, "nx ny nz *c"]:
    """Every n-th voxel along each axis, or what `data` hold there."""
    stride = stride_of(volume.shape)
    return np.asarray(volume.data if data is None else data)[::stride, ::stride, ::stride]


def unit_of(volume: Volume) -> float:
    """Length to which opacities refer, whatever the volume's units: a hundredth of its diagonal."""
    across = (np.array(volume.shape) - 1) * np.asarray(volume.spacing)
    across = across if volume.direction is None else np.asarray(volume.direction) @ across
    return float(np.linalg.norm(across)) / 100


def preset_unit(volume: Any) -> float:
    """Length to which a preset's opacities refer: 1 mm, or the voxels' size if these are far smaller."""
    size = float(voxel_size(volume))
    return size if size < SMALL else 1.0


def automatic_transfer(volume: Volume | Any) -> TransferFunction:
    """A transfer function that shows what a volume holds, from its histogram.

    Two thresholds part the values into three classes so that the variance within each is least (Otsu): what
    is around the object, the object, and what is dense in it. The border of the object is shown translucent,
    what is dense in it nearly opaque. Only what is dense is shown where the object would hide it: where the
    volume's faces cut the object, as in most CT scans, and where it is grain, as in ultrasound, or only the
    border of what is dense, as in angiograms. Opacities do not depend on the volume's units.

    Args:
        volume: the `Volume`. Of more than 2 million voxels, every n-th is looked at.

    Returns:
        The `TransferFunction`.

    Raises:
        ValueError: for what is no volume, or traced.

    Source: Otsu, "A Threshold Selection Method from Gray-Level Histograms", 1979.
    """
    if not isinstance(volume, Volume):
        raise ValueError(f"volume must be a jaxvol Volume; got {described(volume)}.")
    check_one_channel(volume, "automatic_transfer")
    check_known("automatic_transfer", volume)
    with jax.ensure_compile_time_eval():  # of a volume from outside, also where something else is traced
        if all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(volume)):
            return _warning(memoized_of(volume, _of_volume))
        return _warning(_of_volume(volume))


def check_known(caller: str, *values: Any) -> None:
    """Refuse what is traced, where a function looks at all voxels, on the host."""
    if is_traced(values):
        told = f"{caller} needs numbers, and some of its arguments are traced: call it outside of jax.jit,"
        raise ValueError(f"{told} jax.vmap and jax.grad, and pass what it returns.")


def transfer_by_copy(copy: Volume, part: Shaped[np.ndarray, "nx ny nz"]) -> TransferFunction:
    """The same from a copy of every n-th voxel, and a part at full resolution, which shows grain."""
    return _warning(_of_histogram(copy, part))


def _warning(found: tuple[TransferFunction, list[str]]) -> TransferFunction:
    for told in found[1]:
        warn_caller(told)
    return found[0]


def _of_volume(volume: Volume) -> tuple[TransferFunction, list[str]]:
    return _of_histogram(volume, np.asarray(volume.data))


def _of_histogram(copy: Volume, part: Shaped[np.ndarray, "nx ny nz"]) -> tuple[TransferFunction, list[str]]:
    """The transfer function, and what is to be warned of."""
    spread = spread_of(sampled(copy))
    told = [spread.told] if spread.told else []
    if told:
        tame = jnp.asarray(spread.tame(np.asarray(copy.data)))
        copy, part = eqx.tree_at(lambda v: v.data, copy, tame), spread.tame(part)
    values = sampled(copy).ravel().astype(np.float32)
    low, high = float(values.min()), float(values.max())
    if side := side_of_distance(copy):
        told.append("values on both sides of 0 with a slope of one are a distance: shown where they are 0")
        d = side * float(voxel_size(copy)) / 2
        points = [(-d, BRIGHT, 0.9), (d, DENSE, 0.0)][::side]
    elif not low < high:
        points = [(low, TISSUE, 0.5), (low + max(abs(low), 1.0), TISSUE, 0.5)]
    else:
        first, second = thresholds(values)
        d = (second - first) / 4
        points = [(second, DENSE, 0.45), (max((second + high) / 2, second + d / 2), BRIGHT, 0.9)]
        if np.mean(faces_of(np.asarray(copy.data)) > first) < CUT and is_body(part, first, second):
            depth, usual = depth_of_object(copy, first, second)
            w = min(first - low, second - first) / 3
            border = [(first - w, EDGE, 0.0), (first, SKIN, 0.3), (first + w, SKIN, max(0.07, depth))]
            if depth > THIN:  # leaves, say: no border, which noise also crosses
                border = [(first, EDGE, 0.0), (min(usual, second - 2 * d), SKIN, depth)]
            points = [*border, (second - d, TISSUE, depth), *points]
        else:
            foot, opacity = second - 2 * d, 0.02
            if np.mean(values > first) < SPARSE:  # vessels, of which the thin ones are darker
                foot, opacity = first, 0.2
            points = [(foot, EDGE, 0.0), (second - d, TISSUE, opacity), *points]
    if spread.fill < math.inf:  # transparent, as it is around the object
        last = max(high, points[-1][0])
        points += [
            (last + (high - low) * part, BRIGHT, level)
            for part, level in ((0.01, points[-1][2]), (0.02, 0.0))
        ]
    at, colors, opacities = zip(*points, strict=True)
    linear = np.asarray(from_srgb(np.array(colors) / 255))
    return TransferFunction(np.array(at), linear, extinction_of(opacities, unit_of(copy))), told


def side_of_distance(volume: Volume) -> int:
    """Sign of the distance to a surface outside of it, if values are such distances of both signs, else 0."""
    data, step = sampled(volume).astype(np.float32), np.asarray(volume.spacing) * stride_of(volume.shape)
    if not (data.min() < 0 < data.max()) or min(data.shape) < 3:
        return 0
    slope = np.sqrt(sum(np.square(each) for each in np.gradient(data, *step.tolist())))
    if np.mean(np.abs(slope[slope > 0] - 1) < 0.1) < 0.7:
        return 0
    return 1 if np.mean(faces_of(data) > 0) > 0.5 else -1


def depth_of_object(volume: Volume, first: float, second: float) -> tuple[float, float]:
    """Opacity that the object, values between two thresholds, may have along `unit_of` a volume: so that what
    is dense is seen through it, and so that it has some itself, if it is thin. And its usual value."""
    data, unit = sampled(volume), unit_of(volume)
    middle, dense = (data > first) & (data <= second), data > second
    in_front, whole = [np.zeros(1)], []
    if not middle.any():
        return THIN, (first + second) / 2
    extent = np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    for axis, step in enumerate(extent / (np.maximum(np.array(data.shape) - 1, 1) * unit)):
        object_, stop = np.moveaxis(middle, axis, 0), np.moveaxis(dense, axis, 0)
        whole.append(step * object_.sum(0)[object_.any(0)])
        for side in (1, -1):
            before, ends = np.cumsum(object_[::side], 0, np.int32), stop[::side].argmax(0)[None]
            in_front.append(step * np.take_along_axis(before, ends, 0)[0][stop.any(0)])
    depths = zip((IN_FRONT, THROUGH), (in_front, whole), strict=True)
    found = min(most / max(float(np.median(np.concatenate(each))), most) for most, each in depths)
    return -math.expm1(-found), float(data[middle].mean(dtype=np.float64))


def thresholds(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Otsu's two thresholds, moved to the middle of the means of the classes between which they lie."""
    from skimage.filters import threshold_multiotsu

    low, high = (float(end) for end in np.percentile(values, (0, 99.9)))
    high = high if high > low else float(values.max())
    clipped = np.clip(values, low, high)
    try:
        first, second = threshold_multiotsu(clipped, 3, nbins=256)
    except ValueError:  # of fewer than three values
        first, second = low + (high - low) / 3, low + 2 * (high - low) / 3
    for _ in range(3):  # strays at the edge of a class join the nearer one
        classes = [clipped[clipped <= first], clipped[(clipped > first) & (clipped <= second)]]
        classes.append(clipped[clipped > second])
        if min(map(len, classes)) == 0:
            break
        means = [float(each.mean(dtype=np.float64)) for each in classes]
        first, second = (means[0] + means[1]) / 2, (means[1] + means[2]) / 2
    return float(first), float(second)


def range_of_object(volume: Volume) -> tuple[float, float]:
    """From the lower of the `thresholds` to what few values are above; of a single value, as far as that."""
    values = sampled(volume)
    spread = spread_of(values)
    if spread.told:
        warn_caller(spread.told)
    values = spread.tame(values).ravel().astype(np.float32)
    low, least = thresholds(values)[0], float(values.min())
    high = float(np.percentile(values[values >= low], 99.5))
    return (low, high) if low < high else (least, least + max(abs(least), 1.0))


def xray_transfer(volume: Volume, cmap: Any, clim: tuple[float, float]) -> TransferFunction:
    """Extinction that grows over a range, so that the brightest pixel of a view along an axis is 1."""
    colors = colormap(cmap, clim)
    slope, brightest = np.linspace(0, 1, len(colors.values)), np.max(colors.colors, axis=1)
    emitted = np.interp(sampled(volume), colors.values, slope * brightest)
    steps = np.asarray(volume.spacing) * stride_of(volume.shape)
    most = max(np.percentile(step * emitted.sum(axis), 99.9) for axis, step in enumerate(steps))
    return TransferFunction(colors.values, colors.colors, slope / (float(most) or 1.0))


def brightest_mean(volume: Volume, low: float) -> float:
    """The greatest mean of the values along an axis, but for a thousandth of the rays; above `low`."""
    data = sampled(volume)
    highest = max(float(np.percentile(data.mean(axis, dtype=np.float64), 99.9)) for axis in range(3))
    return highest if highest > low else low + 1


def is_body(data: Shaped[np.ndarray, "nx ny nz"], first: float, second: float) -> bool:
    """Whether values between the thresholds fill a body, rather than grain or borders."""
    if min(data.shape) < 3:
        return True
    stride = stride_of(data.shape)
    inner = [np.arange(1, n - 1, stride) for n in data.shape]

    def shifted(axis: int, by: int) -> Shaped[np.ndarray, "mx my mz"]:
        places = (places + by * (axis == each) for each, places in enumerate(inner))
        return data[np.ix_(*places)].astype(np.float32)

    here = shifted(0, 0)
    middle = (here > first) & (here <= second)
    if not middle.any():
        return True
    inside, bends, slopes = middle.copy(), 0.0, 0.0
    for axis in range(3):
        before, after = shifted(axis, -1), shifted(axis, 1)
        for each in (before, after):
            inside &= (each > first) & (each <= second)
        bends += float(np.abs(2 * here - before - after)[middle].mean(dtype=np.float64)) / 3
        slopes += float(np.abs(after - before)[middle].mean(dtype=np.float64)) / 3
    is_grain = bends > ROUGH * slopes and bends > NOISY * (second - first)
    return bool(inside.sum() >= BODY * middle.sum()) and not is_grain


def labels_shown(
    volume: Volume | Any, around: TransferFunction | Any | None = None
) -> tuple[Volume, LabelTransferFunction]:
    """A volume and a transfer function that show labels, each in a colour of its own and lit: those that the
    volume has, or its values, if they seem to be labels.

    In and near labels the values that are returned are smooth, from the least to, inside of labels, the
    greatest; and labels reach two voxels beyond. They are counted from 1 on: label k stands for
    `volume.label_ids[k]`.

    Args:
        volume: the `Volume`.
        around: what is shown where a volume's own labels are 0; by default by `automatic_transfer`.

    Returns:
        The two. Of values, the lowest one is not shown.

    Raises:
        ValueError: for what is no volume, or traced; and if the volume has no labels, or more than 256, and
            its values are not whole numbers of 3 to 256 kinds, most of which equal their neighbour.
    """
    check_arguments("labels_shown(volume)", volume=volume)
    check_known("labels_shown", volume, around)
    if (found := labels_if_any(volume, around)) is None:
        told = "volume must have up to 256 labels, or values that seem to be labels; it has "
        many = 0 if volume.labels is None else len(np.unique(np.asarray(volume.labels)))
        raise ValueError(f"{told}{many or 'none'}.")
    return found


def labels_if_any(
    volume: Volume, around: Transfer | None = None
) -> tuple[Volume, LabelTransferFunction] | None:
    """As `labels_shown`; None where that raises."""
    own, data = volume.labels is not None, np.asarray(volume.data)
    given = np.asarray(volume.labels) if own else data
    if not own and (given.dtype.kind not in "iu" or not is_flat(given)):
        return None
    kinds = np.unique(np.append(given, 0) if own else given)
    if len(kinds) > MOST_LABELS or not (own or len(kinds) > 2):
        return None

    import matplotlib
    from matplotlib.colors import ListedColormap, hsv_to_rgb
    from scipy.ndimage import gaussian_filter, maximum_filter

    labels = np.searchsorted(kinds, given).astype(np.uint8)
    # smoothed, so that the border of what has a label has a gradient
    inside = gaussian_filter(np.where(labels > 0, np.float32(1), np.float32(0)), 0.8)
    beyond = np.where(labels > 0, labels, maximum_filter(labels, size=5))
    low, high, kind = (data.min(), data.max(), data.dtype) if own else (0, INSIDE, np.dtype(np.uint8))
    low, high = float(low), float(high)
    smooth = low + (high - low) * inside
    smooth = (smooth if kind.kind == "f" else np.round(smooth)).astype(kind)
    shown = np.where(beyond > 0, smooth, data if own else kind.type(0))
    place = volume.spacing, volume.origin
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
    if own:
        functions[0] = automatic_transfer(volume) if around is None else around
    ids = kinds.tolist() if volume.label_ids is None else [volume.label_ids[kind] for kind in kinds]
    how: Any = {"direction": volume.direction, "label_ids": ids}
    return Volume(shown, *place, beyond, **how), LabelTransferFunction(functions)
