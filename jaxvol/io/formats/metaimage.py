"""Reads MetaImage files (`.mha`, `.mhd`): a header in text, and the voxels behind it or in another file.

SimpleITK writes them, and crashes on some that are damaged, so that they are read here.
"""

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, Header, as_array, check_size, decoding, file_size, read_all
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

LONGEST_LINE, MOST_FIELDS = 2**16, 2**8
"""Of a header. A file that has more is none."""


def read_metaimage(path: Path, header: Header) -> dict[str, Any]:
    """Reader for `.mha` and `.mhd`.

    The header may state the number of compressed bytes; the end is that of the compressed stream itself.
    """
    header.refuse(path)
    file_size(path)
    fields, begin = _fields(path)
    shape = _shape(path, fields)
    spacing = _numbers(path, fields, ("ElementSpacing", "ElementSize"), 3, [1.0, 1.0, 1.0])
    origin = _numbers(path, fields, ("Offset", "Position", "Origin"), 3, [0.0, 0.0, 0.0])
    turn = _numbers(
        path, fields, ("TransformMatrix", "Rotation", "Orientation"), 9, np.eye(3).ravel().tolist()
    )
    # the axes of the data follow each other; here they are columns
    direction = orthonormal(f"path: {path}: TransformMatrix", np.reshape(turn, (3, 3)).T)
    data = _voxels(path, fields, begin, shape)
    if data.dtype == np.float64:
        data = data.astype(np.float32)
    return toward_axes(data, spacing, origin, direction)


def metaimage_data(path: Path) -> Path:
    """The file that holds the voxels of a MetaImage: itself, or another, which may be missing.

    **Raises:** `ValueError` if it has no header."""
    return _source(path, _fields(path)[0])


def _source(path: Path, fields: dict[str, str]) -> Path:
    named = fields["ElementDataFile"]
    return path if named.upper() == "LOCAL" else path.parent / named


def _fields(path: Path) -> tuple[dict[str, str], int]:
    """The header, and where in the file it ends."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while (line := stream.readline(LONGEST_LINE)) and len(fields) < MOST_FIELDS:
            key, _, value = line.decode("latin-1").partition("=")
            fields[key.strip()] = value.strip()
            if "ElementDataFile" in fields:
                return fields, stream.tell()
    raise ValueError(
        f"path: {path} cannot be read: it has no header of a MetaImage that ends in ElementDataFile."
    )


def _shape(path: Path, fields: dict[str, str]) -> tuple[int, int, int]:
    parts = fields.get("ElementNumberOfChannels", "1")
    try:
        sizes = [int(size) for size in fields.get("DimSize", "").split()]
    except ValueError:
        sizes = []
    if (
        fields.get("NDims") != "3"
        or parts != "1"
        or len(sizes) != 3
        or min(sizes) < 1
        or math.prod(sizes) > MOST_VOXELS
    ):
        raise ValueError(
            f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; got "
            f"NDims = {fields.get('NDims', '')[:20]}, DimSize = {fields.get('DimSize', '')[:60]} and "
            f"{parts[:20]} values per voxel."
        )
    nx, ny, nz = sizes
    return nx, ny, nz


def _numbers(
    path: Path, fields: dict[str, str], keys: tuple[str, ...], count: int, usual: list[float]
) -> list[float]:
    """The numbers of the first of these keys that is there."""
    key = next((key for key in keys if key in fields), None)
    if key is None:
        return usual
    try:
        found = [float(number) for number in fields[key].split()]
    except ValueError:
        found = []
    if len(found) != count or not np.all(np.isfinite(found)):
        raise ValueError(f"path: {path}: {key} must be {count} numbers; got {fields[key][:80]!r}.")
    return found


def _voxels(path: Path, fields: dict[str, str], begin: int, shape: tuple[int, int, int]) -> np.ndarray:
    kind = fields.get("ElementType", "")
    if kind not in TYPES:
        raise ValueError(f"path: {path}: ElementType must be one of {', '.join(TYPES)}; got {kind[:40]!r}.")
    dtype = np.dtype(TYPES[kind]).newbyteorder(">" if _flag(fields, "ByteOrderMSB") else "<")
    expected = math.prod(shape) * dtype.itemsize
    source = _source(path, fields)
    if not source.is_file():
        raise ValueError(
            f"path: {path} cannot be read: it must hold its voxels, or name one file of them that is there; "
            f"got ElementDataFile = {fields['ElementDataFile'][:80]}."
        )
    text = fields.get("BinaryData", "True").lower().startswith("f")
    if source != path:
        begin = _skipped(path, fields, None if text or _flag(fields, "CompressedData") else source, expected)
    with source.open("rb") as stream, decoding(path):
        stream.seek(begin)
        if text:
            return _from_text(path, stream.read(), shape, dtype)
        if _flag(fields, "CompressedData"):
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)  # zlib's or gzip's
            check_size(path, len(content), expected)
        else:
            held = max(source.stat().st_size - begin, 0)
            check_size(path, min(held, expected), expected)  # other data may follow
            content = read_all(path, _Part(stream, expected), expected)
    return as_array(content, shape, dtype, "F")


def _skipped(path: Path, fields: dict[str, str], source: Path | None, expected: int) -> int:
    """Bytes before the voxels in a file of their own. HeaderSize = -1 says that they are at its end; where
    that begins is known of raw ones (`source`)."""
    told = fields.get("HeaderSize", "0")
    if told == "-1" and source is not None:
        return max(file_size(source) - expected, 0)
    if not (told.isascii() and told.isdigit() and len(told) < 20):
        raise ValueError(
            f"path: {path}: HeaderSize must be a number of bytes, or -1 before raw voxels; got {told[:40]!r}."
        )
    return int(told)


class _Part:
    """At most so many bytes of a stream."""

    def __init__(self, stream: Any, size: int):
        self._stream, self._left = stream, size

    def read(self, size: int = -1, /) -> bytes:
        found = self._stream.read(self._left if size < 0 else min(size, self._left))
        self._left -= len(found)
        return found

    def tell(self) -> int:
        return self._stream.tell()


def _from_text(path: Path, content: bytes, shape: tuple[int, int, int], dtype: np.dtype) -> np.ndarray:
    expected = math.prod(shape)
    numbers = content.split(None, expected)  # what is left is one piece
    check_size(path, len(numbers) * dtype.itemsize, expected * dtype.itemsize)
    try:
        array = np.array([float(number) for number in numbers])
    except ValueError as fault:
        raise ValueError(f"path: {path} must hold numbers in text, as its header says; {fault}.") from fault
    own = dtype.newbyteorder("=")
    if own.kind in "iu":
        limits = np.iinfo(own)
        wrong = ~((array >= limits.min) & (array <= limits.max) & (array == np.rint(array)))
        if wrong.any():
            raise ValueError(
                f"path: {path} must hold integers from {limits.min} to {limits.max}, as its ElementType "
                f"says; got {array[wrong][0]:g}."
            )
    return np.ascontiguousarray(array.astype(own).reshape(shape, order="F"))


def _flag(fields: dict[str, str], key: str) -> bool:
    """Whether a field is true, under its name or with `Binary` or `Element` before it."""
    found = (fields.get(prefix + key, "") for prefix in ("", "BinaryData", "Element"))
    return any(value.lower().startswith(("t", "1")) for value in found)
