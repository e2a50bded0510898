"""Reads series of DICOM slices with SimpleITK, sorted by where they lie."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.affine import directions
from ..._util.checks import finite_array
from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, check_size, decoding
from .medical import simple_itk, toward_axes


UID = "1.2.840.10008."

PLAIN = {UID + end for end in ("1.2", "1.2.1", "1.2.2")}
PACKED = {UID + end for end in ("1.2.1.99", "1.2.5")}
PACKED |= {f"{UID}1.2.4.{number}" for number in (50, 51, 57, 70, 80, 81, 90, 91)}
"""Transfer syntaxes that SimpleITK reads: deflated, run-length encoded, JPEG, JPEG-LS and JPEG 2000."""

STORAGE = UID + "5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Presentation states, reports, documents, contours and plans, which often lie in a series' folder."""

KIND, SYNTAX = b"\x02\x00\x02\x00UI", b"\x02\x00\x10\x00UI"
"""Elements of the meta information with which a file begins."""

SERIES, DESCRIPTION, BITS = "0020|000e", "0008|103e", "0028|0100"
PLACE = ("0020|0032", "0020|0037")
"""Position, and directions of rows and columns."""
SPACINGS = ("0028|0030", "0018|1164")
"""Between rows and columns: in the patient, else on the detector (ImagerPixelSpacing)."""
INTERPRETATION, STORED, SIGNED = "0028|0004", "0028|0101", "0028|0103"
INTERCEPT, SLOPE = "0028|1052", "0028|1053"

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


def read_dicom(path: Path, spacing: Any = None) -> dict[str, Any]:
    """Reader for a folder that holds one series, or for one file of a series, whose others are in its folder.

    Args:
        path: the folder, or the file.
        spacing: of the volume, if the caller knows it; for slices that do not say theirs.

    Raises:
        ValueError: for several series, and for slices that are missing, there twice, of different sizes or
            directions, without spacing, shifted unevenly, cut short, or compressed in a way that SimpleITK
            does not read.
    """
    headers = series_headers(path)
    for file, header in headers.items():
        _check_slice(file, header)
    if not 2 <= len(headers) <= MOST_VOXELS // math.prod(next(iter(headers.values())).GetSize()):
        raise ValueError(
            f"path: {path} must hold at least 2 slices of a series, and fewer than 2**31 voxels; got "
            f"{len(headers)}."
        )
    apart = {file: _apart(file, header, spacing) for file, header in headers.items()}
    grids = {file: [*h.GetSize(), *apart[file], *h.GetDirection()] for file, h in headers.items()}
    first = next(iter(grids))
    for file, grid in grids.items():
        if not np.allclose(grid, grids[first], rtol=1e-4, atol=1e-4):
            raise ValueError(
                f"path: {path}: slices of one series must agree in size, spacing and directions; "
                f"{first.name} and {file.name} do not: {grids[first]} and {grid}. Is one an overview?"
            )
    rows_and_columns = np.reshape(headers[first].GetDirection(), (3, 3))
    turn = directions(f"path: {path}: rows and columns of {first.name}", rows_and_columns)
    normal = np.cross(turn[:, 0], turn[:, 1])
    files = sorted(headers, key=lambda file: float(np.array(headers[file].GetOrigin()) @ normal))
    positions = np.array([headers[file].GetOrigin() for file in files])
    down, across = apart[first]
    mean = (positions[-1] - positions[0]) / (len(files) - 1)
    for step in (normal * (mean @ normal), mean):  # the second: the gantry was tilted
        away = positions - positions[0] - np.outer(np.arange(len(files)), step)
        along = away @ normal
        sideways = np.abs(away - np.outer(along, normal)).max(axis=1)
        even = (np.abs(along) <= AWAY * (mean @ normal)) & (sideways <= AWAY * min(across, down))
        if even.all():
            break
    if mean @ normal < 1e-6 or not even.all():
        i = int(np.argmin(even))
        raise ValueError(
            f"path: {path} must hold slices evenly spaced along a line; of {len(files)}, {files[i].name} "
            f"lies {along[i]:.4g} too far along their normal, and {sideways[i]:.4g} sideways. Are slices "
            "missing or there twice?"
        )
    length = float(np.linalg.norm(step))
    turn = directions(
        f"path: {path}: rows, columns and slices", np.column_stack([turn[:, :2], step / length])
    )
    return toward_axes(_pixels(headers, files), (across, down, length), positions[0], turn)


def _apart(path: Path, header: Any, given: Any) -> np.ndarray:
    """The distances between rows and between columns."""
    for tag in SPACINGS:
        told = _numbers(_text(header, tag))
        if told.shape == (2,) and np.all(told > 0):
            return told
    if given is None:
        texts = [_text(header, tag)[:80] for tag in SPACINGS]
        raise ValueError(
            f"path: {path} does not say how far its pixels are apart: PixelSpacing (0028|0030) and "
            f"ImagerPixelSpacing (0018|1164) must be 2 positive numbers; got {texts[0]!r} and {texts[1]!r}. "
            "Give spacing=(x, y, z), --spacing."
        )
    # of the axes as loaded, to which rows and columns are nearest
    x_and_y = np.abs(np.reshape(header.GetDirection(), (3, 3))).argmax(axis=0)[:2]
    return np.asarray(finite_array("spacing", given, (3,)))[x_and_y[::-1]]


def _pixels(headers: dict[Path, Any], files: list[Path]) -> np.ndarray:
    """Rescaled values [x, y, z], of a type that holds those of all slices: each may have its own scale."""
    planes = []
    for file in files:
        with decoding(file):
            plane = simple_itk(file).GetArrayFromImage(headers[file].Execute())[0].T
        if _text(headers[file], INTERPRETATION) == "MONOCHROME1":  # the lowest is shown as white
            plane = _as_stored(plane, headers[file])
        planes.append(plane.astype(np.float32) if plane.dtype == np.float64 else plane)
    return np.stack(planes, axis=2)


def _as_stored(plane: np.ndarray, header: Any) -> np.ndarray:
    """Rescaled values of MONOCHROME1, of which SimpleITK inverts the stored ones before."""
    slope, intercept = (float(_text(header, tag) or default) for tag, default in ((SLOPE, 1), (INTERCEPT, 0)))
    highest = -1 if _text(header, SIGNED) == "1" else 2 ** int(_text(header, STORED)) - 1
    return (slope * highest + 2 * intercept - plane).astype(plane.dtype)


def series_headers(path: Path) -> dict[Path, Any]:
    """Headers, by file, of the only series in a folder, or of the one that a file belongs to."""
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
    """SimpleITK's reader of a file, whose header has been read."""
    if not is_dicom(path):
        raise ValueError(
            f'path: {path} is no DICOM file: it has no "DICM" at byte 128. Remove it from there.'
        )
    reader = simple_itk(path).ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    with decoding(path):
        reader.ReadImageInformation()
    return reader


def _check_slice(path: Path, header: Any) -> None:
    syntax = _meta(path, SYNTAX)
    if syntax not in PLAIN | PACKED:  # SimpleITK would take compressed bytes for pixels
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
    n_bytes = int(_text(header, BITS)) // 8 if _text(header, BITS).isdecimal() else 1
    held = path.stat().st_size * (1 if syntax in PLAIN else MOST_COMPRESSED)
    check_size(path, held, math.prod(size) * n_bytes, more=True)
    rows_and_columns = np.reshape(header.GetDirection(), (3, 3))[:, :2].T.ravel()
    for tag, taken in zip(PLACE, (header.GetOrigin(), rows_and_columns), strict=True):
        text = _text(header, tag)
        told = _numbers(text)
        # in place of what it cannot read, SimpleITK takes other numbers
        if told.shape != (len(taken),) or not np.allclose(told, taken, rtol=1e-3, atol=1e-3):
            raise ValueError(
                f"path: {path} must say where it lies: element ({tag}) must be {len(taken)} numbers; got "
                f"{text[:80]!r}, which SimpleITK takes for {np.round(taken, 4).tolist()}."
            )


def _numbers(text: str) -> np.ndarray:
    """The numbers of an element; none if it holds something else."""
    try:
        return np.array(text.split("\\"), float)
    except ValueError:
        return np.empty(0)


def _text(header: Any, tag: str) -> str:
    return header.GetMetaData(tag).strip() if header.HasMetaDataKey(tag) else ""


def _meta(path: Path, element: bytes) -> str:
    """A UID from the meta information, which is some hundred bytes; "" if it is not there."""
    with path.open("rb") as stream:
        content = stream.read(2**16)
    at = content.find(element, 132)
    length = int.from_bytes(content[at + 6 : at + 8], "little") if at >= 0 else 0
    return content[at + 8 : at + 8 + length].rstrip(b"\0 ").decode("latin-1") if length <= 64 else ""
