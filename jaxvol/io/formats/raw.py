"""Reads arrays from files without a header: a caller, a JSON file or the name tells their shape and type."""

import gzip
import json
import math
import operator
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import as_array, check_size, decoding, file_size, read_all
from ..._util.image_record import ImageRecord


ENDINGS = (".raw", ".raw.gz")
JSON_KEYS = {"size": "shape", "type": "dtype", "spacing": "spacing", "origin": "origin"}
SCIVIS_NAME = re.compile(r"_([0-9]+)x([0-9]+)x([0-9]+)_([^_.]+)\.raw(\.gz)?$", re.IGNORECASE)
RAW_DTYPE = re.compile(r"(u?int8|u?int16|u?int32|u?int64|float16|float32|float64)(le|be)?", re.IGNORECASE)


def read_raw(path: Path, shape: Any = None, dtype: Any = None, offset: int = 0) -> ImageRecord:
    """Reader for voxels without a header, x fastest. `shape`, `dtype`: as passed to `load`, unchecked.
    `offset`: bytes before the voxels."""
    n_bytes = file_size(path)
    size, stored, fields = raw_header(path, shape, dtype)
    expected = math.prod(size) * stored.itemsize
    if path.name.lower().endswith(".gz"):
        # the size in gzip's trailer is unverified and modulo 2**32: only decompressing tells
        with decoding(path), gzip.open(path) as stream:
            stream.read(offset)
            data = as_array(read_all(path, stream, expected), size[::-1], stored, "C").T
    else:
        check_size(path, max(n_bytes - offset, 0), expected)
        data = np.memmap(path, stored, "r", offset, size, "F")
    spacing, origin = (fields.get(name) for name in ("spacing", "origin"))
    also = {name: part for name, part in (("spacing", spacing), ("origin", origin)) if part is not None}
    return ImageRecord(data, "xyz", what=f"path: {path}", also=also)


def raw_header(path: Path, shape: Any, dtype: Any) -> tuple[tuple[int, int, int], np.dtype, dict[str, Any]]:
    """Shape (nx, ny, nz), stored type, and spacing and origin where they are known, of a raw file: as given
    by the caller, else by its JSON file, else by its name."""
    match = SCIVIS_NAME.search(path.name)
    fields = {} if match is None else {"shape": tuple(map(int, match.groups()[:3])), "dtype": match[4]}
    given = {"shape": shape, "dtype": dtype}
    fields |= _json_fields(path) | {name: value for name, value in given.items() if value is not None}
    ways = {"shape": "shape=(nx, ny, nz)", "dtype": 'dtype="uint8"'}
    if missing := ways.keys() - fields.keys():
        told = " and ".join(sorted(missing, reverse=True))
        raise ValueError(
            f"path: the {told} of {path} {'are' if len(missing) > 1 else 'is'} not known. "
            f"Give {' and '.join(ways[name] for name in ways if name in missing)}, "
            "or name it name_XxYxZ_dtype.raw, or put "
            f'{path.name}.json in its folder with {{"size": [nx, ny, nz], "type": "uint8"}}.'
        )
    shape, dtype = fields.pop("shape"), fields.pop("dtype")
    try:
        nx, ny, nz = map(operator.index, shape)
    except (TypeError, ValueError):
        nx = ny = nz = 0
    if min(nx, ny, nz) < 1 or nx * ny * nz >= 2**48:
        raise ValueError(
            f"shape must be three positive integers (nx, ny, nz) with a product less than 2**48; got "
            f"{shape!r} for {path}."
        )
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
        if not isinstance(fields, dict):
            raise ValueError(f"path: the header {file} must be a JSON object; got {type(fields).__name__}.")
        return {name: fields[key] for key, name in JSON_KEYS.items() if key in fields}
    return {}
