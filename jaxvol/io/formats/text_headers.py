"""Readers of NRRD and MetaImage: on some headers, ITK would hang, end the process, or leave voxels unset."""

import re
from pathlib import Path

import numpy as np

from ..._util.checks import shortened
from ..._util.files import Refused, check
from ..._util.image_record import ImageRecord
from ..._util.named_axes import grid_of
from .arrays import check_volume, read_voxels


LONGEST, MOST_FIELDS = 900, 1024
"""Maximum letters of a field in an NRRD header (except comments and pairs), and fields in any header."""

META_TYPES = {"MET_CHAR": "i1", "MET_SHORT": "i2", "MET_INT": "i4", "MET_LONG": "i4", "MET_LONG_LONG": "i8"}
META_TYPES |= {name.replace("_", "_U", 1): f"u{code[1]}" for name, code in META_TYPES.items()}
META_TYPES |= {"MET_FLOAT": "f4", "MET_DOUBLE": "f8"}
NRRD_TYPES = {name[4:].replace("_", "").lower(): code for name, code in META_TYPES.items()}
NRRD_TYPES |= {np.dtype(code).name: code for code in META_TYPES.values()} | {"long": "", "ulong": ""}
"""Types by name, without "signed" and blanks, and without "int" and "_t" at the end."""

DOMAIN = "domain", "space", "???", "none"  # kinds of spatial axes in NRRD


def text_header(path: Path, separator: str, last: str, longest: int = 2**20) -> tuple[dict[str, str], int]:
    """Fields of a text header, and the position of its end: an empty line, or the end of the field `last`."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while last not in fields and (line := stream.readline(2**20).decode("utf-8", "replace").strip()):
            key, _, value = line.partition(separator)
            is_long = len(line) > longest and not (key.startswith("#") or value.startswith("="))
            check(not is_long, f"cannot be read: its header has the field {shortened(line)}.")
            fault = f"cannot be read: its header has more than {MOST_FIELDS} fields."
            check(len(fields) < MOST_FIELDS, fault)
            fields[key.strip()] = value.strip()
        return fields, stream.tell()


def _numbers(fields: dict[str, str], names: str, default: np.ndarray) -> np.ndarray:
    """Numbers of the first existing field of `names`, in the shape of `default`."""
    name = next((name for name in names.split() if name in fields), None)
    if name is None:
        return default
    try:
        return np.array(re.findall(r"[^\s,()]+", fields[name]), float).reshape(default.shape)
    except ValueError as fault:
        raise Refused(f": {name} must be {default.size} numbers; got {fields[name][:80]!r}.") from fault


def _sizes(text: str, channels: int = 1) -> list[int]:
    are_numbers = all(re.fullmatch("[0-9]{1,15}", word) for word in text.split())
    check(are_numbers, f": sizes must be numbers of voxels; got {shortened(text)}.")
    sizes = [*map(int, text.split())]
    check_volume(sizes, channels)
    return sizes


def read_nrrd(path: Path) -> ImageRecord:
    """Reader of `.nrrd` and `.nhdr`, whose space may be a patient's, with lengths in `space units`."""
    header, begin = text_header(path, ":", "", LONGEST)
    fields = {key.lower().replace(" ", ""): value for key, value in header.items()}
    begin, source = (0, path.parent / fields["datafile"]) if "datafile" in fields else (begin, path)
    encoding, magic = fields.get("encoding", "").lower(), next(iter(fields), "")
    must = "a NRRD file holds its voxels, or names one file of them, in the encoding raw or gzip"
    got = f"{shortened(magic)}, {shortened(encoding)}, {shortened(str(source))}"
    is_read = magic.startswith("nrrd00") and encoding in ("raw", "gzip", "gz") and source.is_file()
    check(is_read, f"cannot be read: {must}; got {got}.")
    kind, shape = fields.get("type", "").lower(), _sizes(fields.get("sizes", ""))
    code, n = NRRD_TYPES.get(re.sub("nsigned | int$|_t$|^signed | ", "", kind), ""), len(shape)
    check(code, f": type must be one of numbers; got {shortened(kind)}.")
    dtype = np.dtype(code).newbyteorder(">" if fields.get("endian", "").lower() == "big" else "<")
    lines, skip = (int(_numbers(fields, name, np.zeros(1))[0]) for name in ("lineskip", "byteskip"))
    with source.open("rb") as stream:
        stream.seek(begin)
        for _ in range(min(lines, 2**20)):
            stream.readline(2**20)
        begin = stream.tell() + skip if skip >= 0 else -1
    packed = "" if encoding == "raw" else "zlib"
    data = read_voxels(source, shape[::-1], dtype, begin, packed, more=not packed or source == path)
    vectors = re.findall(r"none|\([^)]*\)", fields.get("spacedirections", "").lower())
    kinds = [*fields.get("kinds", "").lower().split(), *["domain"] * n][:n]
    placed = [vector != "none" for vector in vectors] if vectors else [kind in DOMAIN for kind in kinds]
    inside, free = [k for k, is_placed in enumerate(placed[:n]) if is_placed][:3], iter("tcs")
    check(len(inside) == 3, f"must be a 3-D image; got axes of kinds {shortened(str(kinds))}.")
    letters = dict(zip(inside, "xyz", strict=True))
    axes = [letters.get(k) or (next(free, "s") if kinds[k] in (*DOMAIN, "time") else "s") for k in range(n)]
    quoted = {key: re.findall('"([^"]*)"', fields.get(key, "")) for key in ("labels", "spaceunits", "units")}
    labels = [name.lower() for name in quoted["labels"]]
    axes = labels if not vectors and sorted(labels) == sorted(axes) else axes
    units = [unit for k, unit in enumerate(quoted["units"]) if k in inside]
    units = dict(zip("xyz", quoted["spaceunits"] if vectors else units, strict=False))
    space = fields.get("space", "").upper()
    space = "".join(word[0] for word in re.findall("[A-Z]+", space)) if "-" in space else space
    record = ImageRecord(data, "".join(axes[::-1]), units=units)
    record.convention = space[:3] if re.fullmatch("[LR][AP][SI]T?", space) else ""
    if vectors:
        text = [vectors[k] for k in inside]
        d = text[0].count(",") + 1
        columns = _numbers({"spacedirections": " ".join(text)}, "spacedirections", np.zeros((3, d)))[:, :3]
        origin = _numbers(fields, "spaceorigin", np.zeros(d))[:3]
        check(d >= 3, f": space directions must be of 3 numbers; got {text[0][:80]}.")
        vars(record).update(grid_of(np.column_stack([columns.T, origin])))
    elif {"spacings", "axismins"} & fields.keys():
        spacings = _numbers(fields, "spacings", np.ones(n))[inside]
        check(np.all(spacings > 0), f": spacings must be positive, for 3 axes; got {spacings.tolist()}.")
        record.steps = dict(zip("xyz", spacings.tolist(), strict=True))
        is_node = "node" in fields.get("centers", fields.get("centerings", "")).lower()
        mins = _numbers(fields, "axismins", np.full(n, np.nan))[inside] + (0 if is_node else spacings / 2)
        record.origin = np.where(np.isfinite(mins), mins, 0.0)
    for key, value in fields.items():
        if re.fullmatch(r"segment\d+_labelvalue", key) and value[1:].strip().isdigit():
            name = fields.get(key.replace("labelvalue", "name"), "=?")[1:].strip()
            record.labels = {**record.labels, int(value[1:]): name}
    return record


def read_metaimage(path: Path) -> ImageRecord:
    """Reader of `.mha` and `.mhd` with binary voxels, in LPS."""
    fields, begin = text_header(path, "=", "ElementDataFile")
    check("ElementDataFile" in fields, "cannot be read: its header must end in the field ElementDataFile.")
    data_file = fields["ElementDataFile"]
    source = path if data_file.upper() == "LOCAL" else path.parent / data_file
    channels = fields.get("ElementNumberOfChannels", "1")
    channels = int(channels) if re.fullmatch("[1-9][0-9]{0,8}", channels) else 0
    shape = _sizes(fields.get("DimSize", ""), channels)
    n = len(shape)

    def flag(key: str) -> bool:
        return fields.get(key, "").lower().startswith(("t", "1"))

    kind, text = fields.get("ElementType", ""), fields.setdefault("BinaryData", "True")
    must = f"ElementType must be one of {', '.join(META_TYPES)}, and BinaryData true"
    is_read = kind in META_TYPES and flag("BinaryData")
    check(is_read, f": {must}; got {kind[:40]!r} and {text[:20]!r}.")
    check(source.is_file(), f"cannot be read: there is no file of its voxels, {shortened(str(source))}.")
    if source != path:
        size = fields.get("HeaderSize", "0")  # -1: voxels are at the end of the file
        is_size = re.fullmatch("-1|[0-9]{1,15}", size)
        check(is_size, f": HeaderSize must be a number of bytes; got {size[:40]!r}.")
        begin = int(size)
    is_big = any(flag(f"{prefix}ByteOrderMSB") for prefix in ("", "BinaryData", "Element"))
    dtype, several = np.dtype(META_TYPES[kind]).newbyteorder(">" if is_big else "<"), channels > 1
    packed, sizes = "zlib" if flag("CompressedData") else "", [*shape[::-1], *[channels] * several]
    data = read_voxels(source, sizes, dtype, begin, packed, more=not packed or source == path)
    steps = _numbers(fields, "ElementSpacing ElementSize", np.ones(n))[:3].tolist()
    origin = _numbers(fields, "Offset Position Origin", np.zeros(n))[:3]
    # the file lists the directions one after the other; here they are columns
    turn = _numbers(fields, "TransformMatrix Rotation Orientation", np.eye(n)).T[:3, :3]
    axes, steps = "xyztc"[:n][::-1] + "s" * several, dict(zip("xyz", steps, strict=True))
    unit = fields.get("DistanceUnits", "mm").strip("?") or "mm"
    return ImageRecord(data, axes, steps, unit, origin, turn, "LPS")
