"""Reads MetaImage files (`.mha`, `.mhd`), on some of which SimpleITK hangs, or leaves voxels unset where a
header understates the number of compressed bytes."""

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.affine import directions
from ..._util.checks import shortened
from ..._util.files import as_array, check_size, decoding, file_size
from .medical import check_volume, text_header, toward_axes


NAMES = "CHAR UCHAR SHORT USHORT INT UINT LONG ULONG LONG_LONG ULONG_LONG FLOAT DOUBLE"
CODES = "i1 u1 i2 u2 i4 u4 i4 u4 i8 u8 f4 f8"
TYPES = {f"MET_{name}": code for name, code in zip(NAMES.split(), CODES.split(), strict=True)}


def read_metaimage(path: Path) -> dict[str, Any]:
    """Reader for `.mha` and `.mhd` of binary voxels."""
    file_size(path)
    fields, begin, source = metaimage_header(path)
    shape = [_natural(size) for size in fields.get("DimSize", "").split()]
    n, channels = len(shape), _natural(fields.get("ElementNumberOfChannels", "1"))
    check_volume(path, shape, channels)
    kind = fields.get("ElementType", "")
    if kind not in TYPES or not _flag(fields, "BinaryData", "T"):
        raise ValueError(
            f"path: {path}: ElementType must be one of {', '.join(TYPES)}, and BinaryData true; got "
            f"{kind[:40]!r} and {fields.get('BinaryData', 'True')[:20]!r}."
        )
    msb = any(_flag(fields, f"{prefix}ByteOrderMSB") for prefix in ("", "BinaryData", "Element"))
    dtype = np.dtype(TYPES[kind]).newbyteorder(">" if msb else "<")
    expected = channels * math.prod(shape) * dtype.itemsize
    if not source.is_file():
        named = shortened(str(source))
        raise ValueError(f"path: {path} cannot be read: there is no file of its voxels, {named}.")
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
        else:
            check_size(path, max(held - begin, 0), expected, more=True)
            content = stream.read(expected)
    spacing = _numbers(path, fields, ("ElementSpacing", "ElementSize"), np.ones(n))
    origin = _numbers(path, fields, ("Offset", "Position", "Origin"), np.zeros(n))
    # the axes of the data follow each other; here they are columns
    turn = _numbers(path, fields, ("TransformMatrix", "Rotation", "Orientation"), np.eye(n)).T[:3, :3]
    turn = directions(f"path: {path}: TransformMatrix", turn)
    data = np.moveaxis(as_array(content, (channels, *shape), dtype, "F"), 0, -1)
    return toward_axes(data, spacing[:3], origin[:3], turn) | {"axes": "xyztc"[:n] + "s"}


def metaimage_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of the header; where it ends, and the file of the voxels, which may be missing."""
    fields, end = text_header(path, "=", "ElementDataFile")
    named = fields.get("ElementDataFile")
    if named is None:
        raise ValueError(
            f"path: {path} cannot be read: it has no header of a MetaImage that ends in ElementDataFile."
        )
    return fields, end, path if named.upper() == "LOCAL" else path.parent / named


def _numbers(path: Path, fields: dict[str, str], keys: tuple[str, ...], default: np.ndarray) -> np.ndarray:
    """The numbers of the first of these keys that is there, in the shape of `default`."""
    key = next((key for key in keys if key in fields), None)
    if key is None:
        return default
    try:
        return np.array(fields[key].split(), float).reshape(default.shape)
    except ValueError as fault:
        got = fields[key][:80]
        raise ValueError(f"path: {path}: {key} must be {default.size} numbers; got {got!r}.") from fault


def _natural(text: str) -> int:
    """The integer that a text holds, or -1."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else -1


def _flag(fields: dict[str, str], key: str, default: str = "F") -> bool:
    return fields.get(key, default).lower().startswith(("t", "1"))
