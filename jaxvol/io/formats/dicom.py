"""Reads series of DICOM slices with SimpleITK, sorted by where they lie."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, check_pixels, decoding
from .medical import orthonormal, simple_itk, toward_axes


UID = "1.2.840.10008."

PLAIN = {UID + end for end in ("1.2", "1.2.1", "1.2.2")}
READABLE = PLAIN | {UID + end for end in ("1.2.1.99", "1.2.5")}
READABLE |= {f"{UID}1.2.4.{number}" for number in (50, 51, 57, 70, 80, 81, 90, 91)}
"""Transfer syntaxes that SimpleITK reads: deflated, run-length encoded, JPEG, JPEG-LS and JPEG 2000, too."""

STORAGE = UID + "5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Kinds of files that often lie in a series' folder: presentation states, reports, documents, contours,
plans."""

KIND, SYNTAX = b"\x02\x00\x02\x00UI", b"\x02\x00\x10\x00UI"
"""Elements of the meta information with which a file begins."""

SERIES, DESCRIPTION = "0020|000e", "0008|103e"
PLACE = ("0020|0032", "0020|0037", "0028|0030")
"""Position, directions of rows and columns, and spacing of pixels."""

AWAY = 0.1
"""The part of a voxel by which a slice may be away from its place: lengths in DICOM files are rounded."""


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by the four letters after its preamble."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """The DICOM images in a folder, and what is named like one; but no index of files, and no reports."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.upper() != "DICOMDIR")
    named = [file for file in files if file.suffix.lower() == ".dcm" and not file.name.startswith(".")]
    images = [file for file in files if file in named or is_dicom(file)]
    return [file for file in images if not _meta(file, KIND).startswith(NO_IMAGES)]


def series_files(path: Path) -> list[Path]:
    """The files of the series to which a file belongs, in its folder."""
    return list(_headers(path))


def read_dicom(path: Path) -> dict[str, Any]:
    """Reader for a folder that holds one series, or for one file of a series, whose others are in its folder.

    **Raises:** `ValueError` naming the files, if the folder holds several series, or if slices of the series
    are missing, there twice, of different sizes or directions, shifted sideways, cut short, or compressed in
    a way that SimpleITK does not read.
    """
    headers = _headers(path)
    for file, header in headers.items():
        _check_slice(file, header)
    if not 2 <= len(headers) <= MOST_VOXELS // math.prod(next(iter(headers.values())).GetSize()):
        raise ValueError(
            f"path: {path} must hold at least 2 slices of a series, and fewer than 2**31 voxels; got "
            f"{len(headers)}."
        )
    first, *others = headers
    for name in ("Size", "Spacing", "Direction"):
        expected, *found = (np.array(getattr(header, f"Get{name}")()) for header in headers.values())
        for file, each in zip(others, found, strict=True):
            if not np.allclose(each, expected, rtol=1e-4, atol=1e-4):
                raise ValueError(
                    f"path: {path}: slices of one series must agree; {first.name} has {name.lower()} "
                    f"{expected.round(4).tolist()}, and {file.name} {each.round(4).tolist()}. Is one of them "
                    "an overview image?"
                )
    direction = orthonormal(f"path: {path}: rows and columns of {first.name}", headers[first].GetDirection())
    files = sorted(headers, key=lambda file: float(np.array(headers[file].GetOrigin()) @ direction[:, 2]))
    positions = np.array([headers[file].GetOrigin() for file in files])
    across, down, _ = headers[first].GetSpacing()
    distance = _distance(path, files, positions, direction[:, 2], min(across, down))
    return toward_axes(_pixels(headers, files), (across, down, distance), positions[0], direction)


def _pixels(headers: dict[Path, Any], files: list[Path]) -> np.ndarray:
    """Rescaled values [x, y, z], of a type that holds those of all slices: each may have its own scale."""
    planes = []
    for file in files:
        with decoding(file):
            plane = simple_itk(file).GetArrayFromImage(headers[file].Execute())[0].T
        planes.append(plane.astype(np.float32) if plane.dtype == np.float64 else plane)
    return np.stack(planes, axis=2)


def _headers(path: Path) -> dict[Path, Any]:
    """SimpleITK's readers of the slices of the only series in a folder, or of the one that a file belongs to,
    with headers read."""
    headers = {file: _header(file) for file in dicom_files(path if path.is_dir() else path.parent)}
    if path.is_file():
        series = _text(_header(path), SERIES)
        return {file: header for file, header in headers.items() if _text(header, SERIES) == series}
    examples = {_text(header, SERIES): file for file, header in headers.items()}
    if len(examples) > 1:
        told = [f"{_text(headers[file], DESCRIPTION)} (as {file.name})" for file in examples.values()]
        raise ValueError(
            f"path: {path} holds several series: {', '.join(told)}. Give the path of one file of the series "
            "that you want, or put each into a folder of its own."
        )
    return headers


def _header(path: Path) -> Any:
    if not is_dicom(path):
        raise ValueError(
            f'path: {path} is no DICOM file: it does not have "DICM" at byte 128. If it is no slice, remove '
            "it."
        )
    reader = simple_itk(path).ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    with decoding(path):
        reader.ReadImageInformation()
    return reader


def _check_slice(path: Path, header: Any) -> None:
    syntax = _meta(path, SYNTAX)
    if syntax not in READABLE:  # SimpleITK would take compressed bytes for pixels
        raise ValueError(
            f"path: {path} is stored in the transfer syntax {syntax}, which SimpleITK does not read. "
            "Decompress the series first, for example with gdcmconv --raw."
        )
    size, channels = header.GetSize(), header.GetNumberOfComponents()
    if channels != 1 or len(size) != 3 or size[2] != 1:
        raise ValueError(
            f"path: {path} must hold one slice of one value per pixel; got size {size} and {channels} "
            "values. Files of several frames are not supported: save it as NRRD or NIfTI."
        )
    bits = _text(header, "0028|0100")
    n_bytes = math.prod(size) * (int(bits) // 8 if bits.isdigit() else 1)
    check_pixels(path, n_bytes, compressed=syntax not in PLAIN)
    if missing := [tag for tag in PLACE if not _text(header, tag)]:
        raise ValueError(f"path: {path} must say where it lies: it has no element ({missing[0]}).")


def _distance(
    path: Path, files: list[Path], positions: np.ndarray, normal: np.ndarray, pixel: float
) -> float:
    """The distance between slices, which are in order and must be evenly spaced along their normal."""
    heights = positions @ normal
    gaps = np.diff(heights)
    step = float(np.median(gaps))
    uneven = np.abs(gaps - step)
    if not (step >= 1e-6 and uneven.max() <= AWAY * step):
        i = int(uneven.argmax())
        raise ValueError(
            f"path: {path} has unevenly spaced slices, or some are missing or there twice: the median "
            f"distance is {step:g}, and {files[i].name} and {files[i + 1].name} are {gaps[i]:g} apart."
        )
    sideways = np.abs(positions - positions[0] - np.outer(heights - heights[0], normal)).max()
    if sideways > AWAY * pixel:
        raise ValueError(
            f"path: {path} has slices that are shifted sideways by up to {sideways:.4g}, as by a tilted "
            "gantry. Resample it on a rectangular grid."
        )
    return float(heights[-1] - heights[0]) / (len(files) - 1)


def _text(header: Any, tag: str) -> str:
    return header.GetMetaData(tag).strip() if header.HasMetaDataKey(tag) else ""


def _meta(path: Path, element: bytes) -> str:
    """A UID from the meta information, which is some hundred bytes; "" if it is not there."""
    with path.open("rb") as stream:
        content = stream.read(2**16)
    at = content.find(element, 132)
    length = int.from_bytes(content[at + 6 : at + 8], "little") if at >= 0 else 0
    return content[at + 8 : at + 8 + length].rstrip(b"\0 ").decode("latin-1") if length <= 64 else ""
