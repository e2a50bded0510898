"""Reads NIfTI-1 and NIfTI-2 images (`.nii`, `.nii.gz`), placed as nibabel, FSL and AFNI place them. Writes
NIfTI-1, in whose sform shears are kept, which SimpleITK removes."""

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..._util.affine import SHEARED
from ..._util.files import as_array, decoding, file_size, read_all
from .medical import check_volume, placed


NAMES = "dim datatype pixdim vox_offset slope inter qform_code sform_code qform sform magic units"
LAYOUTS = {
    348: (
        "8i2 i2 8f4 f4 f4 f4 i2 i2 6f4 (3,4)f4 S3 u1",
        (40, 70, 76, 108, 112, 116, 252, 254, 256, 280, 344, 123),
    ),
    540: (
        "8i8 i2 8f8 i8 f8 f8 i4 i4 6f8 (3,4)f8 S3 i4",
        (16, 12, 104, 168, 176, 184, 344, 348, 352, 400, 4, 500),
    ),
}
"""Types and places of these fields, by the size of the header, with which it begins."""

TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8"}
TYPES[1280] = "u8"
COLORS = {128: 3, 2304: 4}
"""How many bytes the types of colours have."""

TO_LPS = np.array([[-1.0], [-1.0], [1.0]])
"""NIfTI's world is right, front, head; ours left, back, head."""


def read_nifti(path: Path) -> dict[str, Any]:
    """Reader for `.nii` and `.nii.gz`. The sform places voxels if its code is positive, with its scales and
    shears; else the qform, if its is; else `pixdim` is their spacing, along axes as in the file. Lengths in m
    or µm, which other readers leave so, become mm."""
    file_size(path)
    packed = path.name.lower().endswith(".gz")
    with decoding(path), gzip.open(path) if packed else path.open("rb") as stream:
        header = _header(path, stream)

        def check(name: str, holds: Any, expected: str) -> None:
            if not holds:  # also of NaN
                raise ValueError(f"path: {path}: {name} must be {expected}; got {header[name].tolist()!r}.")

        kind, pixdim = int(header["datatype"]), header["pixdim"].astype(float)
        shape, channels = header["dim"][1 : 1 + max(header["dim"][0], 0)].tolist(), COLORS.get(kind, 1)
        while len(shape) > 5 and shape[-1] == 1:
            shape.pop()
        check("magic", header["magic"] in (b"n+1", b"n+2"), "n+1 or n+2, of voxels in the same file")
        check("datatype", kind in TYPES or kind in COLORS, f"one of {[*TYPES, *COLORS]}")
        check_volume(path, shape, channels)
        behind = header["vox_offset"] - stream.tell()
        check("vox_offset", 0 <= behind < 2**31, "the byte behind the header at which voxels begin")
        stream.seek(int(behind), 1)
        stored = np.dtype(TYPES.get(kind, "u1")).newbyteorder(header["dim"].dtype.byteorder)
        expected = channels * math.prod(shape) * stored.itemsize
        content = read_all(path, stream, expected, more=True)
    data = np.moveaxis(as_array(content, (channels, *shape), stored, "F"), 0, -1)
    slope, inter = float(header["slope"]), float(header["inter"])
    if channels == 1 and slope and math.isfinite(slope) and (slope, inter) != (1, 0):
        check("inter", math.isfinite(inter), "finite")
        data = _scaled(data, slope, inter)
    axes, unit = {"axes": "xyztc"[: len(shape)] + "s"}, {1: 1e3, 3: 1e-3}.get(int(header["units"]) & 7, 1.0)
    if header["sform_code"] > 0:
        return placed(f"path: {path}: its sform", data, unit * TO_LPS * header["sform"]) | axes
    check("pixdim", np.all(pixdim[1:4] > 0) and np.all(np.isfinite(pixdim[1:4])), "positive lengths")
    if header["qform_code"] <= 0:
        return {"data": data, "spacing": unit * pixdim[1:4]} | axes
    vector = header["qform"][:3].astype(float)
    real = 1 - vector @ vector
    check("qform", real > -1e-3, "a quaternion of length 1, and an offset")
    turn = Rotation.from_quat([*vector, max(real, 0.0) ** 0.5]).as_matrix()
    turn = turn * pixdim[1:4] * (1, 1, -1 if pixdim[0] < 0 else 1)
    affine = np.column_stack([turn, header["qform"][3:]])
    return placed(f"path: {path}: its qform", data, unit * TO_LPS * affine) | axes


def _header(path: Path, stream: Any) -> np.void:
    """The fields of the header, at whose end the stream then stands."""
    begin = stream.read(4)
    for mark in "<>":
        size = int(np.frombuffer(begin, f"{mark}i4")[0]) if len(begin) == 4 else 0
        if size in LAYOUTS and len(rest := stream.read(size - 4)) == size - 4:
            return np.frombuffer(begin + rest, _layout(size, mark))[0]
    raise ValueError(
        f"path: {path} cannot be read: a NIfTI file begins with a header of 348 or 540 bytes, and these with "
        f"that number; this one with the bytes {begin.hex(' ')}. Fetch or write it again."
    )


def _layout(size: int, order: str) -> np.dtype:
    formats, offsets = LAYOUTS[size]
    names, kinds = NAMES.split(), [np.dtype(f"{order}{kind}") for kind in formats.split()]
    return np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": size})


def write_nifti(path: Path, arrays: dict[str, np.ndarray], *, packed: bool) -> None:
    """Write a volume's arrays with an sform, and the same as a qform unless it is sheared, as no qform is."""
    data, spacing = arrays["data"], arrays["spacing"]
    if max(data.shape) >= 2**15:
        raise ValueError(f"path: NIfTI-1 holds fewer than 32768 voxels along an axis; got {data.shape}.")
    fields = np.zeros(1, _layout(348, "<"))
    header, stored = fields[0], data.dtype.newbyteorder("<")
    turn, offset = TO_LPS * arrays.get("direction", np.eye(3)), TO_LPS[:, 0] * arrays["origin"]
    hand = -1.0 if np.linalg.det(turn) < 0 else 1.0
    header["dim"], header["pixdim"][:4] = (3, *data.shape, 1, 1, 1, 1), (hand, *spacing)
    header["datatype"] = next(code for code, kind in TYPES.items() if np.dtype(kind) == data.dtype)
    header["vox_offset"], header["slope"], header["magic"], header["units"] = 352, 1, b"n+1", 2  # mm
    header["sform_code"], header["sform"] = 1, np.column_stack([turn * spacing, offset])
    if np.abs(turn.T @ turn - np.eye(3)).max() <= SHEARED:
        vector = Rotation.from_matrix(turn * (1, 1, hand)).as_quat(canonical=True)[:3]
        header["qform_code"], header["qform"] = 1, (*vector, *offset)
    content = bytearray(fields.tobytes() + bytes(4))
    content[:4], content[72:74] = (348).to_bytes(4, "little"), (8 * stored.itemsize).to_bytes(2, "little")
    content += data.astype(stored).tobytes(order="F")
    path.write_bytes(gzip.compress(content, 6) if packed else content)


def _scaled(data: np.ndarray, slope: float, inter: float) -> np.ndarray:
    """Scaled in float64, and rounded once, a part at a time."""
    found = np.empty(data.shape, np.float64 if data.dtype == np.float64 else np.float32)
    with np.errstate(over="ignore"):  # what is infinite is refused, or replaced, by `load`
        for plane, into in zip(data, found, strict=True):
            into[...] = plane * np.float64(slope) + inter
    return found
