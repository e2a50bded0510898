"""Is what lies between two thresholds a body, or only the borders of what is dense, or grain?"""

import numpy as np
from jaxtyping import Shaped

from .sampling import stride_of


INSIDE_LEAST = 0.15
"""Part of the voxels between the thresholds whose six neighbours lie between them, too: of a body, at least.
It is 0.38 to 0.92 in scans of heads, lungs, teeth and engines, 0.25 in a simulation, and 0.09 at most in
angiograms, where only the rims of vessels lie between."""

ROUGH, NOISY = 0.7, 0.1
"""Grain has second differences above this part of first differences over the same two steps (0.1 to 0.6 in
most scans, 0.8 in ultrasound and in a noisy MR scan, 1.7 in white noise), and above this part of the distance
of the thresholds."""


def is_body(data: Shaped[np.ndarray, "nx ny nz"], first: float, second: float) -> bool:
    """Whether values between `first` and `second` fill a body that is worth to be shown.

    Of a large volume, every n-th voxel is compared with its neighbours."""
    if min(data.shape) < 3:
        return True
    stride = stride_of(data.shape)

    def shifted(axis: int, by: int) -> Shaped[np.ndarray, "mx my mz"]:
        begins = [1 + by * (axis == each) for each in range(3)]
        part = tuple(slice(begin, begin + n - 2, stride) for begin, n in zip(begins, data.shape, strict=True))
        return data[part].astype(np.float32)

    def between(values: Shaped[np.ndarray, "mx my mz"]) -> Shaped[np.ndarray, "mx my mz"]:
        return (values > first) & (values <= second)

    here = shifted(0, 0)
    middle = between(here)
    if not middle.any():
        return True
    inside, bends, slopes = middle.copy(), 0.0, 0.0
    for axis in range(3):
        before, after = shifted(axis, -1), shifted(axis, 1)
        inside &= between(before) & between(after)
        bends += float(np.abs(2 * here - before - after)[middle].mean(dtype=np.float64)) / 3
        slopes += float(np.abs(after - before)[middle].mean(dtype=np.float64)) / 3
    grainy = bends > ROUGH * slopes and bends > NOISY * (second - first)
    return bool(inside.sum() >= INSIDE_LEAST * middle.sum()) and not grainy
