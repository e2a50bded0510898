"""Reads the volume that the options name, whole or in parts."""

import argparse
import math

import numpy as np
from jaxtyping import Shaped

from ...bricks import VoxelSource, levels_of
from ...io.formats import files_of, load
from ...planning.memory import IN_MEMORY
from ...scene.volume import Volume
from ..automatic.histogram import SAMPLED


MIDDLE = 128
"""Voxels along each axis, at most, that are looked at as they are."""


def volume_of(options: argparse.Namespace) -> Volume:
    """The volume in the file."""
    return load(options.file, shape=options.shape, dtype=options.dtype, spacing=options.spacing)


def source_of(options: argparse.Namespace) -> VoxelSource:
    """The volume in the file, of which parts are read."""
    given = {name: getattr(options, name) for name in ("shape", "dtype", "spacing")}
    return levels_of(options.file, **{name: value for name, value in given.items() if value is not None})[0]


def refuse_to_replace(options: argparse.Namespace, *names: str) -> None:
    """**Raises** `ValueError` if a file that is to be written (options of these names) is the volume, one of
    its slices, or one of the others."""
    used = [options.file, *(files_of(options.file) if options.file.is_dir() else [])]
    for name in names:
        path = getattr(options, name)
        if path is not None and path.resolve() in [other.resolve() for other in used]:
            raise ValueError(f"--{name}: {path} is the volume, or written by another option; write another.")
        used += [] if path is None else [path]


def middle_of(source: VoxelSource) -> Shaped[np.ndarray, "nx ny nz"]:
    """Voxels in the middle of a volume, data[x, y, z]."""
    low = [max(0, (n - MIDDLE) // 2) for n in source.shape]
    return source.read(low, [min(n, begin + MIDDLE) for n, begin in zip(source.shape, low, strict=True)])


def copy_of(source: VoxelSource, memory: int) -> Volume:
    """A copy of every n-th voxel, stretched to the bounds of the whole: of those by which colours are chosen
    for the whole, if they fit into so many bytes, and of fewer if not."""
    most = min(SAMPLED, max(8, memory // (IN_MEMORY * source.dtype.itemsize)))
    stride = 1
    while math.prod(-(-n // stride) for n in source.shape) > most and min(source.shape) // (stride + 1) >= 2:
        stride += 1
    copy = source.subsampled(stride)
    whole = [(n - 1) * s / (m - 1) for n, s, m in zip(source.shape, source.spacing, copy.shape, strict=True)]
    return Volume(copy.data, whole, copy.origin)
