"""Reads series of DICOM slices with SimpleITK, sorted by where they lie."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..._util.files import MOST_VOXELS, check_pixels, decoding, numbers_in
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

SERIES = "0020|000e"
"""The element that tells the series."""

AWAY = 0.1
"""The part of a voxel by which a slice may be away from its place: lengths in DICOM files are rounded."""


class Slice(NamedTuple):
    """What the header of a file says of it. `axes`: directions of rows and columns, as columns."""

    path: Path
    series: str
    description: str
    size: tuple[int, int]
    spacing: tuple[float, float]
    position: np.ndarray
    axes: np.ndarray


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by the four letters after its preamble."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """The DICOM images in a folder, and what is named like one; but no index of files, and no reports."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.upper() != "DICOMDIR")
    named = [file for file in files if file.suffix.lower() == ".dcm" and not file.name.startswith(".")]
    images = [file for file in files if file in named or is_dicom(file)]
    return [file for file in images if not (_meta(file, KIND) or "").startswith(NO_IMAGES)]


def read_dicom(path: Path) -> dict[str, Any]:
    """Reader for a folder that holds one series, or for one file of a series, whose others are in its folder.

    **Raises:** `ValueError` naming the files, if the folder holds several series, or if slices of the series
    are missing, there twice, of different sizes or directions, shifted sideways, cut short, or compressed in
    a way that SimpleITK does not read.
    """
    slices = _slices(path)
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
    if not 2 <= len(slices) <= MOST_VOXELS // math.prod(first.size):
        raise ValueError(
            f"path: {path} must hold at least 2 slices of a series, and fewer than 2**31 voxels; got "
            f"{len(slices)} of {first.size} pixels."
        )
    direction = orthonormal(f"path: {path}: rows and columns of {first.path.name}", first.axes)
    normal = direction[:, 2]
    slices = sorted(slices, key=lambda each: float(each.position @ normal))
    spacing = (*first.spacing, _distance(path, slices, normal))
    return toward_axes(_pixels(slices), spacing, slices[0].position, direction)


def series_files(path: Path) -> list[Path]:
    """The files of the series to which this one belongs, in its folder. **Raises:** as `read_dicom`."""
    return [each.path for each in _slices(path)]


def _slices(path: Path) -> list[Slice]:
    """The slices of the only series in a folder, or of that to which a file belongs."""
    headers = {file: _header(file) for file in dicom_files(path if path.is_dir() else path.parent)}
    if path.is_file():
        series = _text(_header(path), SERIES)
        return [_slice(file, found) for file, found in headers.items() if _text(found, SERIES) == series]
    found = [_slice(file, header) for file, header in headers.items()]
    series = {each.series: f"{each.description or 'no description'} (as {each.path.name})" for each in found}
    if len(series) > 1:
        raise ValueError(
            f"path: {path} holds several series: {', '.join(series.values())}. Give the path of one file of "
            "the series that you want, or put each into a folder of its own."
        )
    return found


def _header(path: Path) -> Any:
    """SimpleITK's reader of a file, whose header has been read."""
    if not is_dicom(path):
        raise ValueError(
            f'path: {path} is no DICOM file: it does not have "DICM" at byte 128. If it is no slice, remove '
            "it."
        )
    reader = _reader(path)
    with decoding(path):
        reader.ReadImageInformation()
    return reader


def _slice(path: Path, reader: Any) -> Slice:
    syntax = _meta(path, SYNTAX)
    if syntax not in READABLE:  # SimpleITK would take compressed bytes for pixels
        raise ValueError(
            f"path: {path} is stored in the transfer syntax {syntax}, which SimpleITK does not read. "
            "Decompress the series first, for example with gdcmconv --raw."
        )
    (width, height, *depth), channels = reader.GetSize(), reader.GetNumberOfComponents()
    if channels != 1 or depth not in ([], [1]):
        raise ValueError(
            f"path: {path} must hold one slice of one value per pixel; got size {reader.GetSize()} and "
            f"{channels} values. Files of several frames are not supported: save it as NRRD or NIfTI."
        )
    bits = _text(reader, "0028|0100")
    n_bytes = width * height * (int(bits) // 8 if bits.isdigit() else 1)
    check_pixels(path, n_bytes, compressed=syntax not in PLAIN)
    position, axes, (down, across) = (  # spacing between rows, then between columns
        numbers_in(_text(reader, tag), count, f"path: {path} must say where it lies: element ({tag})", "\\")
        for tag, count in (("0020|0032", 3), ("0020|0037", 6), ("0028|0030", 2))
    )
    if min(down, across) <= 0:
        raise ValueError(f"path: {path}: the spacing of its pixels must be positive; got {down}, {across}.")
    series, description = _text(reader, SERIES), _text(reader, "0008|103e")
    return Slice(path, series, description, (width, height), (across, down), position, axes.reshape(2, 3).T)


def _distance(path: Path, slices: list[Slice], normal: np.ndarray) -> float:
    """The distance between slices, which are in order and must be evenly spaced along their normal."""
    positions = np.stack([each.position for each in slices])
    heights = positions @ normal
    gaps = np.diff(heights)
    step = float(np.median(gaps))
    uneven = np.abs(gaps - step)
    if step < 1e-6 or uneven.max() > AWAY * step:
        i = int(uneven.argmax())
        one, other = (slices[k].path.name for k in (i, i + 1))
        raise ValueError(
            f"path: {path} has unevenly spaced slices, or some are missing or there twice: the median "
            f"distance is {step:g}, and {one} and {other} are {gaps[i]:g} apart."
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
