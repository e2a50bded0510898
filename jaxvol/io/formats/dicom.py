"""Reads series of DICOM slices with SimpleITK, sorted by where they lie."""

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..._util.files import MOST_VOXELS, Header, decoding, numbers_in
from .medical import simple_itk
from .orientation import orthonormal, toward_axes


UID = "1.2.840.10008."

PLAIN = {UID + end for end in ("1.2", "1.2.1", "1.2.2")}
READABLE = PLAIN | {UID + end for end in ("1.2.1.99", "1.2.5")}
READABLE |= {f"{UID}1.2.4.{number}" for number in (50, 51, 57, 70, 80, 81, 90, 91)}
"""Transfer syntaxes that SimpleITK reads: deflated, run-length encoded, JPEG, JPEG-LS and JPEG 2000, too."""

STORAGE = UID + "5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Kinds of files that often lie beside a series: presentation states, reports, documents, contours, plans."""

META_BYTES = 2**16
"""Where kind and transfer syntax must be found: files begin with some hundred bytes of meta information."""

KIND, SYNTAX = b"\x02\x00\x02\x00UI", b"\x02\x00\x10\x00UI"
"""Elements of the meta information."""

SERIES = b"\x20\x00\x0e\x00"
"""The element that tells the series."""

MOST_COMPRESSED = 2000
"""Bytes of pixels per byte of a compressed file, at most. A header that says more is not believed."""

OVERLAP, AWAY = 0.01, 0.1
"""Slices nearer to each other than this part of their usual distance lie in one place; and the part of a
voxel by which a slice may be away from its place: lengths in DICOM files are rounded."""


class Slice(NamedTuple):
    """What the header of a file says of it."""

    path: Path
    series: str
    description: str
    size: tuple[int, int]
    spacing: tuple[float, float]
    position: np.ndarray
    axes: np.ndarray
    """Directions of rows and columns, as columns."""


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by the four letters after its preamble."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """The DICOM images in a folder, but not those in folders in it, nor an index of files, nor reports."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.upper() != "DICOMDIR")
    return [file for file in files if is_dicom(file) and not (_meta(file, KIND) or "").startswith(NO_IMAGES)]


def read_dicom(path: Path, header: Header) -> dict[str, Any]:
    """Reader for a folder that holds one series, or for one file of a series, whose others are in its folder.

    **Raises:** `ValueError` naming the files, if the folder holds several series, or if slices of the series
    are missing, there twice, of different sizes or directions, shifted sideways, cut short, or compressed in
    a way that SimpleITK does not read.
    """
    header.refuse(path)
    return _volume(path, _slices(path))


def series_files(path: Path) -> list[Path]:
    """The files of the series to which this one belongs, in its folder. **Raises:** as `read_dicom`."""
    return [each.path for each in _slices(path)]


def _slices(path: Path) -> list[Slice]:
    folder, series = (path, None) if path.is_dir() else (path.parent, _slice(path).series)
    for file in folder.glob("[!.]*.[dD][cC][mM]"):  # such as an empty file
        if file.is_file() and not is_dicom(file):
            raise ValueError(f"{_no_dicom(file)} If it is no slice, remove it.")
    found: list[Slice] = []
    for file in dicom_files(folder):
        try:
            found.append(_slice(file))
        except ValueError as fault:
            if series is None:
                raise ValueError(
                    f"{fault} If this file is of another series, give the path of one file of the series "
                    "that you want."
                ) from fault
            content = file.read_bytes()
            if SERIES not in content or series.encode() in content:  # it may be a slice of the series
                raise
    if series is not None:
        return [each for each in found if each.series == series]
    counts = Counter((each.series, each.description) for each in found)
    if len({series for series, _ in counts}) > 1:
        listed = "; ".join(
            f"{description or 'no description'} ({series}): {count} files"
            for (series, description), count in counts.items()
        )
        raise ValueError(
            f"path: {folder} holds several series: {listed}. Give the path of one file of the series that "
            "you want, or put each into a folder of its own."
        )
    return found


def _no_dicom(path: Path) -> str:
    return f'path: {path} is no DICOM file: it does not have "DICM" at byte 128.'


def _slice(path: Path) -> Slice:
    if not is_dicom(path):
        raise ValueError(_no_dicom(path))
    reader = _reader(path)
    syntax = _meta(path, SYNTAX)
    if syntax not in READABLE:  # SimpleITK would take compressed bytes for pixels
        raise ValueError(
            f"path: {path} is stored in the transfer syntax {syntax}, which SimpleITK does not read. "
            "Decompress the series first, for example with gdcmconv --raw."
        )
    with decoding(path):
        reader.ReadImageInformation()
    (width, height, *depth), channels = reader.GetSize(), reader.GetNumberOfComponents()
    if channels != 1 or depth not in ([], [1]):
        raise ValueError(
            f"path: {path} must hold one slice of one value per pixel; got size {reader.GetSize()} and "
            f"{channels} values. Files of several frames are not supported: save it as NRRD or NIfTI."
        )
    bits = _text(reader, "0028|0100")
    n_bytes, pixels = path.stat().st_size, width * height * (int(bits) // 8 if bits.isdigit() else 1)
    if n_bytes * (1 if syntax in PLAIN else MOST_COMPRESSED) < pixels:
        raise ValueError(f"path: {path} is cut short: it has {n_bytes} bytes, and its pixels {pixels}.")
    position, axes, (down, across) = (  # spacing between rows, then between columns
        numbers_in(_text(reader, tag), count, f"path: {path} must say where it lies: element ({tag})", "\\")
        for tag, count in (("0020|0032", 3), ("0020|0037", 6), ("0028|0030", 2))
    )
    if min(down, across) <= 0:
        raise ValueError(f"path: {path}: the spacing of its pixels must be positive; got {down}, {across}.")
    series, description = _text(reader, "0020|000e"), _text(reader, "0008|103e")
    return Slice(path, series, description, (width, height), (across, down), position, axes.reshape(2, 3).T)


def _volume(path: Path, slices: list[Slice]) -> dict[str, Any]:
    first = slices[0]
    for each in slices[1:]:
        for name in ("size", "spacing", "axes"):
            expected, found = (np.array(getattr(which, name)) for which in (first, each))
            if not np.allclose(found, expected, rtol=1e-4, atol=1e-4):
                raise ValueError(
                    f"path: {path}: slices of one series must agree; {first.path.name} has {name} "
                    f"{expected.round(4).tolist()}, and {each.path.name} {found.round(4).tolist()}. Is one "
                    "of them an overview image?"
                )
    width, height = first.size
    if len(slices) < 2 or width * height * len(slices) > MOST_VOXELS:
        raise ValueError(
            f"path: {path} must hold at least 2 slices of a series, and fewer than 2**31 voxels; got "
            f"{len(slices)} of {width} x {height} pixels."
        )
    direction = orthonormal(f"path: {path}: rows and columns of {first.path.name}", first.axes)
    normal = direction[:, 2]
    slices = sorted(slices, key=lambda each: float(each.position @ normal))
    spacing = (*first.spacing, _distance(path, slices, normal))
    return toward_axes(_pixels(slices), spacing, slices[0].position, direction)


def _distance(path: Path, slices: list[Slice], normal: np.ndarray) -> float:
    """The distance between slices, which are in order and must be evenly spaced along their normal."""
    positions = np.stack([each.position for each in slices])
    heights = positions @ normal
    gaps = np.diff(heights)
    step = float(np.median(gaps))
    names = [each.path.name for each in slices]
    same = np.flatnonzero(gaps <= max(OVERLAP * step, 1e-6))
    if same.size:
        pairs = ", ".join(f"{names[i]} and {names[i + 1]}" for i in same[:3])
        raise ValueError(
            f"path: {path} holds {same.size} slices that lie where another one does: {pairs}. They are "
            "copies, or of different times; remove all but one of each."
        )
    wide = np.flatnonzero(np.abs(gaps - step) > AWAY * step)
    if wide.size:
        i = int(wide[0])
        raise ValueError(
            f"path: {path} has unevenly spaced slices, or some are missing: the median distance is {step:g}, "
            f"and {names[i]} and {names[i + 1]} are {gaps[i]:g} ({wide.size} such gaps among {len(slices)} "
            "slices)."
        )
    sideways = np.abs(positions - positions[0] - np.outer(heights - heights[0], normal)).max()
    if sideways > AWAY * min(slices[0].spacing):
        raise ValueError(
            f"path: {path} has slices that are shifted sideways by up to {sideways:.4g}, as by a tilted "
            "gantry. Resample it on a rectangular grid."
        )
    return float(heights[-1] - heights[0]) / (len(slices) - 1)


def _pixels(slices: list[Slice]) -> np.ndarray:
    """Rescaled values [x, y, z], of a type that holds those of all slices: each may have its own scale."""
    sitk = simple_itk(slices[0].path)
    planes: list[np.ndarray] = []
    for each in slices:
        with decoding(each.path):
            image = sitk.GetArrayFromImage(_reader(each.path).Execute())
        plane = image.reshape(image.shape[-2:]).T
        planes.append(plane.astype(np.float32) if plane.dtype == np.float64 else plane)
    return np.stack(planes, axis=2)


def _reader(path: Path) -> Any:
    reader = simple_itk(path).ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    return reader


def _text(reader: Any, tag: str) -> str:
    return reader.GetMetaData(tag).strip() if reader.HasMetaDataKey(tag) else ""


def _meta(path: Path, element: bytes) -> str | None:
    """A UID from the meta information with which a file begins; None if it is not there."""
    with path.open("rb") as stream:
        content = stream.read(META_BYTES)
    at = content.find(element, 132)
    length = int.from_bytes(content[at + 6 : at + 8], "little")
    if at < 0 or length > 64:
        return None
    return content[at + 8 : at + 8 + length].rstrip(b"\0 ").decode("latin-1")
