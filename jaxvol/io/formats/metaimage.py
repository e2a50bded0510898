"""Reads MetaImage files (`.mha`, `.mhd`): a header in text, and the voxels behind it or in another file.

SimpleITK hangs on some that are damaged, and leaves voxels unset where a header understates the number of
compressed bytes, so that they are read here.
"""

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, as_array, check_size, decoding, file_size, numbers_in
from .medical import text_header
from .orientation import orthonormal, toward_axes


TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}


def read_metaimage(path: Path) -> dict[str, Any]:
    """Reader for `.mha` and `.mhd` of binary voxels."""
    file_size(path)
    fields, begin = _header(path)
    shape = [_natural(size) for size in fields.get("DimSize", "").split()]
    channels, kind = fields.get("ElementNumberOfChannels", "1"), fields.get("ElementType", "")
    if len(shape) != 3 or channels != "1" or min(shape) < 1 or math.prod(shape) > MOST_VOXELS:
        raise ValueError(
            f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; got "
            f"DimSize = {fields.get('DimSize', '')[:60]} and {channels[:20]} values per voxel."
        )
    if kind not in TYPES or not _flag(fields, "BinaryData", "T"):
        raise ValueError(
            f"path: {path}: ElementType must be one of {', '.join(TYPES)}, and BinaryData true; got "
            f"{kind[:40]!r} and {fields.get('BinaryData', 'True')[:20]!r}."
        )
    msb = any(_flag(fields, f"{prefix}ByteOrderMSB") for prefix in ("", "BinaryData", "Element"))
    dtype = np.dtype(TYPES[kind]).newbyteorder(">" if msb else "<")
    content = _content(path, fields, begin, math.prod(shape) * dtype.itemsize)
    spacing = _numbers(path, fields, ("ElementSpacing", "ElementSize"), np.ones(3))
    origin = _numbers(path, fields, ("Offset", "Position", "Origin"), np.zeros(3))
    turn = _numbers(path, fields, ("TransformMatrix", "Rotation", "Orientation"), np.eye(3))
    # the axes of the data follow each other; here they are columns
    direction = orthonormal(f"path: {path}: TransformMatrix", turn.T)
    return toward_axes(as_array(content, shape, dtype, "F"), spacing, origin, direction)


def metaimage_data(path: Path) -> Path:
    """The file that holds the voxels of a MetaImage: itself, or another, which may be missing.

    **Raises:** `ValueError` if it has no header."""
    named = _header(path)[0]["ElementDataFile"]
    return path if named.upper() == "LOCAL" else path.parent / named


def _header(path: Path) -> tuple[dict[str, str], int]:
    fields, end = text_header(path, "=", "ElementDataFile")
    if "ElementDataFile" not in fields:
        raise ValueError(
            f"path: {path} cannot be read: it has no header of a MetaImage that ends in ElementDataFile."
        )
    return fields, end


def _content(path: Path, fields: dict[str, str], begin: int, expected: int) -> bytes:
    """The bytes of the voxels, `expected` in number."""
    source = metaimage_data(path)
    if not source.is_file():
        raise ValueError(f"path: {path} cannot be read: there is no file of its voxels, {str(source)[:80]}.")
    held = source.stat().st_size
    if source != path:
        skipped = fields.get("HeaderSize", "0")  # -1: voxels are at the end of the file
        begin = max(held - expected, 0) if skipped == "-1" else _natural(skipped)
        if begin < 0:
            raise ValueError(f"path: {path}: HeaderSize must be a number of bytes; got {skipped[:40]!r}.")
    with source.open("rb") as stream, decoding(path):
        stream.seek(begin)
        if _flag(fields, "CompressedData"):  # by zlib or gzip, to the stream's own end
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)
            check_size(path, len(content), expected)
            return content
        check_size(path, max(held - begin, 0), expected, more=True)
        return stream.read(expected)


def _numbers(path: Path, fields: dict[str, str], keys: tuple[str, ...], default: np.ndarray) -> np.ndarray:
    """The numbers of the first of these keys that is there, in the shape of `default`."""
    for key in keys:
        if key in fields:
            return numbers_in(fields[key], default.size, f"path: {path}: {key}").reshape(default.shape)
    return default


def _natural(text: str) -> int:
    """The integer that a text holds, or -1."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else -1


def _flag(fields: dict[str, str], key: str, default: str = "F") -> bool:
    return fields.get(key, default).lower().startswith(("t", "1"))
