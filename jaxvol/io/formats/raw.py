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

from ..._util.files import Header, as_array, check_size, decoding, file_size, read_all


ENDINGS = (".raw", ".raw.gz")
JSON_KEYS = {"size": "shape", "type": "dtype", "spacing": "spacing", "origin": "origin"}
SCIVIS_NAME = re.compile(r"_([0-9]+)x([0-9]+)x([0-9]+)_([^_.]+)\.raw(\.gz)?$", re.IGNORECASE)
RAW_DTYPE = re.compile(r"(u?int8|u?int16|float16|float32|float64)(le|be)?", re.IGNORECASE)


def read_raw(path: Path, header: Header) -> dict[str, Any]:
    """Reader for `.raw` and `.raw.gz`, x fastest."""
    size = file_size(path)
    shape, dtype, fields = raw_header(path, header, 31)  # Volume's own limit
    expected = math.prod(shape) * dtype.itemsize
    if path.name.lower().endswith(".gz"):
        # the size in gzip's trailer is unverified and modulo 2**32: only decompressing tells
        with decoding(path), gzip.open(path) as stream:
            content = read_all(path, stream, expected)
    else:
        check_size(path, size, expected)
        content = path.read_bytes()
    return {"data": as_array(content, shape, dtype, "F"), **fields}


def raw_header(
    path: Path, header: Header, bits: int
) -> tuple[tuple[int, int, int], np.dtype, dict[str, Any]]:
    """Shape (nx, ny, nz) with less than 2**`bits` voxels, stored type, and spacing and origin where they are
    known, of a raw file: as given by the caller, else by a JSON file beside it, else by its name."""
    given = {name: value for name, value in header._asdict().items() if value is not None}
    fields = _name_header(path) | raw_json_header(path) | given
    if not {"shape", "dtype"} <= fields.keys():
        raise ValueError(
            f"path: the shape and dtype of {path} are not both known. Give shape=(nx, ny, nz) "
            f'and dtype="uint8", or name it name_XxYxZ_dtype.raw, or put {path.name}.json beside it with '
            '{"size": [nx, ny, nz], "type": "uint8"}.'
        )
    return _raw_shape(path, fields.pop("shape"), bits), _raw_dtype(path, fields.pop("dtype")), fields


def _name_header(path: Path) -> dict[str, Any]:
    match = SCIVIS_NAME.search(path.name)
    return {} if match is None else {"shape": tuple(map(int, match.groups()[:3])), "dtype": match[4]}


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
        raise ValueError(
            f"path: the header {beside} must be a JSON object with the keys {', '.join(JSON_KEYS)}; "
            f"got {type(fields).__name__}."
        )
    return {name: fields[key] for key, name in JSON_KEYS.items() if key in fields}


def _raw_shape(path: Path, shape: Any, bits: int) -> tuple[int, int, int]:
    try:
        sizes = tuple(map(operator.index, shape))
    except TypeError:
        sizes = ()
    if len(sizes) != 3 or min(sizes) < 1 or math.prod(sizes) >= 2**bits:
        raise ValueError(
            "shape must be three positive integers (nx, ny, nz) with a product less than "
            f"2**{bits}; got {shape!r} for {path}."
        )
    nx, ny, nz = sizes
    return nx, ny, nz


def _raw_dtype(path: Path, dtype: Any) -> np.dtype:
    match = RAW_DTYPE.fullmatch(str(getattr(dtype, "__name__", dtype)))  # np.uint8.__name__ is "uint8"
    if match is None:
        raise ValueError(
            "dtype must be uint8, int8, uint16, int16, float16, float32 or float64, optionally with le or be "
            f"appended for the byte order; got {dtype!r} for {path}."
        )
    name, order = match[1].lower(), (match[2] or "le").lower()
    return np.dtype(name).newbyteorder("<" if order == "le" else ">")
