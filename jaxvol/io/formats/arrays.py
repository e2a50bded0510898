"""Readers of `.npy`, `.npz` and voxels without a header, described by arguments, a JSON file or the name.
NumPy's own loader allocates memory by an unchecked header."""

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

from ..._util.files import CORRUPT, Refused, as_array, check, check_size, decoding, file_size, read_all
from ..._util.image_record import ImageRecord


RAW = (".raw", ".raw.gz")
JSON_KEYS = {"size": "shape", "type": "dtype", "spacing": "spacing", "origin": "origin"}
SCIVIS_NAME = re.compile(r"_([0-9]+)x([0-9]+)x([0-9]+)_([^_.]+)\.raw(\.gz)?$", re.IGNORECASE)
RAW_DTYPE = re.compile(r"(u?int8|u?int16|u?int32|u?int64|float16|float32|float64)(le|be)?", re.IGNORECASE)
VOLUME = ("data", "spacing", "origin", "direction", "labels", "label_ids")
"""Arguments of `Volume` that a `.npz` file may hold."""


def check_volume(size: Sequence[int], channels: int = 1) -> None:
    """Refuse an image that is not a volume, or several along further axes."""
    must = "must be a 3-D image, or several along further axes, of fewer than 2**31 voxels"
    holds = 3 <= len(size) <= 5 and channels >= 1 and min(size) >= 1 and math.prod(size) * channels < 2**62
    check(holds, f"{must}; got size {tuple(size)} and {channels} values per voxel.")


def read_voxels(
    source: Path, shape: Sequence[int], dtype: np.dtype, begin: int, packed: str = "", more: bool = True
) -> np.ndarray:
    """Read voxels, the last axis fastest. `begin`: first byte, after decompression for gzip; -1: voxels end
    the file. `packed`: "gzip", "zlib" (a part of the file, also by gzip), or "". `more`: bytes may follow."""
    expected, held = math.prod(shape) * dtype.itemsize, file_size(source)
    with source.open("rb") as stream, decoding():
        if packed == "gzip":  # the size in its trailer is unverified and modulo 2**32: only reading tells
            unpacked = gzip.GzipFile(fileobj=stream)
            unpacked.seek(begin)
            return as_array(read_all(unpacked, expected, more=more), shape, dtype, "C")
        stream.seek(begin if begin >= 0 else max(held - expected, 0))
        if packed:
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)
            check_size(len(content), expected, more=more)
        else:
            check_size(max(held - stream.tell(), 0), expected, more=more)
            content = stream.read(expected)
    return as_array(content[:expected], shape, dtype, "C")


def read_raw(path: Path, shape: object = None, dtype: object = None, offset: int = 0) -> ImageRecord:
    """Reader of voxels without a header, x fastest. Shape and type: arguments, or from JSON or the name."""
    match = SCIVIS_NAME.search(path.name)
    fields = {} if match is None else {"shape": tuple(map(int, match.groups()[:3])), "dtype": match[4]}
    fields |= _json_fields(path)
    fields |= {name: arg for name, arg in (("shape", shape), ("dtype", dtype)) if arg is not None}
    examples = {"shape": "shape=(nx, ny, nz)", "dtype": 'dtype="uint8"'}
    if missing := [name for name in examples if name not in fields]:
        raise ValueError(
            f"path: the {' and '.join(missing)} of {path} {'are' if len(missing) > 1 else 'is'} not known. "
            f"Give {' and '.join(examples[name] for name in missing)}, or name it name_XxYxZ_dtype.raw, or "
            f'put {path.name}.json in its folder with {{"size": [nx, ny, nz], "type": "uint8"}}.'
        )
    sizes: Any = fields.pop("shape")
    kind = fields.pop("dtype")
    try:
        nx, ny, nz = map(operator.index, sizes)
    except (TypeError, ValueError):
        nx = ny = nz = 0
    if min(nx, ny, nz) < 1 or nx * ny * nz >= 2**48:
        must = "shape must be three positive integers (nx, ny, nz) with a product less than 2**48"
        raise ValueError(f"{must}; got {sizes!r} for {path}.")
    match = RAW_DTYPE.fullmatch(str(getattr(kind, "__name__", kind)))  # np.uint8.__name__ is "uint8"
    if match is None:
        must = "dtype must be uint8, int8, uint16 to uint64, int16 to int64, float16, float32 or float64"
        order = "optionally with le or be appended for the byte order"
        raise ValueError(f"{must}, {order}; got {kind!r} for {path}.")
    stored = np.dtype(match[1].lower()).newbyteorder(">" if (match[2] or "").lower() == "be" else "<")
    if path.name.lower().endswith(".gz"):
        data = read_voxels(path, (nz, ny, nx), stored, offset, "gzip", more=False).T
    else:
        check_size(max(file_size(path) - offset, 0), nx * ny * nz * stored.itemsize)
        data = np.memmap(path, stored, "r", offset, (nx, ny, nz), "F")
    return ImageRecord(data, "xyz", also={name: part for name, part in fields.items() if part is not None})


def _json_fields(path: Path) -> dict[str, Any]:
    """Fields of a raw file's JSON file, under the names of `load`'s arguments. Its name is that of the file
    with `.json` appended, or as the ending."""
    stem = re.sub(r"\.raw(\.gz)?$", "", path.name, flags=re.IGNORECASE)
    for file in (path.with_name(f"{name}.json") for name in (path.name, stem)):
        if not file.is_file():
            continue
        try:
            fields = json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as fault:
            raise ValueError(f"path: the header {file} is not JSON ({fault}).") from fault
        if not isinstance(fields, dict):
            raise ValueError(f"path: the header {file} must be a JSON object; got {type(fields).__name__}.")
        return {name: fields[key] for key, name in JSON_KEYS.items() if key in fields}
    return {}


def read_npy(path: Path) -> ImageRecord:
    """Reader of `.npy`: one array, which is memory-mapped."""
    with decoding(), path.open("rb") as stream:
        shape, order, dtype = _npy_header(stream)
        begin = stream.tell()
    check_size(file_size(path) - begin, math.prod(shape) * dtype.itemsize)
    return ImageRecord(np.memmap(path, dtype, "r", begin, shape, order), "xyzs"[: len(shape)])


def read_npz(path: Path) -> ImageRecord:
    """Reader of `.npz`: arrays named like the arguments of `Volume`, or one array of any name."""
    arrays, must = {}, "must hold an array called data, or one array"
    with decoding(), zipfile.ZipFile(path) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        members = {"data": next(iter(members.values()))} if len(members) == 1 else members
        check("data" in members, f"{must}; got {sorted(members)}. Save it with np.savez(path, data=...).")
        for name in filter(members.__contains__, VOLUME):
            with archive.open(members[name]) as stream:
                shape, order, dtype = _npy_header(stream)
                expected = math.prod(shape) * dtype.itemsize
                check_size(members[name].file_size - stream.tell(), expected)
                arrays[name] = as_array(read_all(stream, expected), shape, dtype, order)
    data = arrays.pop("data")
    return ImageRecord(data, "xyzs"[: data.ndim], also=arrays)


def _npy_header(stream: Any) -> tuple[tuple[int, ...], Any, np.dtype]:
    """Read the header of a `.npy` stream: shape, order and type of the array."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, fortran, dtype = readers[np.lib.format.read_magic(stream)](stream)
        if not all(type(n) is int for n in shape):  # NumPy lets True through
            raise TypeError(f"shape {shape}")
    except CORRUPT:
        raise
    except Exception as fault:  # NumPy raises different errors for different faults
        raise Refused(f"has no valid .npy header ({fault!r}).") from fault
    check(dtype.kind in "biuf", f"must hold numbers; got type {dtype} (object: pickles, never read).")
    is_volume = min(shape, default=1) >= 1 and math.prod(shape) < 2**48
    check(is_volume, f"must hold 1 to 2**31 - 1 voxels; got shape {shape}.")
    return shape, "F" if fortran else "C", dtype
