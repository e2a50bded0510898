"""Reads formats of a header in text before voxels: NRRD (`.nrrd`, `.nhdr`) and MetaImage (`.mha`, `.mhd`).

ITK, which also reads them, hangs on some headers, ends the process on others, and leaves voxels unset where a
header understates the number of compressed bytes.
"""

import math
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import shortened
from ..._util.files import as_array, check_size, decoding, file_size
from ..._util.image_record import ImageRecord
from ..._util.named_axes import grid_of


LONGEST, MOST_FIELDS = 900, 1024
"""Letters of a field in an NRRD header, at most (comments and pairs may be longer); and fields in a
header."""

META_TYPES = {"MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8"}
META_TYPES |= {name.replace("_", "_U", 1): f"u{code[1]}" for name, code in META_TYPES.items()}
META_TYPES |= {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
NRRD_TYPE = re.compile(r"(un?)?(?:signed )?(char|short|longlong|long long|int)(8|16|32|64)?(?: int|_t)?")
BYTES = {"char": 1, "short": 2, "int": 4, "longlong": 8, "long long": 8}
DOMAIN = "domain", "space", "???", "none"
"""Kinds of axes of space in NRRD."""


def text_header(
    path: Path, separator: str, last: str = "", longest: int = 2**20
) -> tuple[dict[str, str], int]:
    """The fields of a header in text, and where in the file it ends: at an empty line, or behind the field
    `last`. Raises `ValueError` for more than `MOST_FIELDS`, and fields of more than `longest` letters."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while last not in fields and (line := stream.readline(2**20).decode("utf-8", "replace").strip()):
            key, _, value = line.partition(separator)
            long = len(line) > longest and not (key.startswith("#") or value.startswith("="))
            if long or len(fields) == MOST_FIELDS:
                told = f"the field {shortened(line)}" if long else f"more than {MOST_FIELDS} fields"
                raise ValueError(f"path: {path} cannot be read: its header has {told}.")
            fields[key.strip()] = value.strip()
        return fields, stream.tell()


def check_volume(path: Path, size: Any, channels: Any = 1) -> None:
    """Raises `ValueError` for an image that is no volume, or several of them along further axes."""
    if not 3 <= len(size) <= 5 or channels < 1 or min(size) < 1 or math.prod(size) * channels >= 2**62:
        raise ValueError(
            f"path: {path} must be a 3-D image, or several along further axes, of fewer than 2**31 voxels; "
            f"got size {tuple(size)} and {channels} values per voxel."
        )


def _voxels(
    path: Path, source: Path, begin: int, shape: list[int], dtype: Any, *, packed: bool
) -> np.ndarray:
    """Voxels from a byte of a file on (-1: at its end), by zlib or gzip if `packed`."""
    expected, size = math.prod(shape) * dtype.itemsize, file_size(source)
    with source.open("rb") as stream, decoding(path):
        stream.seek(begin if begin >= 0 else max(size - expected, 0))
        if packed:
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)
            check_size(path, len(content), expected, more=source == path)
        else:
            check_size(path, max(size - stream.tell(), 0), expected, more=True)
            content = stream.read(expected)
    return as_array(content[:expected], shape, dtype, "C")


def _numbers(path: Path, fields: dict[str, str], names: str, default: np.ndarray) -> np.ndarray:
    """The numbers of the first of these fields that is there, in the shape of `default`."""
    name = next((name for name in names.split() if name in fields), None)
    if name is None:
        return default
    try:
        return np.array(re.findall(r"[^\s,()]+", fields[name]), float).reshape(default.shape)
    except ValueError as fault:
        got = fields[name][:80]
        raise ValueError(f"path: {path}: {name} must be {default.size} numbers; got {got!r}.") from fault


def _sizes(path: Path, text: str) -> list[int]:
    words = text.split()
    if not all(word.isascii() and word.isdigit() and len(word) < 16 for word in words):
        raise ValueError(f"path: {path}: sizes must be numbers of voxels; got {shortened(text)}.")
    check_volume(path, [*map(int, words)])
    return [*map(int, words)]


def nrrd_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of an NRRD file, in small letters without blanks, its magic the first; where its voxels
    begin, and in which file, which may be missing."""
    found, end = text_header(path, ":", longest=LONGEST)
    fields = {key.lower().replace(" ", ""): value for key, value in found.items()}
    named = fields.get("datafile")
    return (fields, end, path) if named is None else (fields, 0, path.parent / named)


def read_nrrd(path: Path) -> ImageRecord:
    """Reader for `.nrrd` and `.nhdr`, whose space may be that of a patient; its lengths in `space units`."""
    file_size(path)
    fields, begin, source = nrrd_header(path)
    encoding, magic = fields.get("encoding", "").lower(), next(iter(fields), "")
    if not magic.startswith("nrrd00") or encoding not in ("raw", "gzip", "gz") or not source.is_file():
        raise ValueError(
            f"path: {path} cannot be read: a NRRD file holds its voxels, or names one file of them, in the "
            f"encoding raw or gzip; got {shortened(magic)}, {shortened(encoding)}, {shortened(str(source))}."
        )
    kind, shape = fields.get("type", "").lower(), _sizes(path, fields.get("sizes", ""))
    code, found = {"float": "f4", "double": "f8"}.get(kind, ""), NRRD_TYPE.fullmatch(kind)
    if found:
        code = f"{'u' if found[1] else 'i'}{int(found[3]) // 8 if found[3] else BYTES[found[2]]}"
    if not code:
        raise ValueError(f"path: {path}: type must be one of numbers; got {shortened(kind)}.")
    dtype = np.dtype(code).newbyteorder(">" if fields.get("endian", "").lower() == "big" else "<")
    lines, skip = (int(_numbers(path, fields, name, np.zeros(1))[0]) for name in ("lineskip", "byteskip"))
    with source.open("rb") as stream:
        stream.seek(begin)
        for _ in range(min(lines, 2**20)):
            stream.readline(2**20)
        begin = stream.tell() + skip if skip >= 0 else -1
    data, n = _voxels(path, source, begin, shape[::-1], dtype, packed=encoding != "raw"), len(shape)
    axes, inside, others = "", [], iter("tcs")
    vectors = re.findall(r"none|\([^)]*\)", fields.get("spacedirections", "").lower())
    kinds = [*fields.get("kinds", "").lower().split(), *["domain"] * n]
    for k in range(n):
        placed = [*vectors, *["none"] * n][k] != "none" if vectors else kinds[k] in DOMAIN
        if placed and len(inside) < 3:
            axes, inside = axes + "xyz"[len(inside)], [*inside, k]
        else:
            axes += next(others, "s") if kinds[k] in (*DOMAIN, "time") else "s"
    if len(inside) < 3:
        raise ValueError(f"path: {path} must be a 3-D image; got axes of kinds {shortened(str(kinds[:n]))}.")
    quoted = {
        name: re.findall(r'"([^"]*)"', fields.get(name, "")) for name in ("labels", "spaceunits", "units")
    }
    if not vectors and sorted(name.lower() for name in quoted["labels"]) == sorted(axes):
        axes = "".join(quoted["labels"]).lower()
    units = (
        quoted["spaceunits"] if vectors else [quoted["units"][k] for k in inside if k < len(quoted["units"])]
    )
    record = ImageRecord(data, axes[::-1], units=dict(zip("xyz", units, strict=False)), what=f"path: {path}")
    space = fields.get("space", "").upper()
    space = "".join(word[0] for word in re.findall("[A-Z]+", space)) if "-" in space else space
    record.convention = space[:3] if re.fullmatch("[LR][AP][SI]T?", space) else ""
    if vectors:
        text, d = {"spacedirections": " ".join(vectors[k] for k in inside)}, vectors[inside[0]].count(",") + 1
        columns = _numbers(path, text, "spacedirections", np.zeros((3, d)))[:, :3]
        origin = _numbers(path, fields, "spaceorigin", np.zeros(d))[:3]
        if d < 3:
            raise ValueError(
                f"path: {path}: space directions must be of 3 numbers; got {vectors[inside[0]][:80]}."
            )
        vars(record).update(grid_of(np.column_stack([columns.T, origin])))
    elif {"spacings", "axismins"} & fields.keys():
        spacings = _numbers(path, fields, "spacings", np.ones(n))[inside]
        if not np.all(spacings > 0):
            raise ValueError(f"path: {path}: spacings must be positive, for 3 axes; got {spacings.tolist()}.")
        record.steps = dict(zip("xyz", spacings.tolist(), strict=True))
        first = 0 if "node" in fields.get("centers", fields.get("centerings", "")).lower() else spacings / 2
        mins = _numbers(path, fields, "axismins", np.full(n, np.nan))[inside] + first
        record.origin = np.where(np.isfinite(mins), mins, 0.0)
    for key, value in fields.items():
        if (found := re.fullmatch(r"segment(\d+)_labelvalue", key)) and value[1:].strip().isdigit():
            record.labels = {
                **record.labels,
                int(value[1:]): fields.get(f"segment{found[1]}_name", "=?")[1:].strip(),
            }
    return record


def metaimage_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of the header; where it ends, and the file of the voxels, which may be missing."""
    fields, end = text_header(path, "=", "ElementDataFile")
    named = fields.get("ElementDataFile")
    if named is None:
        raise ValueError(
            f"path: {path} cannot be read: no header of a MetaImage, which ends in ElementDataFile."
        )
    return fields, end, path if named.upper() == "LOCAL" else path.parent / named


def read_metaimage(path: Path) -> ImageRecord:
    """Reader for `.mha` and `.mhd` of binary voxels, in LPS."""
    file_size(path)
    fields, begin, source = metaimage_header(path)
    shape, channels = _sizes(path, fields.get("DimSize", "")), fields.get("ElementNumberOfChannels", "1")
    n, channels = len(shape), int(channels) if re.fullmatch("[1-9][0-9]{0,8}", channels) else 0
    check_volume(path, shape, channels)

    def flag(key: str, default: str = "F") -> bool:
        return fields.get(key, default).lower().startswith(("t", "1"))

    kind, text = fields.get("ElementType", ""), fields.get("BinaryData", "True")
    if kind not in META_TYPES or not flag("BinaryData", "T"):
        expected = f"ElementType must be one of {', '.join(META_TYPES)}, and BinaryData true"
        raise ValueError(f"path: {path}: {expected}; got {kind[:40]!r} and {text[:20]!r}.")
    if not source.is_file():
        named = shortened(str(source))
        raise ValueError(f"path: {path} cannot be read: there is no file of its voxels, {named}.")
    if source != path:
        begin = fields.get("HeaderSize", "0")  # -1: voxels are at the end of the file
        if not re.fullmatch("-1|[0-9]{1,15}", begin):
            raise ValueError(f"path: {path}: HeaderSize must be a number of bytes; got {begin[:40]!r}.")
    big = any(flag(f"{prefix}ByteOrderMSB") for prefix in ("", "BinaryData", "Element"))
    dtype, sizes = np.dtype(META_TYPES[kind]).newbyteorder(">" if big else "<"), shape[::-1]
    sizes = [*sizes, channels] if channels > 1 else sizes
    data = _voxels(path, source, int(begin), sizes, dtype, packed=flag("CompressedData"))
    steps = _numbers(path, fields, "ElementSpacing ElementSize", np.ones(n))[:3].tolist()
    origin = _numbers(path, fields, "Offset Position Origin", np.zeros(n))[:3]
    # the axes of the data follow each other; here they are columns
    turn = _numbers(path, fields, "TransformMatrix Rotation Orientation", np.eye(n)).T[:3, :3]
    axes, steps = "xyztc"[:n][::-1] + "s" * (channels > 1), dict(zip("xyz", steps, strict=True))
    unit = fields.get("DistanceUnits", "mm").strip("?") or "mm"
    return ImageRecord(data, axes, steps, unit, origin, turn, "LPS", what=f"path: {path}")
