"""Reads MetaImage files (`.mha`, `.mhd`): a header in text, and the voxels behind it or in another file.

SimpleITK hangs on some that are damaged, and leaves voxels unset where a header understates the number of
compressed bytes, so that they are read here.
"""

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, Header, as_array, check_size, decoding, file_size, numbers_in
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


def read_metaimage(path: Path, header: Header) -> dict[str, Any]:
    """Reader for `.mha` and `.mhd` of binary voxels."""
    header.refuse(path)
    file_size(path)
    fields, begin = _header(path)
    sizes, channels = fields.get("DimSize", ""), fields.get("ElementNumberOfChannels", "1")
    shape = [int(size) if size.isascii() and size.isdigit() else 0 for size in sizes.split()]
    if len(shape) != 3 or fields.get("NDims") != "3" or channels != "1":
        raise ValueError(
            f"path: {path} must be a 3-D image of one value per voxel; got NDims = "
            f"{fields.get('NDims', '')[:20]}, DimSize = {sizes[:60]} and {channels[:20]} values per voxel."
        )
    if not 0 < math.prod(shape) <= MOST_VOXELS:
        raise ValueError(f"path: {path} must have 1 to 2**31 - 1 voxels; got DimSize = {sizes[:60]}.")
    kind = fields.get("ElementType", "")
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


def _numbers(path: Path, fields: dict[str, str], keys: tuple[str, ...], default: np.ndarray) -> np.ndarray:
    """The numbers of the first of these keys that is there, in the shape of `default`."""
    key = next((key for key in keys if key in fields), None)
    if key is None:
        return default
    return numbers_in(fields[key], default.size, f"path: {path}: {key}").reshape(default.shape)


def _content(path: Path, fields: dict[str, str], begin: int, expected: int) -> bytes:
    """The bytes of the voxels, `expected` in number."""
    source = metaimage_data(path)
    if not source.is_file():
        raise ValueError(
            f"path: {path} cannot be read: it must hold its voxels, or name one file of them that is there; "
            f"got ElementDataFile = {fields['ElementDataFile'][:80]}."
        )
    held = source.stat().st_size
    if source != path:
        skipped = fields.get("HeaderSize", "0")  # -1: voxels are at the end of the file
        if skipped != "-1" and not (skipped.isascii() and skipped.isdigit() and len(skipped) < 16):
            raise ValueError(f"path: {path}: HeaderSize must be a number of bytes; got {skipped[:40]!r}.")
        begin = max(held - expected, 0) if skipped == "-1" else int(skipped)
    with source.open("rb") as stream, decoding(path):
        stream.seek(begin)
        if _flag(fields, "CompressedData"):  # by zlib or gzip, to the stream's own end
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)
            check_size(path, len(content), expected)
            return content
        check_size(path, min(max(held - begin, 0), expected), expected)  # other data may follow
        return stream.read(expected)


def _flag(fields: dict[str, str], key: str, default: str = "F") -> bool:
    return fields.get(key, default).lower().startswith(("t", "1"))
