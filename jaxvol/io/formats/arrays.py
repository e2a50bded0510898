"""Reads arrays that come with little else: voxels without a header, whose shape and type a caller, a JSON
file or the name tells, `.npy` and `.npz`. NumPy's own loader takes memory as an unchecked header says."""

import gzip
import json
import math
import operator
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import CORRUPT, Stream, as_array, check_size, decoding, ensure, file_size, read_all
from ..._util.image_record import ImageRecord


RAW = (".raw", ".raw.gz")
JSON_KEYS = {"size": "shape", "type": "dtype", "spacing": "spacing", "origin": "origin"}
SCIVIS_NAME = re.compile(r"_([0-9]+)x([0-9]+)x([0-9]+)_([^_.]+)\.raw(\.gz)?$", re.IGNORECASE)
RAW_DTYPE = re.compile(r"(u?int8|u?int16|u?int32|u?int64|float16|float32|float64)(le|be)?", re.IGNORECASE)

VOLUME = ("data", "spacing", "origin", "direction", "labels", "label_ids")
"""Arguments of `Volume` that a `.npz` file may hold."""


def check_volume(path: Path, size: Sequence[int], channels: int = 1) -> None:
    """Raises `ValueError` for an image that is no volume, or several of them along further axes."""
    got = f"got size {tuple(size)} and {channels} values per voxel."
    must = "must be a 3-D image, or several along further axes, of fewer than 2**31 voxels"
    holds = 3 <= len(size) <= 5 and channels >= 1 and min(size) >= 1 and math.prod(size) * channels < 2**62
    ensure(holds, f"path: {path} {must}; {got}")


def read_voxels(
    path: Path,
    source: Path,
    shape: Sequence[int],
    dtype: np.dtype,
    *,
    begin: int = 0,
    packed: str = "",
    more: bool = True,
) -> np.ndarray:
    """Voxels of the file `source`, as the header in `path` says, the last axis fastest. `begin`: their first
    byte, of what gzip decompresses; -1: they are the last ones. `packed`: "gzip", "zlib" (a part of the file,
    also by gzip, without its trailer), or "". `more`: other bytes may follow."""
    expected, size = math.prod(shape) * dtype.itemsize, file_size(source)
    with source.open("rb") as stream, decoding(path):
        stream.seek(0 if packed == "gzip" else begin if begin >= 0 else max(size - expected, 0))
        if packed == "zlib":
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)
            check_size(path, len(content), expected, more=source == path)
        elif packed:  # the size in gzip's trailer is unverified and modulo 2**32: only decompressing tells
            unpacked = gzip.GzipFile(fileobj=stream)
            unpacked.seek(begin)
            content = read_all(path, unpacked, expected, more=more)
        else:
            check_size(path, max(size - stream.tell(), 0), expected, more=more)
            content = stream.read(expected)
    return as_array(content[:expected], shape, dtype, "C")


def read_raw(path: Path, shape: Any = None, dtype: Any = None, offset: int = 0) -> ImageRecord:
    """Reader for voxels without a header, x fastest. `shape`, `dtype`: as passed to `load`, unchecked.
    `offset`: bytes before the voxels."""
    size, stored, fields = raw_header(path, shape, dtype)
    if path.name.lower().endswith(".gz"):
        data = read_voxels(path, path, size[::-1], stored, begin=offset, packed="gzip", more=False).T
    else:
        check_size(path, max(file_size(path) - offset, 0), math.prod(size) * stored.itemsize)
        data = np.memmap(path, stored, "r", offset, size, "F")
    return ImageRecord(data, "xyz", also={name: part for name, part in fields.items() if part is not None})


def raw_header(path: Path, shape: Any, dtype: Any) -> tuple[tuple[int, int, int], np.dtype, dict[str, Any]]:
    """Shape (nx, ny, nz), stored type, and spacing and origin where they are known, of a raw file: as given
    by the caller, else by its JSON file, else by its name."""
    match = SCIVIS_NAME.search(path.name)
    fields = {} if match is None else {"shape": tuple(map(int, match.groups()[:3])), "dtype": match[4]}
    given = {"shape": shape, "dtype": dtype}
    fields |= _json_fields(path) | {name: value for name, value in given.items() if value is not None}
    ways = {"shape": "shape=(nx, ny, nz)", "dtype": 'dtype="uint8"'}
    if missing := [name for name in ways if name not in fields]:
        raise ValueError(
            f"path: the {' and '.join(missing)} of {path} {'are' if len(missing) > 1 else 'is'} not known. "
            f"Give {' and '.join(ways[name] for name in missing)}, or name it name_XxYxZ_dtype.raw, or put "
            f'{path.name}.json in its folder with {{"size": [nx, ny, nz], "type": "uint8"}}.'
        )
    shape, dtype = fields.pop("shape"), fields.pop("dtype")
    try:
        nx, ny, nz = map(operator.index, shape)
    except (TypeError, ValueError):
        nx = ny = nz = 0
    must = "shape must be three positive integers (nx, ny, nz) with a product less than 2**48"
    ensure(min(nx, ny, nz) > 0 and nx * ny * nz < 2**48, f"{must}; got {shape!r} for {path}.")
    found = RAW_DTYPE.fullmatch(str(getattr(dtype, "__name__", dtype)))  # np.uint8.__name__ is "uint8"
    if found is None:
        raise ValueError(
            "dtype must be uint8, int8, uint16 to uint64, int16 to int64, float16, float32 or float64, "
            f"optionally with le or be appended for the byte order; got {dtype!r} for {path}."
        )
    order = ">" if (found[2] or "").lower() == "be" else "<"
    return (nx, ny, nz), np.dtype(found[1].lower()).newbyteorder(order), fields


def raw_json(path: Path) -> list[Path]:
    """The JSON file of a raw file, if there is one: of its name with `.json` behind it, or as ending."""
    stem = re.sub(r"\.raw(\.gz)?$", "", path.name, flags=re.IGNORECASE)
    return [file for name in (path.name, stem) if (file := path.with_name(f"{name}.json")).is_file()][:1]


def _json_fields(path: Path) -> dict[str, Any]:
    """What the JSON file of a raw file says, under the names of `load`'s arguments."""
    for file in raw_json(path):
        try:
            fields = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as fault:
            raise ValueError(f"path: the header {file} is not JSON ({fault}).") from fault
        got = f"got {type(fields).__name__}."
        ensure(isinstance(fields, dict), f"path: the header {file} must be a JSON object; {got}")
        return {name: fields[key] for key, name in JSON_KEYS.items() if key in fields}
    return {}


def read_npy(path: Path) -> ImageRecord:
    """Reader for `.npy`: one array, the data, which is mapped."""
    with decoding(path), path.open("rb") as stream:
        shape, order, dtype = _npy_header(path, stream)
        begin = stream.tell()
    check_size(path, file_size(path) - begin, math.prod(shape) * dtype.itemsize)
    return ImageRecord(np.memmap(path, dtype, "r", begin, shape, order), "xyzs"[: len(shape)])


def read_npz(path: Path) -> ImageRecord:
    """Reader for `.npz`: arrays named like the arguments of `Volume`, or one array of any name."""
    arrays = {}
    with decoding(path), zipfile.ZipFile(path) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        if len(members) == 1:
            members = {"data": next(iter(members.values()))}
        must, hint = "must hold an array called data, or one array", "Save it with np.savez(path, data=...)."
        ensure("data" in members, f"path: {path} {must}; got {sorted(members)}. {hint}")
        for name in filter(members.__contains__, VOLUME):
            with archive.open(members[name]) as stream:
                shape, order, dtype = _npy_header(path, stream)
                expected = math.prod(shape) * dtype.itemsize
                check_size(path, members[name].file_size - stream.tell(), expected)
                arrays[name] = as_array(read_all(path, stream, expected), shape, dtype, order)
    data = arrays.pop("data")
    return ImageRecord(data, "xyzs"[: data.ndim], also=arrays)


def _npy_header(path: Path, stream: Stream) -> tuple[tuple[int, ...], Any, np.dtype]:
    """Shape, order ("C" or "F") and type of the array that a `.npy` stream holds; the stream then stands at
    its first byte."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, fortran, dtype = readers[np.lib.format.read_magic(stream)](stream)
        if not all(type(n) is int for n in shape):  # NumPy lets True through
            raise TypeError(f"shape {shape}")
    except CORRUPT:
        raise
    except Exception as fault:  # NumPy raises different errors for different faults
        raise ValueError(f"path: {path} has no valid .npy header ({fault!r}).") from fault
    pickles = "Arrays of objects are pickles, which are never read."
    kind = f"path: {path} holds an array of type {dtype}; expected integers or floats. {pickles}"
    ensure(dtype.kind in "biuf", kind)
    many = f"path: {path} must hold 1 to 2**31 - 1 voxels; got shape {shape}."
    ensure(min(shape, default=1) >= 1 and math.prod(shape) < 2**48, many)
    return shape, "F" if fortran else "C", dtype
