"""Reads VTK's images: XML (`.vti`) and legacy files (`.vtk`) of structured points. VTK itself takes memory as
headers say."""

import base64
import math
import re
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..._util.checks import shortened
from ..._util.files import as_array, check_size, file_size, reason
from ..._util.image_record import ImageRecord
from ..._util.named_axes import grid_of


LEGACY = {"char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4"}
LEGACY |= {"unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "float": "f4", "double": "f8"}
LEGACY |= {"vtktypeint64": "i8", "vtktypeuint64": "u8"}
NUMBER = re.compile(r"(U?Int|Float)(8|16|32|64)")


def read_vtk(path: Path) -> ImageRecord:
    """Reader for both: the scalars at points, else the first array; of cells, at their centres."""
    file_size(path)
    content = path.read_bytes()
    try:
        return (_xml if content.lstrip()[:1] == b"<" else _legacy)(path, content)
    except Exception as fault:  # of many kinds
        told = (
            str(fault) if str(fault).startswith("path:") else f"path: {path} cannot be read: {reason(fault)}."
        )
        raise ValueError(told) from fault


def _record(path: Path, array: np.ndarray, sizes: list[int], place: Any, of_cells: bool) -> ImageRecord:
    """`array`: flat, x fastest. `place`: extent's first point, spacing, origin, direction."""
    first, spacing, origin, turn = (np.asarray(part, float) for part in place)
    columns = turn.reshape(3, 3) * spacing
    affine = np.column_stack([columns, origin + columns @ (first + 0.5 * of_cells)])
    components = array.size // math.prod(sizes)
    data = array.reshape(*sizes[::-1], components)
    several = components > 1
    return ImageRecord(
        data if several else data[..., 0],
        "zyx" + "s" * several,
        what=f"path: {path}: its place",
        **grid_of(affine),
    )


def _counts(path: Path, points: list[int], of_cells: bool) -> list[int]:
    sizes = [max(n - 1, 1) if of_cells else n for n in points]
    if len(sizes) != 3 or min(sizes) < 1 or math.prod(sizes) >= 2**40:
        raise ValueError(f"path: {path} must be a 3-D image of voxels; its header says {points} points.")
    return sizes


def _legacy(path: Path, content: bytes) -> ImageRecord:
    if not content.startswith(b"# vtk DataFile"):
        raise ValueError(f"path: {path} must begin with '# vtk DataFile'; got {shortened(content[:20])}.")
    end = re.search(rb"\n(LOOKUP_TABLE[^\n]*|COLOR_SCALARS[^\n]*|(?:[\w]+ \d+ \d+ \w+))[ \t]*\r?\n", content)
    head = content[: end.end() if end else 2**12].decode("latin-1")
    words = {line.split()[0].upper(): line.split()[1:] for line in head.splitlines()[2:] if line.split()}
    if words.get("DATASET") != ["STRUCTURED_POINTS"] or end is None:
        kind = shortened(" ".join(words.get("DATASET", ["none"])))
        raise ValueError(f"path: {path} must hold a DATASET of STRUCTURED_POINTS with scalars; got {kind}.")
    of_cells = "CELL_DATA" in words and "POINT_DATA" not in words
    sizes = _counts(path, [int(word) for word in words["DIMENSIONS"]], of_cells)
    if "SCALARS" in words:
        kind, count = words["SCALARS"][1], int((words["SCALARS"] + ["1"])[2])
    elif "COLOR_SCALARS" in words:
        kind, count = "unsigned_char", int(words["COLOR_SCALARS"][1])
    else:  # a field's first array
        _, components, _, kind = end[1].decode().split()
        count = int(components)
    dtype = np.dtype(LEGACY[kind.lower()]).newbyteorder(">")
    total = math.prod(sizes) * count
    if "BINARY" in words:
        held = content[end.end() : end.end() + total * dtype.itemsize]
        check_size(path, len(held), total * dtype.itemsize)
        array = as_array(held, (total,), dtype, "C")
    else:
        numbers = content[end.end() :].split(None, total)[:total]
        check_size(path, len(numbers) * dtype.itemsize, total * dtype.itemsize)
        array = np.array(numbers, float).astype(dtype.newbyteorder("="))
    spacing = words.get("SPACING") or words.get("ASPECT_RATIO") or ["1", "1", "1"]
    place = (0, 0, 0), spacing, words.get("ORIGIN", ["0", "0", "0"]), np.eye(3)
    return _record(path, array, sizes, [[float(n) for n in np.ravel(part)] for part in place], of_cells)


def _xml(path: Path, content: bytes) -> ImageRecord:
    """Of arrays in ASCII, base64 or appended, also compressed by zlib."""
    raw = re.search(rb"<AppendedData[^>]*>\s*_", content)
    end = content.rfind(b"</AppendedData>") if raw else -1
    appended = content[raw.end() : end if end > 0 else len(content)] if raw else b""
    text = content[: raw.end() - 1] + b"</AppendedData></VTKFile>" if raw else content
    if b"<!DOCTYPE" in text[:4096] or b"<!ENTITY" in text:  # which may expand without end
        raise ValueError(f"path: {path} must be XML without a DOCTYPE.")
    root = ElementTree.fromstring(text)
    image, order = (
        root.find("ImageData"),
        "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">",
    )
    pieces = image.findall("Piece") if image is not None else []
    if image is None or len(pieces) != 1:
        raise ValueError(
            f"path: {path} must hold one Piece of ImageData; got {root.get('type')}, {len(pieces)} pieces."
        )
    extent = [int(word) for word in pieces[0].get("Extent", image.get("WholeExtent", "")).split()]
    parts = [(kind, pieces[0].find(kind)) for kind in ("PointData", "CellData")]
    of_cells, part = next(
        (kind == "CellData", p) for kind, p in parts if p is not None and p.find("DataArray") is not None
    )
    arrays = part.findall("DataArray")
    array = next((each for each in arrays if each.get("Name") == part.get("Scalars")), arrays[0])
    sizes = _counts(path, [b - a + 1 for a, b in zip(extent[::2], extent[1::2], strict=True)], of_cells)
    letters, bits = NUMBER.fullmatch(array.get("type", "")).groups()  # pyright: ignore[reportOptionalMemberAccess]
    dtype = np.dtype({"Int": "i", "UInt": "u", "Float": "f"}[letters] + str(int(bits) // 8)).newbyteorder(
        order
    )
    total = math.prod(sizes) * int(array.get("NumberOfComponents", "1"))
    form, compressor = array.get("format"), root.get("compressor")
    if compressor not in (None, "vtkZLibDataCompressor"):
        raise ValueError(f"path: {path} must be compressed by zlib, or not; got {shortened(compressor)}.")
    if form == "ascii":
        numbers = (array.text or "").split(None, total)[:total]
        check_size(path, len(numbers) * dtype.itemsize, total * dtype.itemsize)
        flat = np.array(numbers, float).astype(dtype.newbyteorder("="))
    else:
        store = (
            appended[int(array.get("offset", "0")) :]
            if form == "appended"
            else (array.text or "").strip().encode()
        )
        data = root.find("AppendedData")
        is_raw = form == "appended" and data is not None and data.get("encoding") == "raw"
        word = np.dtype("u8" if root.get("header_type") == "UInt64" else "u4").newbyteorder(order)
        flat = as_array(
            _blocks(path, store, word, is_raw, compressor, total * dtype.itemsize), (total,), dtype, "C"
        )
    place = (
        extent[::2],
        image.get("Spacing", "1 1 1"),
        image.get("Origin", "0 0 0"),
        image.get("Direction", IDENTITY),
    )
    numbers_of = [[float(n) for n in (part.split() if isinstance(part, str) else part)] for part in place]
    return _record(path, flat, sizes, numbers_of, of_cells)


IDENTITY = "1 0 0 0 1 0 0 0 1"


def _blocks(path: Path, store: bytes, word: np.dtype, is_raw: bool, packed: Any, expected: int) -> bytes:
    """The bytes of an array behind its header: its length, or the numbers and lengths of compressed blocks."""

    def taken(begin: int, count: int) -> bytes:  # base64 restarts behind the header
        if is_raw:
            return store[begin : begin + count]
        return base64.b64decode(store[begin : begin + 4 * math.ceil(count / 3)])[:count]

    def length(count: int) -> int:
        return count if is_raw else 4 * math.ceil(count / 3)

    if not packed:
        whole = taken(0, word.itemsize + expected)
        check_size(path, len(whole) - word.itemsize, expected)
        return whole[word.itemsize :]
    count = int(np.frombuffer(taken(0, word.itemsize), word)[0])
    if not 0 < count <= len(store):
        raise ValueError(f"path: {path} cannot be read: its header says {count} blocks of voxels.")
    head = np.frombuffer(taken(0, (3 + count) * word.itemsize), word)
    content, body = b"", taken(length((3 + count) * word.itemsize), int(sum(map(int, head[3:]))))
    at = 0
    for size in map(int, head[3:]):
        content += zlib.decompressobj().decompress(body[at : at + size], expected + 1 - len(content))
        at += size
    check_size(path, len(content), expected)
    return content
