"""Which values of a volume are an object, what is around it, and what is dense in it?"""

import math

import numpy as np
from jaxtyping import Float, Shaped

from ...scene.volume import Volume


SAMPLED = 2**21
"""Voxels that are looked at, at most."""

ACROSS = 100
"""Opacities are measured along this part of the volume's diagonal."""

BINS = 256

INSIDE_LEAST = 0.15
"""Part of the voxels between the thresholds whose six neighbours lie between them, too: of a body, at least.
0.25 to 0.92 in scans and simulations, 0.09 at most in angiograms, where only the rims of vessels do."""

ROUGH, NOISY = 0.7, 0.1
"""Grain has second differences above this part of first differences over two steps (0.6 at most in scans, 0.8
in ultrasound, 1.7 in white noise), and above this part of the distance of the thresholds."""


def stride_of(shape: tuple[int, ...]) -> int:
    """The least number n so that every n-th voxel along each axis is at most SAMPLED voxels."""
    stride = 1
    while math.prod(-(-n // stride) for n in shape) > SAMPLED:
        stride += 1
    return stride


def sampled(volume: Volume) -> Shaped[np.ndarray, "nx ny nz"]:
    """Every n-th voxel along each axis."""
    stride = stride_of(volume.shape)
    return np.asarray(volume.data)[::stride, ::stride, ::stride]


def unit_of(volume: Volume) -> float:
    """The length to which opacities refer, so that they do not depend on the volume's units."""
    low, high = (np.asarray(corner) for corner in volume.corners)
    return float(np.linalg.norm(high - low)) / ACROSS


def thresholds(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Otsu's two thresholds, moved to the middle of the means of the classes between which they lie."""
    from skimage.filters import threshold_multiotsu

    low, high = (float(end) for end in np.percentile(values, (0, 99.9)))
    high = high if high > low else float(values.max())
    clipped = np.clip(values, low, high)
    try:
        first, second = threshold_multiotsu(clipped, 3, nbins=BINS)
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


def is_body(data: Shaped[np.ndarray, "nx ny nz"], first: float, second: float) -> bool:
    """Whether values between two thresholds fill a body, and are not only grain, or the borders of what is
    dense. Of a large volume, every n-th voxel is compared with its neighbours."""
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
    return bool(inside.sum() >= INSIDE_LEAST * middle.sum()) and not is_grain
