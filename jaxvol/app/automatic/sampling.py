"""Which voxels of a volume are looked at, and by which length is its opacity measured?"""

import math

import numpy as np
from jaxtyping import Shaped

from ...scene.volume import Volume


SAMPLED = 2**21
"""Voxels that are looked at, at most."""

ACROSS = 100
"""Opacities are measured along this part of the volume's diagonal."""


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
