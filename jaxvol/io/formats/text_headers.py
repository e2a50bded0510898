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
"""Letters of a field in an NRRD header, at most (comments and pairs may be longer); and fields in a header."""

META_TYPES = dict(
    zip(
        [
            "CHAR",
            "UCHAR",
            "SHORT",
            "USHORT",
            "INT",
            "UINT",
            "LONG",
            "ULONG",
            "LONG_LONG",
            "ULONG_LONG",
            "FLOAT",
            "DOUBLE",
        ],
        ["i1", "u1", "i2", "u2", "i4", "u4", "i4", "u4", "i8", "u8", "f4", "f8"],
        strict=True,
    )
)
NRRD_TYPES = {"signed char": "i1", "uchar": "u1", "unsigned char": "u1", "float": "f4", "double": "f8"}
for bits, names in ((16, "short"), (32, "int"), (64, "longlong,long long")):
    for name in names.split(","):
        NRRD_TYPES |= dict.fromkeys(
            (name, f"signed {name}", f"{name} int", f"int{bits}", f"int{bits}_t"), f"i{bits // 8}"
        )
        unsigned = f"u{name}", f"unsigned {name}", f"unsigned {name} int", f"uint{bits}", f"uint{bits}_t"
        NRRD_TYPES |= dict.fromkeys(unsigned, f"u{bits // 8}")
NRRD_TYPES |= {"int8": "i1", "int8_t": "i1", "uint8": "u1", "uint8_t": "u1", "signed int": "i4"}

SIDES = "left right posterior anterior superior inferior"
DOMAIN = "domain", "space", "???", "none"
"""Kinds of axes of space in NRRD."""


def text_header(
    path: Path, separator: str, last: str = "", longest: int = 2**20
) -> tuple[dict[str, str], int]:
    """The fields of a header in text, and where in the file it ends: at an empty line, or behind the field
    `last`. Raises `ValueError` for more than `MOST_FIELDS`, and fields of more than `longest` letters."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while last not in fields:
            line = stream.readline(2**20).decode("utf-8", "replace").strip()
            if not line:
                break
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


def stored_voxels(
    path: Path, source: Path, begin: int, shape: list[int], dtype: Any, packed: bool
) -> np.ndarray:
    """Voxels of this C-ordered shape from a byte of a file on, by zlib or gzip if `packed`. As many must be there
    as the header of `path` says."""
    expected, dtype = math.prod(shape) * np.dtype(dtype).itemsize, np.dtype(dtype)
    if not source.is_file():
        raise ValueError(
            f"path: {path} cannot be read: there is no file of its voxels, {shortened(str(source))}."
        )
    with source.open("rb") as stream, decoding(path):
        stream.seek(begin)
        if packed:
            content = zlib.decompressobj(wbits=47).decompress(stream.read(), expected + 1)
            check_size(path, len(content), expected, more=source == path)
        else:
            check_size(path, max(source.stat().st_size - begin, 0), expected, more=True)
            content = stream.read(expected)
    return as_array(content[:expected], shape, dtype, "C")


def read_nrrd(path: Path) -> ImageRecord:
    """Reader for `.nrrd` and `.nhdr`, whose space may be that of a patient; its lengths in `space units`."""
    file_size(path)
    fields, begin, source = nrrd_header(path)
    if not next(iter(fields), "").startswith("nrrd00") or not source.is_file():
        raise ValueError(
            f"path: {path} cannot be read: it must be a NRRD file that holds its voxels, or names one file of them; got "
            f"{shortened(next(iter(fields), ''))} and {shortened(str(source))}."
        )
    encoding, kind = fields.get("encoding", "").lower(), fields.get("type", "").lower()
    if encoding not in ("raw", "gzip", "gz") or kind not in NRRD_TYPES:
        raise ValueError(
            f"path: {path} must hold its voxels, or name one file of them, in the encoding raw or gzip, as "
            f"numbers; got {shortened(encoding)} of type {shortened(kind)}."
        )

    def numbers(name: str, default: str, count: int) -> np.ndarray:
        words = re.findall(r"[^\s,()]+", fields.get(name, default))
        try:
            return np.array(words, float).reshape(count, -1)
        except ValueError as fault:
            got = shortened(fields.get(name, default))
            raise ValueError(f"path: {path}: {name} must be numbers for {count} axes; got {got}.") from fault

    shape = numbers("sizes", "", 1)[0]
    n = len(shape)
    if not np.all((shape >= 1) & (shape < 2**40) & (shape == np.rint(shape))):
        raise ValueError(
            f"path: {path}: sizes must be numbers of voxels; got {shortened(fields.get('sizes'))}."
        )
    shape = shape.astype(int).tolist()
    check_volume(path, shape)
    skip = int(numbers("byteskip", "0", 1)[0, 0])
    dtype = np.dtype(NRRD_TYPES[kind]).newbyteorder(">" if fields.get("endian", "").lower() == "big" else "<")
    with source.open("rb") as stream:
        stream.seek(begin)
        for _ in range(min(int(numbers("lineskip", "0", 1)[0, 0]), 2**20)):
            stream.readline(2**20)
        begin = stream.tell() + max(skip, 0)
    if skip == -1 and encoding == "raw":
        begin = max(source.stat().st_size - math.prod(shape) * dtype.itemsize, 0)
    data = stored_voxels(path, source, begin, shape[::-1], dtype, encoding != "raw")

    directions = re.findall(r"none|\([^)]*\)", fields.get("spacedirections", "").lower())
    kinds = [*fields.get("kinds", "").lower().split(), *["domain"] * n]
    axes, inside, others = "", [], iter("tcs")
    for k in range(n):
        placed = [*directions, *["none"] * n][k] != "none" if directions else kinds[k] in DOMAIN
        if placed and len(inside) < 3:
            axes, inside = axes + "xyz"[len(inside)], [*inside, k]
        else:
            axes += next(others, "s") if kinds[k] in (*DOMAIN, "time") else "s"
    if len(inside) < 3:
        raise ValueError(
            f"path: {path} must be a 3-D image; got axes of the kinds {shortened(' '.join(kinds[:n]))}."
        )
    names = re.findall(r'"([^"]*)"', fields.get("labels", ""))
    if not directions and sorted(name.lower() for name in names) == sorted(axes):
        axes = "".join(names).lower()
    units = re.findall(r'"([^"]*)"', fields.get("spaceunits" if directions else "units", ""))
    units = units if directions or len(units) != n else [units[k] for k in inside]
    record = ImageRecord(data, axes[::-1], units=dict(zip("xyz", units, strict=False)), what=f"path: {path}")
    words = [word for word in re.split(r"[-\s]", fields.get("space", "").lower()) if word != "time"]
    letters = (
        "".join(word[:1] for word in words).upper()
        if {*words} <= {*SIDES.split()}
        else fields.get("space", "").upper()
    )
    record.convention = letters if re.fullmatch("(?=.*[LR])(?=.*[PA])(?=.*[SI])[LRPASI]{3}", letters) else ""
    if directions:
        text = " ".join(directions[k] for k in inside)
        fields["spacedirections"] = text
        columns, origin = numbers("spacedirections", "", 3)[:, :3], numbers("spaceorigin", "0 0 0", 1)[0, :3]
        if columns.shape != (3, 3) or origin.size != 3:
            raise ValueError(
                f"path: {path}: space directions must be three vectors of 3 numbers; got {text[:80]}."
            )
        for name, part in grid_of(np.column_stack([columns.T, origin])).items():
            setattr(record, name, part)
    elif "spacings" in fields or "axismins" in fields:
        spacings = numbers("spacings", "1 " * n, n)[inside, 0]
        if not np.all(spacings > 0) or not np.all(np.isfinite(spacings)):
            got = shortened(fields.get("spacings"))
            raise ValueError(f"path: {path}: spacings must be positive, for 3 axes; got {got}.")
        record.steps = dict(zip("xyz", spacings.tolist(), strict=True))
        at_nodes = "node" in fields.get("centers", fields.get("centerings", "")).lower()
        mins = numbers("axismins", "nan " * n, n)[inside, 0] + (0 if at_nodes else spacings / 2)
        record.origin = np.where(np.isfinite(mins), mins, 0.0)
    for key, value in fields.items():
        if (found := re.fullmatch(r"segment(\d+)_labelvalue", key)) and value[1:].strip().isdigit():
            name = fields.get(f"segment{found[1]}_name", "=?")[1:]
            record.labels = {**record.labels, int(value[1:]): name.strip()}
    return record


def nrrd_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of an NRRD file, in small letters without blanks, its magic the first; where its voxels
    begin, and in which file, which may be missing."""
    found, end = text_header(path, ":", longest=LONGEST)
    fields = {key.lower().replace(" ", ""): value for key, value in found.items()}
    named = fields.get("datafile")
    return (fields, end, path) if named is None else (fields, 0, path.parent / named)


def read_metaimage(path: Path) -> ImageRecord:
    """Reader for `.mha` and `.mhd` of binary voxels, in LPS."""
    file_size(path)
    fields, begin, source = metaimage_header(path)
    shape = [_natural(size) for size in fields.get("DimSize", "").split()]
    n, channels = len(shape), _natural(fields.get("ElementNumberOfChannels", "1"))
    check_volume(path, shape, channels)
    kind = fields.get("ElementType", "").removeprefix("MET_")
    if kind not in META_TYPES or not _flag(fields, "BinaryData", "T"):
        raise ValueError(
            f"path: {path}: ElementType must be one of {', '.join(f'MET_{name}' for name in META_TYPES)}, and "
            f"BinaryData true; got {fields.get('ElementType', '')[:40]!r} and "
            f"{fields.get('BinaryData', 'True')[:20]!r}."
        )
    msb = any(_flag(fields, f"{prefix}ByteOrderMSB") for prefix in ("", "BinaryData", "Element"))
    dtype = np.dtype(META_TYPES[kind]).newbyteorder(">" if msb else "<")
    if source != path and source.is_file():
        skipped = fields.get("HeaderSize", "0")  # -1: voxels are at the end of the file
        expected = channels * math.prod(shape) * dtype.itemsize
        begin = max(source.stat().st_size - expected, 0) if skipped == "-1" else _natural(skipped)
        if begin < 0:
            raise ValueError(f"path: {path}: HeaderSize must be a number of bytes; got {skipped[:40]!r}.")
    sizes = shape[::-1] + [channels] * (channels > 1)
    data = stored_voxels(path, source, begin, sizes, dtype, _flag(fields, "CompressedData"))
    steps = _numbers(path, fields, ("ElementSpacing", "ElementSize"), np.ones(n))[:3].tolist()
    # the axes of the data follow each other; here they are columns
    turn = _numbers(path, fields, ("TransformMatrix", "Rotation", "Orientation"), np.eye(n)).T[:3, :3]
    return ImageRecord(
        data,
        "xyztc"[:n][::-1] + "s" * (channels > 1),
        dict(zip("xyz", steps, strict=True)),
        fields.get("DistanceUnits", "mm").strip("?") or "mm",
        _numbers(path, fields, ("Offset", "Position", "Origin"), np.zeros(n))[:3],
        turn,
        "LPS",
        what=f"path: {path}",
    )


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
