"""Reader of Kretz ultrasound files (`.vol`, of GE Voluson scanners): 16 bytes of magic, then items of group
(u16), element (u16), length (u32) and bytes, little-endian. The format is not published; the items of
`MEANING` follow SlicerHeart's `vtkSlicerKretzFileReaderLogic` and plooney/kretz, and so do positions, up to a
shift along z by a and, in SlicerHeart's RAS axes, the sign of y."""

import math
import struct
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from ..._util.files import MOST_VOXELS, check, file_size, refusing
from ...march.transforms.toroidal_map import ToroidalMap


MAGIC = b"KRETZFILE 1.0   "

UNEVEN = 0.01  # tolerance of angles from evenly spaced ones, in steps

MEANING = {  # by group and element
    "C000:1": "the number of samples along a beam",  # u16
    "C000:2": "the number of beams",  # u16
    "C000:3": "the number of planes",  # u16
    "C100:1": "the distance between samples",  # f64, in metres
    "C200:1": "the distance from the apex to the first sample",  # f64, in samples
    "C200:2": "the distance from the motor axis to the apex",  # f64, in samples
    "C300:1": "the angles of the planes",  # f64, in radians; π/2 is the middle
    "C300:2": "the angles of the beams",  # f64, in radians; π/2 is the middle
    "D000:1": "the voxels",  # u8, γ fastest, then σ, then β
}
TITLES = {tag: f"{tag} ({meaning})" for tag, meaning in MEANING.items()}


def read_kretz(path: Path) -> tuple[UInt8[np.ndarray, "beta sigma gamma"], ToroidalMap]:
    """Read the voxels and the map of a `.vol` file. Raises `ValueError` for a damaged or other file."""
    with refusing(path):
        items = _items(path)

        def numbers(tag: str, dtype: str, count: int = 1) -> np.ndarray:
            expected, size = count * np.dtype(dtype).itemsize, len(items[tag])
            fault = f": item {TITLES[tag]} must have {expected} bytes; it has {size}."
            check(size == expected, f"{fault} Is the file compressed? Save it uncompressed.")
            return np.frombuffer(items[tag], dtype)

        planes, beams, samples = (int(numbers(tag, "<u2")[0]) for tag in ("C000:3", "C000:2", "C000:1"))
        must = "must have at least 2 planes, beams and samples, and fewer than 2**31 voxels"
        is_volume = min(planes, beams, samples) > 1 and planes * beams * samples <= MOST_VOXELS
        check(is_volume, f"{must}; its header says {planes} x {beams} x {samples}.")
        voxels = numbers("D000:1", "u1", planes * beams * samples).reshape(planes, beams, samples)
        ends: list[tuple[float, float]] = []
        for tag, count in (("C300:1", planes), ("C300:2", beams)):
            angles = numbers(tag, "<f8", count)
            with np.errstate(all="ignore"):  # NaN and infinity are refused below
                even, step = np.linspace(angles[0], angles[-1], count, retstep=True)
            must = f"must be evenly spaced angles that increase, up to {UNEVEN} of a step"
            got = f"got {count} from {angles[0]} to {angles[-1]}. Resample at even angles."
            is_even = step > 0 and np.abs(angles - even).max() <= UNEVEN * step
            check(is_even, f": item {TITLES[tag]} {must}; {got}")
            ends.append((float(angles[0]), float(angles[-1])))
        resolution, first, apex = (float(numbers(tag, "<f8")[0]) for tag in ("C100:1", "C200:1", "C200:2"))
        must = f": item {TITLES['C100:1']} must be a positive length in metres"
        check(0 < resolution < math.inf, f"{must}; got {resolution}.")
    step = 1000 * resolution  # mm
    try:
        probe = ToroidalMap(apex * step, first * step, ends[0], ends[1], (0.0, (samples - 1) * step))
        nearest = float(probe.nearest_to_axis)
        on_axis = nearest >= -1e-6 * abs(apex * step)  # 0 to within rounding
        check(on_axis, f"its outermost beams begin {-nearest:.4g} mm behind the motor axis.")
    except ValueError as fault:
        raise ValueError(f"path: {path} describes no probe: {fault}") from fault
    return voxels, probe


def _items(path: Path) -> dict[str, bytes]:
    """Read the contents of all items of `MEANING`."""
    n_bytes, items = file_size(path), {}
    with path.open("rb") as stream:
        magic = stream.read(len(MAGIC))
        must = f"is not a Kretz file, but another that ends in .vol: it must begin with {MAGIC!r}"
        check(magic == MAGIC, f"{must}; got {magic!r}.")
        while any(head := stream.read(8)):  # zeros: the end, or padding
            group, element, length = struct.unpack("<HHI", head.ljust(8, b"\xff"))
            tag, end = f"{group:04X}:{element:X}", stream.tell() + length
            title = TITLES.get(tag, tag)
            cut = f"is cut short: item {title} is to end at byte {end}, and the file ends at {n_bytes}."
            check(end <= n_bytes, cut)
            check(tag not in items, f"holds item {title} twice.")
            if tag in MEANING:
                items[tag] = stream.read(length)
            stream.seek(end)
    missing = ", no item ".join(title for tag, title in TITLES.items() if tag not in items)
    hint = "Compressed files, several frames and Cartesian volumes are not supported: save it as one"
    check(not missing, f"has no item {missing}. {hint} uncompressed volume as acquired.")
    return items
