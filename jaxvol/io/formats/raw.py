"""Reads arrays from files without a header.

Shape and type are given by the caller, by a JSON file beside the file, or by its name.
"""

import gzip
import json
import math
import operator
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import as_array, check_size, decoding, file_size, read_all


ENDINGS = (".raw", ".raw.gz")
JSON_KEYS = {"size": "shape", "type": "dtype", "spacing": "spacing", "origin": "origin"}
SCIVIS_NAME = re.compile(r"_([0-9]+)x([0-9]+)x([0-9]+)_([^_.]+)\.raw(\.gz)?$", re.IGNORECASE)
RAW_DTYPE = re.compile(r"(u?int8|u?int16|float16|float32|float64)(le|be)?", re.IGNORECASE)


def read_raw(path: Path, shape: Any, dtype: Any) -> dict[str, Any]:
    """Reader for `.raw` and `.raw.gz`, x fastest. `shape`, `dtype`: as passed to `load`, unchecked."""
    n_bytes = file_size(path)
    size, stored, fields = raw_header(path, shape, dtype, 31)  # Volume's own limit
    expected = math.prod(size) * stored.itemsize
    if path.name.lower().endswith(".gz"):
        # the size in gzip's trailer is unverified and modulo 2**32: only decompressing tells
        with decoding(path), gzip.open(path) as stream:
            content = read_all(path, stream, expected)
    else:
        check_size(path, n_bytes, expected)
        content = path.read_bytes()
    return {"data": as_array(content, size, stored, "F"), **fields}


def raw_header(
    path: Path, shape: Any, dtype: Any, bits: int
) -> tuple[tuple[int, int, int], np.dtype, dict[str, Any]]:
    """Shape (nx, ny, nz) with less than 2**`bits` voxels, stored type, and spacing and origin where they are
    known, of a raw file: as given by the caller, else by a JSON file beside it, else by its name."""
    match = SCIVIS_NAME.search(path.name)
    fields = {} if match is None else {"shape": tuple(map(int, match.groups()[:3])), "dtype": match[4]}
    given = {"shape": shape, "dtype": dtype}
    fields |= raw_json_header(path) | {name: value for name, value in given.items() if value is not None}
    if not {"shape", "dtype"} <= fields.keys():
        raise ValueError(
            f"path: the shape and dtype of {path} are not both known. Give shape=(nx, ny, nz) "
            f'and dtype="uint8", or name it name_XxYxZ_dtype.raw, or put {path.name}.json beside it with '
            '{"size": [nx, ny, nz], "type": "uint8"}.'
        )
    return _shape(path, fields.pop("shape"), bits), _dtype(path, fields.pop("dtype")), fields


def raw_json(path: Path) -> Path | None:
    """The JSON file beside a raw file, if there is one."""
    stem = re.sub(r"\.raw(\.gz)?$", "", path.name, flags=re.IGNORECASE)
    candidates = (path.with_name(f"{name}.json") for name in (path.name, stem))
    return next((file for file in candidates if file.is_file()), None)


def raw_json_header(path: Path) -> dict[str, Any]:
    """What the JSON file beside a raw file says, under the names of `load`'s arguments."""
    beside = raw_json(path)
    if beside is None:
        return {}
    try:
        fields = json.loads(beside.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as fault:
        raise ValueError(f"path: the header {beside} is not JSON ({fault}).") from fault
    if not isinstance(fields, dict):
        raise ValueError(f"path: the header {beside} must be a JSON object; got {type(fields).__name__}.")
    return {name: fields[key] for key, name in JSON_KEYS.items() if key in fields}


def _shape(path: Path, shape: Any, bits: int) -> tuple[int, int, int]:
    try:
        nx, ny, nz = map(operator.index, shape)
    except (TypeError, ValueError):
        nx = ny = nz = 0
    if min(nx, ny, nz) < 1 or nx * ny * nz >= 2**bits:
        raise ValueError(
            "shape must be three positive integers (nx, ny, nz) with a product less than "
            f"2**{bits}; got {shape!r} for {path}."
        )
    return nx, ny, nz


def _dtype(path: Path, dtype: Any) -> np.dtype:
    match = RAW_DTYPE.fullmatch(str(getattr(dtype, "__name__", dtype)))  # np.uint8.__name__ is "uint8"
    if match is None:
        raise ValueError(
            "dtype must be uint8, int8, uint16, int16, float16, float32 or float64, optionally with le or be "
            f"appended for the byte order; got {dtype!r} for {path}."
        )
    return np.dtype(match[1].lower()).newbyteorder(">" if (match[2] or "").lower() == "be" else "<")
