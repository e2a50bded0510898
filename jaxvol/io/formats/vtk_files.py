"""Reads VTK's images: XML (`.vti`) and legacy files (`.vtk`) of structured points. VTK itself takes memory as
headers say."""

import base64
import math
import re
import zlib
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..._util.checks import shortened
from ..._util.files import check_size, ensure
from ..._util.image_record import ImageRecord
from ..._util.named_axes import vtk_record, vtk_sizes


LEGACY = {"char": "i1", "short": "i2", "int": "i4", "long": "i8", "vtktypeint64": "i8"}
LEGACY |= {f"unsigned_{name}": f"u{code[1]}" for name, code in LEGACY.items()}
LEGACY |= {"vtktypeuint64": "u8", "float": "f4", "double": "f8"}


def read_vtk(path: Path) -> ImageRecord:
    """Reader for both: the scalars at points, else the first array; of cells, at their centres."""
    content = path.read_bytes()
    return (_xml if content.lstrip()[:1] == b"<" else _legacy)(path, content)


def _record(path: Path, held: Any, dtype: np.dtype, count: int, *grid: Any) -> ImageRecord:
    """The record of bytes, or of words of text. `grid`: extent, whether of cells, place (`vtk_record`)."""
    is_text = isinstance(held, list)
    values = math.prod(vtk_sizes(*grid[:2])) * count
    check_size(path, len(held), values * (1 if is_text else dtype.itemsize))
    data = np.array(held, float).astype(dtype.newbyteorder("=")) if is_text else np.frombuffer(held, dtype)
    return vtk_record(data.reshape(-1, count), *grid)


def _legacy(path: Path, content: bytes) -> ImageRecord:
    """The record of a legacy file, whose binary numbers are big-endian."""
    last = rb"\n(LOOKUP_TABLE[^\n]*|COLOR_SCALARS[^\n]*|(?:\w+ \d+ \d+ [a-zA-Z]\w+))[ \t]*\r?\n"
    end = re.search(last, content)
    head = content[: end.end() if end else 2**12].decode("latin-1")
    words = {line.split()[0].upper(): line.split()[1:] for line in head.splitlines()[2:] if line.split()}
    dataset = words.get("DATASET", ["none"])
    if not head.startswith("# vtk DataFile") or dataset != ["STRUCTURED_POINTS"] or end is None:
        got = shortened(" ".join(dataset))
        raise ValueError(f"path: {path} must hold a DATASET of STRUCTURED_POINTS with scalars; got {got}.")
    if "SCALARS" in words:
        kind, count = [*words["SCALARS"], "1"][1:3]
    elif "COLOR_SCALARS" in words:
        kind, count = "unsigned_char", words["COLOR_SCALARS"][-1]
    else:  # a field's first array
        _, count, _, kind = end[1].decode().split()
    dtype, counts = np.dtype(LEGACY[kind.lower()]).newbyteorder(">"), [int(n) for n in words["DIMENSIONS"]]
    extent = [end for n in counts for end in (0, n - 1)]
    of_cells = "CELL_DATA" in words and "POINT_DATA" not in words
    total = math.prod(vtk_sizes(extent, of_cells)) * int(count)
    if "BINARY" in words:
        held: Any = content[end.end() : end.end() + total * dtype.itemsize]
    else:
        held = content[end.end() :].split(None, total)[:total]
        if "COLOR_SCALARS" in words:  # from 0 to 1
            held = [round(255 * float(word)) for word in held]
    spacing = words.get("SPACING") or words.get("ASPECT_RATIO") or np.ones(3)
    place = spacing, words.get("ORIGIN", np.zeros(3)), np.eye(3)
    return _record(path, held, dtype, int(count), extent, of_cells, place)


def _xml(path: Path, content: bytes) -> ImageRecord:
    """The record of an XML file of arrays in ASCII, base64 or appended, also compressed by zlib."""
    raw = re.search(rb"<AppendedData[^>]*>\s*_", content)
    text = content[: raw.end() - 1] + b"</AppendedData></VTKFile>" if raw else content
    is_plain = b"<!DOCTYPE" not in text and b"<!ENTITY" not in text  # which may expand without end
    ensure(is_plain, f"path: {path} must be XML without a DOCTYPE.")
    root: Any = ElementTree.fromstring(text)
    pieces, compressor = root.findall("ImageData/Piece"), root.get("compressor")
    must = f"path: {path} must hold one Piece of ImageData, plain or compressed by zlib"
    told = f"{root.get('type')} of {len(pieces)} pieces, {compressor}"
    ensure(len(pieces) == 1 and compressor in (None, "vtkZLibDataCompressor"), f"{must}; got {told}.")
    image, parts = (
        root.find("ImageData"),
        [part for part in pieces[0] if part.tag in ("PointData", "CellData")],
    )
    part = next(part for part in parts if part.find("DataArray") is not None)
    named = (a for a in part.findall("DataArray") if a.get("Name") == part.get("Scalars"))
    array = next(named, part.find("DataArray"))
    order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
    dtype, count = np.dtype(array.get("type").lower()), int(array.get("NumberOfComponents", "1"))
    ensure(dtype.kind in "iuf", f"path: {path} must hold an array of numbers; got {dtype}.")
    if array.get("format") == "ascii":
        held: Any = (array.text or "").split()
    else:
        inside = array.get("format") == "appended" and raw is not None
        store = content[raw.end() + int(array.get("offset", "0")) :] if inside else (array.text or "").strip()
        is_raw = inside and root.find("AppendedData").get("encoding") == "raw"
        word = np.dtype("u8" if root.get("header_type") == "UInt64" else "u4").newbyteorder(order)
        held = _bytes(store if inside else store.encode(), word, is_raw=is_raw, packed=compressor is not None)
    extent = pieces[0].get("Extent", image.get("WholeExtent", "")).split()
    defaults = {"Spacing": "1 1 1", "Origin": "0 0 0", "Direction": "1 0 0 0 1 0 0 0 1"}
    place = [image.get(name, default).split() for name, default in defaults.items()]
    return _record(path, held, dtype.newbyteorder(order), count, extent, part.tag == "CellData", place)


def _bytes(store: bytes, word: np.dtype, *, is_raw: bool, packed: bool) -> bytes:
    """The bytes of an array behind its header: its length, or numbers and lengths of compressed blocks."""

    def taken(begin: int, count: int) -> bytes:
        length = count if is_raw else 4 * math.ceil(count / 3)
        part = store[begin : begin + length]
        return (part if is_raw else base64.b64decode(part))[:count]

    first = int(np.frombuffer(taken(0, word.itemsize), word)[0])
    if not packed:
        return taken(0, word.itemsize + min(first, len(store)))[word.itemsize :]
    head = taken(0, (3 + min(first, len(store))) * word.itemsize)  # base64 begins again behind it
    most, lengths = int(np.frombuffer(head, word)[1]), np.frombuffer(head, word)[3:].tolist()
    body = taken(len(head) if is_raw else 4 * math.ceil(len(head) / 3), min(sum(lengths), len(store)))
    ends = np.cumsum([0, *lengths]).tolist()
    return b"".join(zlib.decompressobj().decompress(body[a:b], most) for a, b in pairwise(ends))
