"""Readers of VTK's images (`.vti`, `.vtk`): VTK itself would allocate memory by unchecked headers."""

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
from ..._util.files import check, check_size
from ..._util.image_record import ImageRecord
from ..._util.named_axes import vtk_record, vtk_sizes


LEGACY = {"char": "i1", "short": "i2", "int": "i4", "long": "i8", "vtktypeint64": "i8"}
LEGACY |= {f"unsigned_{name}": f"u{code[1]}" for name, code in LEGACY.items()}
LEGACY |= {"vtktypeuint64": "u8", "float": "f4", "double": "f8"}


def read_vtk(path: Path) -> ImageRecord:
    """Reader of both: the scalars at points, else the first array; values of cells lie at their centres."""
    content = path.read_bytes()
    held, dtype, count, *grid = (_xml if content.lstrip()[:1] == b"<" else _legacy)(content)
    is_text, values = isinstance(held, list), math.prod(vtk_sizes(*grid[:2])) * count
    check_size(len(held), values * (1 if is_text else dtype.itemsize))
    data = np.array(held, float).astype(dtype.newbyteorder("=")) if is_text else np.frombuffer(held, dtype)
    return vtk_record(data.reshape(-1, count), *grid)


def _legacy(content: bytes) -> tuple[Any, ...]:
    """Values as bytes or words, their type and number of components; extent, whether of cells, and place."""
    last = rb"\n(LOOKUP_TABLE[^\n]*|COLOR_SCALARS[^\n]*|(?:\w+ \d+ \d+ [a-zA-Z]\w+))[ \t]*\r?\n"
    match: Any = re.search(last, content)
    end = match.end() if match else 2**12
    head = content[:end].decode("latin-1")
    words = {line.split()[0].upper(): line.split()[1:] for line in head.splitlines()[2:] if line.split()}
    dataset = words.get("DATASET", ["none"])
    is_image = head.startswith("# vtk DataFile") and dataset == ["STRUCTURED_POINTS"] and match
    check(is_image, f"must hold STRUCTURED_POINTS with scalars; got {shortened(' '.join(dataset))}.")
    if "SCALARS" in words:
        kind, count = [*words["SCALARS"], "1"][1:3]
    elif "COLOR_SCALARS" in words:
        kind, count = "unsigned_char", words["COLOR_SCALARS"][-1]
    else:  # a field's first array
        _, count, _, kind = match[1].decode().split()
    dtype = np.dtype(LEGACY[kind.lower()]).newbyteorder(">")
    extent = [end for n in words["DIMENSIONS"] for end in (0, int(n) - 1)]
    of_cells = "CELL_DATA" in words and "POINT_DATA" not in words
    total = math.prod(vtk_sizes(extent, of_cells)) * int(count)
    if "BINARY" in words:
        held: Any = content[end : end + total * dtype.itemsize]
    else:
        held = content[end:].split(None, total)[:total]
        if "COLOR_SCALARS" in words:  # from 0 to 1
            held = [round(255 * float(word)) for word in held]
    spacing = words.get("SPACING") or words.get("ASPECT_RATIO") or np.ones(3)
    return held, dtype, int(count), extent, of_cells, (spacing, words.get("ORIGIN", np.zeros(3)), np.eye(3))


def _xml(content: bytes) -> tuple[Any, ...]:
    """Values and grid, as from `_legacy`, of an array in ASCII, base64 or appended, maybe zlib-compressed."""
    raw = re.search(rb"<AppendedData[^>]*>\s*_", content)
    appended = content[raw.end() :] if raw else b""
    text = content[: raw.end() - 1] + b"</AppendedData></VTKFile>" if raw else content
    is_plain = b"<!DOCTYPE" not in text and b"<!ENTITY" not in text  # entities may expand without end
    check(is_plain, "must be XML without a DOCTYPE.")
    root: Any = ElementTree.fromstring(text)
    pieces, compressor = root.findall("ImageData/Piece"), root.get("compressor")
    is_read = len(pieces) == 1 and compressor in (None, "vtkZLibDataCompressor")
    got = f"{root.get('type')} of {len(pieces)} pieces, {compressor}"
    check(is_read, f"must hold one Piece of ImageData, plain or compressed by zlib; got {got}.")
    image, kinds = root.find("ImageData"), ("PointData", "CellData")
    part = next(part for part in pieces[0] if part.tag in kinds and part.find("DataArray") is not None)
    scalars = (array for array in part.findall("DataArray") if array.get("Name") == part.get("Scalars"))
    array = next(scalars, part.find("DataArray"))
    order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
    dtype = np.dtype(array.get("type").lower()).newbyteorder(order)
    check(dtype.kind in "iuf", f"must hold an array of numbers; got {dtype}.")
    held: Any = (array.text or "").split()
    if array.get("format") != "ascii":
        inside = array.get("format") == "appended"
        store = appended[int(array.get("offset", "0")) :] if inside else (array.text or "").strip().encode()
        is_raw = inside and root.find("AppendedData").get("encoding") == "raw"
        word = np.dtype("u8" if root.get("header_type") == "UInt64" else "u4").newbyteorder(order)
        held = _bytes(store, word, is_raw=is_raw, packed=compressor is not None)
    extent = pieces[0].get("Extent") or image.get("WholeExtent", "")
    places = ("Spacing", "1 1 1"), ("Origin", "0 0 0"), ("Direction", "1 0 0 0 1 0 0 0 1")
    place = [image.get(*field).split() for field in places]
    count, of_cells = int(array.get("NumberOfComponents", "1")), part.tag == "CellData"
    return held, dtype, count, extent.split(), of_cells, place


def _bytes(store: bytes, word: np.dtype, *, is_raw: bool, packed: bool) -> bytes:
    """Bytes of an array after its header: its length, or number, size and lengths of compressed blocks."""

    def decode(begin: int, count: int) -> bytes:
        length = count if is_raw else 4 * math.ceil(count / 3)
        part = store[begin : begin + length]
        return (part if is_raw else base64.b64decode(part))[:count]

    first = int(np.frombuffer(decode(0, word.itemsize), word)[0])
    if not packed:
        return decode(0, word.itemsize + min(first, len(store)))[word.itemsize :]
    head = decode(0, (3 + min(first, len(store))) * word.itemsize)
    _, size, _, *lengths = np.frombuffer(head, word).tolist()
    begin = len(head) if is_raw else 4 * math.ceil(len(head) / 3)  # base64 begins anew after the header
    body = decode(begin, min(sum(lengths), len(store)))
    ends = np.cumsum([0, *lengths]).tolist()
    return b"".join(zlib.decompressobj().decompress(body[a:b], size) for a, b in pairwise(ends))
