"""Reads Kretz ultrasound files (`.vol`, of GE Voluson scanners): voxels as acquired, and where they lie.

A file is 16 bytes of magic and then items: group (u16), element (u16), length (u32), and `length` bytes, all
little-endian. The format is not published; the items that are read (`MEANING`) are those of
`vtkSlicerKretzFileReaderLogic` (SlicerHeart) and plooney/kretz, who found them out from files.

`ToroidalMap` has the readers' place for every voxel but for a shift along z by a and, against SlicerHeart's
RAS axes, the sign of y.
"""

import math
import struct
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from jaxtyping import UInt8

from ..._util.files import MOST_VOXELS, as_array, file_size
from ...march.transforms import ToroidalMap


MAGIC = b"KRETZFILE 1.0   "

ITEM = struct.Struct("<HHI")

MOST_ITEMS = 2**16
"""A file of so many items is refused, so that one of nothing but empty items does not take minutes."""

UNEVEN = 0.01
"""How far an angle may be from evenly spaced ones, in steps: a part of a voxel by which it is misplaced."""

Tag = tuple[int, int]

GAMMA, SIGMA, BETA = ((0xC000, element) for element in (1, 2, 3))
RESOLUTION = (0xC100, 1)
OFFSET_B, OFFSET_A = ((0xC200, element) for element in (1, 2))
BETAS, SIGMAS = ((0xC300, element) for element in (1, 2))
VOXELS = (0xD000, 1)

MEANING = {
    GAMMA: "the number of samples along a beam",  # u16
    SIGMA: "the number of beams",  # u16
    BETA: "the number of planes",  # u16
    RESOLUTION: "the distance between samples",  # f64, in metres
    OFFSET_B: "the distance from the apex to the first sample",  # f64, in samples
    OFFSET_A: "the distance from the motor axis to the apex",  # f64, in samples
    BETAS: "the angles of the planes",  # f64 for each, in radians; π/2 is the middle
    SIGMAS: "the angles of the beams",  # likewise
    VOXELS: "the voxels",  # u8, γ fastest, then σ, then β
}


def refuse_kretz(path: Path) -> NoReturn:
    """Reader for `load`, whose result has no place for the geometry."""
    raise ValueError(
        f"path: {path} is ultrasound as acquired, whose voxels are placed by a probe. "
        "Use volume, probe = jv.load_ultrasound(path), and render with March(step, (probe, ...)); "
        "jv.scan_convert(volume, probe) makes a Cartesian volume of them."
    )


def read_kretz(path: Path) -> tuple[UInt8[np.ndarray, "beta sigma gamma"], ToroidalMap]:
    """The voxels and the map of a `.vol` file.

    **Raises:** `ValueError` for a file that is none, is cut short or compressed, lacks an item or holds one
    twice, or whose items contradict each other.
    """
    n_bytes = file_size(path)
    with path.open("rb") as stream:
        items = _items(path, stream, n_bytes)

        def read(tag: Tag, kind: str) -> tuple[Any, ...]:
            """The numbers in an item, in a format of `struct`."""
            offset, length = items[tag]
            expected = struct.calcsize(kind)
            if length != expected:
                raise ValueError(
                    f"path: {path}: item {_name(tag)} must have {expected} bytes ({kind[1:]}); it has "
                    f"{length}."
                )
            stream.seek(offset)
            return struct.unpack(kind, stream.read(length))

        shape = tuple(read(tag, "<H")[0] for tag in (BETA, SIGMA, GAMMA))
        expected, held = math.prod(shape), items[VOXELS][1]
        sizes = " x ".join(map(str, shape))
        if min(shape) < 2 or expected > MOST_VOXELS:
            raise ValueError(
                f"path: {path} must have at least 2 planes, beams and samples, and fewer than 2**31 voxels; "
                f"its header says {sizes}."
            )
        if held != expected:
            raise ValueError(
                f"path: {path}: item {_name(VOXELS)} must hold {sizes} = {expected} bytes, as its header (β, "
                f"σ, γ) says; it holds {held}. Of a compressed file, it holds less: save it uncompressed."
            )
        beta = _ends(path, BETAS, np.array(read(BETAS, f"<{shape[0]}d")))
        sigma = _ends(path, SIGMAS, np.array(read(SIGMAS, f"<{shape[1]}d")))
        resolution, first, apex = (read(tag, "<d")[0] for tag in (RESOLUTION, OFFSET_B, OFFSET_A))
        stream.seek(items[VOXELS][0])
        content = stream.read(expected)
    if not 0 < resolution < math.inf:
        raise ValueError(
            f"path: {path}: item {_name(RESOLUTION)} must be a positive length in metres; got {resolution}."
        )
    step = 1000 * resolution  # mm
    a, b = apex * step, first * step
    try:
        probe = ToroidalMap(a, b, beta, sigma, (0.0, (shape[2] - 1) * step))
    except ValueError as fault:
        raise ValueError(f"path: {path} describes no probe: {fault}") from fault
    nearest = float(probe.nearest_to_axis)
    if nearest < -1e-6 * abs(a):  # 0 to within rounding is on the axis
        raise ValueError(
            f"path: {path} describes no probe: its outermost beams begin {-nearest:.4g} mm behind the motor "
            f"axis (b = {b:.4g} mm, a = {a:.4g} mm), where no sample is shown."
        )
    return as_array(content, shape, np.dtype("u1"), "C"), probe


def _items(path: Path, stream: BinaryIO, n_bytes: int) -> dict[Tag, tuple[int, int]]:
    """Where the content of each item begins, and its length, in bytes; all of `MEANING` are there. Only
    headers are read."""
    magic = stream.read(len(MAGIC))
    if magic != MAGIC:
        raise ValueError(
            f"path: {path} is not a Kretz file: it must begin with {MAGIC!r}; got {magic!r}. "
            "Other programs write files of other kinds that end in .vol."
        )
    found: dict[Tag, tuple[int, int]] = {}
    end = stream.tell()
    for _ in range(MOST_ITEMS):
        stream.seek(end)
        head = stream.read(ITEM.size)
        if len(head) < ITEM.size and not any(head):  # the end, or padding
            break
        group, element, length = ITEM.unpack(head.ljust(ITEM.size, b"\xff"))
        tag, begin = (group, element), end + ITEM.size
        end = begin + length
        if end > n_bytes:
            raise ValueError(
                f"path: {path} is cut short: item {_name(tag)} is to end at byte {end}, and the file "
                f"has {n_bytes}."
            )
        if tag in MEANING and tag in found:
            raise ValueError(f"path: {path} holds item {_name(tag)} twice.")
        found[tag] = begin, length
    else:
        raise ValueError(f"path: {path} holds {MOST_ITEMS} items or more; expected some hundreds.")
    if missing := [_name(tag) for tag in MEANING if tag not in found]:
        raise ValueError(
            f"path: {path} has no item {', no item '.join(missing)}. Compressed files, several frames and "
            "Cartesian volumes are not supported: save it as one uncompressed volume as acquired."
        )
    return found


def _ends(path: Path, tag: Tag, angles: np.ndarray) -> tuple[float, float]:
    """The first and the last of evenly spaced angles."""
    first, last = float(angles[0]), float(angles[-1])
    with np.errstate(all="ignore"):  # NaN and infinity are refused below
        step = (last - first) / (len(angles) - 1)
        away = np.abs(angles - np.linspace(first, last, len(angles))).max() / step
    if not (step > 0 and away <= UNEVEN):
        raise ValueError(
            f"path: {path}: item {_name(tag)} must be evenly spaced angles that increase; got {len(angles)} "
            f"from {first} to {last}, up to {away:.3g} steps away from even ones (at most {UNEVEN}). "
            "Resample the volume at even angles first."
        )
    return first, last


def _name(tag: Tag) -> str:
    return f"{tag[0]:04X}:{tag[1]:X}" + (f" ({MEANING[tag]})" if tag in MEANING else "")
