"""Reads NumPy files without NumPy's own loader, which allocates memory as an unchecked header says."""

import math
import zipfile
from pathlib import Path

import numpy as np

from .files import CORRUPT, Stream, as_array, check_size, decoding, file_size, read_all
from .image_record import ImageRecord


VOLUME = ("data", "spacing", "origin", "direction", "labels", "label_ids")
"""Arguments of `Volume` that a `.npz` file may hold."""


def read_npy(path: Path) -> ImageRecord:
    """Reader for `.npy`: one array, the data, which is mapped."""
    size = file_size(path)
    with decoding(path), path.open("rb") as stream:
        shape, fortran, dtype = npy_header(path, stream)
        begin = stream.tell()
    check_size(path, size - begin, math.prod(shape) * dtype.itemsize)
    data = np.memmap(path, dtype, "r", begin, shape, "F" if fortran else "C")
    return ImageRecord(data, "xyzs"[: data.ndim], what=f"path: {path}")


def read_npz(path: Path) -> ImageRecord:
    """Reader for `.npz`: arrays named like the arguments of `Volume`, or one array of any name."""
    file_size(path)
    with decoding(path), zipfile.ZipFile(path) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        if len(members) == 1:
            members = {"data": next(iter(members.values()))}
        if "data" not in members:
            raise ValueError(
                f"path: {path} must hold an array called data, or one array; got {sorted(members)}. "
                "Save it with np.savez(path, data=...)."
            )
        arrays = {}
        for name in filter(members.__contains__, VOLUME):
            with archive.open(members[name]) as stream:
                shape, fortran, dtype = npy_header(path, stream)
                expected = math.prod(shape) * dtype.itemsize
                check_size(path, members[name].file_size - stream.tell(), expected)
                content = read_all(path, stream, expected)
            arrays[name] = as_array(content, shape, dtype, "F" if fortran else "C")
    data = arrays.pop("data")
    return ImageRecord(data, "xyzs"[: data.ndim], what=f"path: {path}", also=arrays)


def npy_header(path: Path, stream: Stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the first axis is fastest, and type of the array that a `.npy` stream holds; the stream
    then stands at its first byte."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, fortran, dtype = readers[np.lib.format.read_magic(stream)](stream)
        if not all(type(n) is int for n in shape):  # NumPy lets True through
            raise TypeError(f"shape {shape}")
    except CORRUPT:
        raise
    except Exception as fault:  # NumPy raises different errors for different faults
        raise ValueError(f"path: {path} has no valid .npy header ({fault!r}).") from fault
    if dtype.kind not in "biuf":
        raise ValueError(
            f"path: {path} holds an array of type {dtype}; expected integers or floats. "
            "Arrays of objects are pickles, which are never read."
        )
    if min(shape, default=1) < 1 or math.prod(shape) >= 2**48:
        raise ValueError(f"path: {path} must hold 1 to 2**31 - 1 voxels; got shape {shape}.")
    return shape, fortran, dtype
