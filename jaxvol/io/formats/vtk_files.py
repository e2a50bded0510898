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
from ..._util.files import as_array, check_size, file_size, refusing
from ..._util.image_record import ImageRecord
from ..._util.named_axes import grid_of


LEGACY = {"char": "i1", "short": "i2", "int": "i4", "long": "i8", "vtktypeint64": "i8"}
LEGACY |= {f"unsigned_{name}": f"u{code[1]}" for name, code in LEGACY.items()}
LEGACY |= {"vtktypeuint64": "u8", "float": "f4", "double": "f8"}
KINDS = {"Int": "i", "UInt": "u", "Float": "f"}


def read_vtk(path: Path) -> ImageRecord:
    """Reader for both: the scalars at points, else the first array; of cells, at their centres."""
    file_size(path)
    content = path.read_bytes()
    with refusing(path):
        return (_xml if content.lstrip()[:1] == b"<" else _legacy)(path, content)


def _record(
    path: Path, held: Any, dtype: np.dtype, count: Any, extent: Any, place: Any, *, of_cells: bool
) -> ImageRecord:
    """`held`: bytes, or words of text, x fastest. `place`: spacing, origin, direction."""
    first, last = np.array(extent, int).reshape(3, 2).T
    sizes = np.maximum(last - first + (0 if of_cells else 1), 1).tolist()[::-1]
    sizes, total = [*sizes, int(count)], math.prod(sizes) * int(count)
    if isinstance(held, list):
        check_size(path, len(held), total)
        data = np.array(held, float).astype(dtype.newbyteorder("=")).reshape(sizes)
    else:
        check_size(path, len(held), total * dtype.itemsize)
        data = as_array(held, sizes, dtype, "C")
    spacing, origin, turn = (
        np.array(part.split() if isinstance(part, str) else part, float) for part in place
    )
    columns = turn.reshape(3, 3) * spacing
    grid = grid_of(np.column_stack([columns, origin + columns @ (first + 0.5 * of_cells)]))
    several = sizes[3] > 1
    return ImageRecord(data if several else data[..., 0], "zyx" + "s" * several, what=f"path: {path}", **grid)


def _legacy(path: Path, content: bytes) -> ImageRecord:
    end = re.search(
        rb"\n(LOOKUP_TABLE[^\n]*|COLOR_SCALARS[^\n]*|(?:\w+ \d+ \d+ [a-zA-Z]\w+))[ \t]*\r?\n", content
    )
    head = content[: end.end() if end else 2**12].decode("latin-1")
    words = {line.split()[0].upper(): line.split()[1:] for line in head.splitlines()[2:] if line.split()}
    if not head.startswith("# vtk DataFile") or words.get("DATASET") != ["STRUCTURED_POINTS"] or end is None:
        kind = shortened(" ".join(words.get("DATASET", ["none"])))
        raise ValueError(f"path: {path} must hold a DATASET of STRUCTURED_POINTS with scalars; got {kind}.")
    _, kind, count = [
        *words.get("SCALARS", ["", "unsigned_char", words.get("COLOR_SCALARS", "11")[-1]]),
        "1",
    ][:3]
    if "SCALARS" not in words and "COLOR_SCALARS" not in words:  # a field's first array
        _, count, _, kind = end[1].decode().split()
    dtype, counts = np.dtype(LEGACY[kind.lower()]).newbyteorder(">"), [int(n) for n in words["DIMENSIONS"]]
    of_cells = "CELL_DATA" in words and "POINT_DATA" not in words
    total = math.prod(n - of_cells if n > 1 else 1 for n in counts) * int(count)
    if "BINARY" in words:
        held: Any = content[end.end() : end.end() + total * dtype.itemsize]
    else:
        held = content[end.end() :].split(None, total)[:total]
        if "COLOR_SCALARS" in words:  # from 0 to 1
            held = [round(255 * float(word)) for word in held]
    place = (
        words.get("SPACING") or words.get("ASPECT_RATIO") or np.ones(3),
        words.get("ORIGIN", np.zeros(3)),
        np.eye(3),
    )
    return _record(
        path, held, dtype, count, [e for n in counts for e in (0, n - 1)], place, of_cells=of_cells
    )


def _xml(path: Path, content: bytes) -> ImageRecord:
    """Of arrays in ASCII, base64 or appended, also compressed by zlib."""
    raw = re.search(rb"<AppendedData[^>]*>\s*_", content)
    appended = content[raw.end() :] if raw else b""
    text = content[: raw.end() - 1] + b"</AppendedData></VTKFile>" if raw else content
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:  # which may expand without end
        raise ValueError(f"path: {path} must be XML without a DOCTYPE.")
    root = ElementTree.fromstring(text)
    image = root.find("ImageData")
    pieces = [] if image is None else image.findall("Piece")
    if (
        image is None
        or len(pieces) != 1
        or root.get("compressor", "vtkZLibDataCompressor") != "vtkZLibDataCompressor"
    ):
        told = f"{root.get('type')} of {len(pieces)} pieces, {root.get('compressor')}"
        raise ValueError(
            f"path: {path} must hold one Piece of ImageData, plain or compressed by zlib; got {told}."
        )
    array, part = next((a, part) for part in pieces[0] for a in [_chosen(part)] if a is not None)
    letters, bits = re.match(r"(U?Int|Float)(\d+)$", array.get("type", "")).groups()  # pyright: ignore[reportOptionalMemberAccess]
    order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
    dtype, count = np.dtype(f"{order}{KINDS[letters]}{int(bits) // 8}"), array.get("NumberOfComponents", "1")
    extent, of_cells = pieces[0].get("Extent", image.get("WholeExtent", "")).split(), part.tag == "CellData"
    if array.get("format") == "ascii":
        held: Any = (array.text or "").split()
    else:
        inside = array.get("format") == "appended"
        store = appended[int(array.get("offset", "0")) :] if inside else (array.text or "").strip().encode()
        is_raw = inside and root.find("AppendedData").get("encoding") == "raw"  # pyright: ignore[reportOptionalMemberAccess]
        word = np.dtype("u8" if root.get("header_type") == "UInt64" else "u4").newbyteorder(order)
        held = _bytes(store, word, is_raw=is_raw, packed=root.get("compressor") is not None)
    place = (
        image.get("Spacing", "1 1 1"),
        image.get("Origin", "0 0 0"),
        image.get("Direction", "1 0 0 0 1 0 0 0 1"),
    )
    return _record(path, held, dtype, count, extent, place, of_cells=of_cells)


def _chosen(part: Any) -> Any:
    arrays = part.findall("DataArray") if part.tag in ("PointData", "CellData") else []
    return next((a for a in arrays if a.get("Name") == part.get("Scalars")), next(iter(arrays), None))


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
    lengths = np.frombuffer(head, word)[3:].tolist()
    most = int(np.frombuffer(head, word)[1])
    body = taken(len(head) if is_raw else 4 * math.ceil(len(head) / 3), min(sum(lengths), len(store)))
    ends = np.cumsum([0, *lengths]).tolist()
    return b"".join(zlib.decompressobj().decompress(body[a:b], most) for a, b in pairwise(ends))
