"""Reads folders of DICOM slices with SimpleITK: one series, sorted by where its slices lie."""

import math
import re
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..._util.files import MOST_VOXELS, Header, decoding
from .medical import simple_itk
from .orientation import orthonormal, toward_axes


READABLE = {
    "1.2.840.10008.1.2": "implicit, little-endian",
    "1.2.840.10008.1.2.1": "explicit, little-endian",
    "1.2.840.10008.1.2.1.99": "deflated",
    "1.2.840.10008.1.2.2": "explicit, big-endian",
    "1.2.840.10008.1.2.4.50": "JPEG baseline",
    "1.2.840.10008.1.2.4.51": "JPEG extended",
    "1.2.840.10008.1.2.4.57": "JPEG lossless",
    "1.2.840.10008.1.2.4.70": "JPEG lossless, first-order",
    "1.2.840.10008.1.2.4.80": "JPEG-LS lossless",
    "1.2.840.10008.1.2.4.81": "JPEG-LS",
    "1.2.840.10008.1.2.4.90": "JPEG 2000 lossless",
    "1.2.840.10008.1.2.4.91": "JPEG 2000",
    "1.2.840.10008.1.2.5": "run-length encoded",
}
"""Transfer syntaxes that SimpleITK reads."""

OTHERS = {
    "1.2.840.10008.1.2.4.92": "JPEG 2000, part 2, lossless",
    "1.2.840.10008.1.2.4.93": "JPEG 2000, part 2",
    "1.2.840.10008.1.2.4.100": "MPEG-2",
    "1.2.840.10008.1.2.4.102": "MPEG-4",
    "1.2.840.10008.1.2.4.110": "JPEG XL lossless",
    "1.2.840.10008.1.2.4.112": "JPEG XL",
    "1.2.840.10008.1.2.4.201": "HTJ2K lossless",
    "1.2.840.10008.1.2.4.202": "HTJ2K lossless, RPCL",
    "1.2.840.10008.1.2.4.203": "HTJ2K",
}

PLACE = 0.01
"""Part of the distance between slices by which a slice may be away from its place."""

MOST_COMPRESSED = 2000
"""Bytes of pixels per byte of a compressed file, at most. A header that says more is not believed."""

STORAGE = "1.2.840.10008.5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Kinds of files that often lie beside a series: presentation states, reports, documents, contours, plans."""

META_BYTES = 2**16
"""Where kind and transfer syntax must be found: files begin with some hundred bytes of meta information."""

KIND, SYNTAX = b"\x02\x00\x02\x00UI", b"\x02\x00\x10\x00UI"
"""Elements of the meta information."""

SERIES = re.compile(rb"\x20\x00\x0e\x00.{4}([0-9.]{1,64})", re.DOTALL)
"""The element of a file, of one in it, or of one that it refers to, that tells the series."""


class Slice(NamedTuple):
    """What the header of a file says of it."""

    path: Path
    series: str
    what: str
    size: tuple[int, int]
    spacing: tuple[float, float]
    position: np.ndarray
    across: np.ndarray
    down: np.ndarray


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by the four letters after its preamble."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """The DICOM images in a folder, but not those in folders in it, nor an index of files, nor reports."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.upper() != "DICOMDIR")
    return [file for file in files if is_dicom(file) and not (_meta(file, KIND) or "").startswith(NO_IMAGES)]


def read_dicom_folder(folder: Path, header: Header) -> dict[str, Any]:
    """Reader for a folder that holds one series.

    **Raises:** `ValueError` naming the files, if the folder holds several series, or if slices of the series
    are missing, there twice, of different sizes or directions, shifted sideways, cut short, or compressed in
    a way that SimpleITK does not read.
    """
    header.refuse(folder)
    _check_strays(folder)
    try:
        slices = [_slice(path) for path in dicom_files(folder)]
    except ValueError as fault:
        raise ValueError(
            f"{fault} If this file is of another series, give the path of one file of the series that you "
            "want."
        ) from fault
    if len({each.series for each in slices}) > 1:
        kinds = Counter(each.what for each in slices)
        told = "; ".join(f"{what}: {count} files" for what, count in kinds.items())
        raise ValueError(
            f"path: {folder} holds {len({each.series for each in slices})} series ({told}). Give the path of "
            "one file of the series that you want, or put each into a folder of its own."
        )
    return _volume(folder, slices)


def read_dicom(path: Path, header: Header) -> dict[str, Any]:
    """Reader for one file of a series: reads the whole series, from the file's folder. Files of others in it
    may be unreadable."""
    header.refuse(path)
    if path.is_dir():
        return read_dicom_folder(path, header)
    if not is_dicom(path):
        raise ValueError(f'path: {path} is no DICOM file: it does not have "DICM" at byte 128.')
    return _volume(path, _series_of(path))


def series_files(path: Path) -> list[Path]:
    """The files of the series to which this one belongs, in its folder. **Raises:** as `read_dicom`."""
    return [each.path for each in _series_of(path)]


def _series_of(path: Path) -> list[Slice]:
    wanted = _slice(path).series
    _check_strays(path.parent)
    found = []
    for file in dicom_files(path.parent):
        try:
            found.append(_slice(file))
        except ValueError:
            told = {match[1].decode() for match in SERIES.finditer(file.read_bytes())}
            if not told or wanted in told:  # it may be a slice of the series
                raise
    return [each for each in found if each.series == wanted]


def _check_strays(folder: Path) -> None:
    """**Raises** `ValueError` for what is named as a slice and is none, such as an empty file."""
    for file in folder.glob("[!.]*.[dD][cC][mM]"):
        if file.is_file() and not is_dicom(file):
            raise ValueError(
                f'path: {file} is no DICOM file: it does not have "DICM" at byte 128. If it is no slice, '
                "remove it."
            )


def _slice(path: Path) -> Slice:
    simple_itk(path)
    syntax = _meta(path, SYNTAX)
    if syntax is None:
        raise ValueError(f"path: {path} is corrupt: it does not say how it is encoded (element 0002,0010).")
    if syntax not in READABLE:
        raise ValueError(
            f"path: {path} is stored as {OTHERS.get(syntax, 'unknown')} (transfer syntax {syntax}), which "
            "SimpleITK does not read. Decompress the series first, for example with gdcmconv --raw."
        )
    reader = _reader(path)
    with decoding(path):
        reader.ReadImageInformation()
        width, height, *depth = reader.GetSize()
        parts = reader.GetNumberOfComponents()
    if parts != 1 or depth not in ([], [1]):
        raise ValueError(
            f"path: {path} must hold one slice of one value per pixel; got size {reader.GetSize()} and "
            f"{parts} values. Files of several frames are not supported: save it as NRRD or NIfTI."
        )
    _check_backed(path, width * height * _bytes_per_pixel(reader), syntax)
    position, turn = _numbers(path, reader, "0020|0032", 3), _numbers(path, reader, "0020|0037", 6)
    down, across = _numbers(path, reader, "0028|0030", 2)  # between rows, then between columns
    if min(down, across) <= 0:
        raise ValueError(f"path: {path}: the spacing of its pixels must be positive; got {down}, {across}.")
    series = _text(reader, "0020|000e")
    what = f"{_text(reader, '0008|103e') or 'without a description'} ({series})"
    return Slice(path, series, what, (width, height), (across, down), position, turn[:3], turn[3:])


def _volume(path: Path, slices: list[Slice]) -> dict[str, Any]:
    first = slices[0]
    for each in slices[1:]:
        for name in ("size", "spacing", "across", "down"):
            if not np.allclose(getattr(each, name), getattr(first, name), rtol=1e-4, atol=1e-4):
                raise ValueError(
                    f"path: {path}: slices of one series must agree; {first.path.name} has {name} "
                    f"{_plain(getattr(first, name))}, and {each.path.name} {_plain(getattr(each, name))}. Is "
                    "one of them an overview image?"
                )
    if len(slices) < 2:
        raise ValueError(
            f"path: {path} must hold at least 2 slices of a series; got {first.path.name} alone."
        )
    direction = orthonormal(
        f"path: {path}: rows and columns of {first.path.name}", np.stack([first.across, first.down], axis=1)
    )
    normal = direction[:, 2]
    slices = sorted(slices, key=lambda each: float(each.position @ normal))
    step = _check_places(path, slices, normal)
    width, height = first.size
    if width * height * len(slices) > MOST_VOXELS:
        raise ValueError(
            f"path: {path} must have fewer than 2**31 voxels; got {width} x {height} x {len(slices)}."
        )
    data = _pixels(slices)
    return toward_axes(data, (*first.spacing, step), slices[0].position.tolist(), direction)


def _check_places(path: Path, slices: list[Slice], normal: np.ndarray) -> float:
    """The distance between slices, which are in order and must be evenly spaced along their normal."""
    positions = np.stack([each.position for each in slices])
    heights = positions @ normal
    gaps = np.diff(heights)
    step = float(np.median(gaps))
    names = [each.path.name for each in slices]
    same = np.flatnonzero(gaps <= max(PLACE * step, 1e-6))
    if same.size:
        pairs = ", ".join(f"{names[i]} and {names[i + 1]}" for i in same[:3])
        raise ValueError(
            f"path: {path} holds {same.size} slices that lie where another one does: {pairs}. They are "
            "copies, or of different times; remove all but one of each."
        )
    # to a tenth of a voxel over all slices: lengths in DICOM files are rounded
    wide = np.flatnonzero(np.abs(gaps - step) > 0.1 * step)
    if wide.size:
        i = int(wide[0])
        raise ValueError(
            f"path: {path} has unevenly spaced slices, or some are missing: the median distance is {step:g}, "
            f"and {names[i]} and {names[i + 1]} are {gaps[i]:g} ({wide.size} such gaps among {len(slices)} "
            "slices)."
        )
    sideways = positions - positions[0] - np.outer(heights - heights[0], normal)
    if np.abs(sideways).max() > 0.1 * min(slices[0].spacing):
        raise ValueError(
            f"path: {path} has slices that are shifted sideways by up to {np.abs(sideways).max():.4g}, as by "
            "a tilted gantry. Resample it on a rectangular grid."
        )
    return float(heights[-1] - heights[0]) / (len(slices) - 1)


def _pixels(slices: list[Slice]) -> np.ndarray:
    """Rescaled values [x, y, z], of a type that holds those of all slices: each may have its own scale."""
    sitk = simple_itk(slices[0].path)
    data: np.ndarray | None = None
    for z, each in enumerate(slices):
        with decoding(each.path):
            image = sitk.GetArrayFromImage(_reader(each.path).Execute())
            values = image.reshape(image.shape[-2:]).T
            if values.dtype == np.float64:
                values = values.astype(np.float32)
        if values.shape != each.size:
            raise ValueError(f"path: {each.path} holds {values.shape} pixels; its header says {each.size}.")
        if data is None:
            data = np.empty((*each.size, len(slices)), values.dtype)
        elif values.dtype != data.dtype:
            data = data.astype(_common(data.dtype, values.dtype), copy=False)
        data[:, :, z] = values
    assert data is not None
    return data


def _common(a: np.dtype, b: np.dtype) -> np.dtype:
    both = np.result_type(a, b)
    return np.dtype(np.float32) if both == np.float64 else both


def _check_backed(path: Path, nbytes: int, syntax: str) -> None:
    """**Raises** `ValueError` if a file is too short for the pixels that its header announces."""
    size = path.stat().st_size
    plain = READABLE[syntax].startswith(("implicit", "explicit"))
    if size * (1 if plain else MOST_COMPRESSED) < nbytes:
        raise ValueError(f"path: {path} is cut short: it has {size} bytes, and its pixels {nbytes}.")


def _bytes_per_pixel(reader: Any) -> int:
    bits = _text(reader, "0028|0100")
    return math.ceil(int(bits) / 8) if bits.isdigit() else 1


def _reader(path: Path) -> Any:
    reader = simple_itk(path).ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    return reader


def _text(reader: Any, tag: str) -> str:
    return reader.GetMetaData(tag).strip() if reader.HasMetaDataKey(tag) else ""


def _numbers(path: Path, reader: Any, tag: str, count: int) -> np.ndarray:
    text = _text(reader, tag)
    try:
        numbers = np.array([float(part) for part in text.split("\\")])
    except ValueError:
        numbers = np.array([])
    if numbers.shape != (count,) or not np.all(np.isfinite(numbers)):
        raise ValueError(
            f"path: {path} must say where it lies: element ({tag.replace('|', ',')}) must be {count} "
            f"numbers; got {text[:80]!r}."
        )
    return numbers


def _meta(path: Path, element: bytes) -> str | None:
    """A UID from the meta information with which a file begins; None if it is not there."""
    with path.open("rb") as stream:
        content = stream.read(META_BYTES)
    at = content.find(element, 132)
    length = int.from_bytes(content[at + 6 : at + 8], "little")
    if at < 0 or length > 64:
        return None
    return content[at + 8 : at + 8 + length].rstrip(b"\0 ").decode("latin-1")


def _plain(values: Any) -> list[float]:
    return [round(float(value), 4) for value in values]
