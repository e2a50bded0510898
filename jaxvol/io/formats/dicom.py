"""Reads series of DICOM slices, and files of several frames, with pydicom, sorted by where they lie."""

import math
import mmap
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..._util.affine import directions
from ..._util.checks import finite_array, integer, shortened
from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, Refused, check, check_size, library, refusing
from ..._util.image_record import ImageRecord
from ..._util.named_axes import grid_of


UID = "1.2.840.10008."
SYNTAXES = {UID + end: "" for end in ("1.2", "1.2.1", "1.2.2", "1.2.1.99", "1.2.5")}
DECODERS = {"jpeg_decode": (50, 51, 57, 70), "jpegls_decode": (80, 81), "jpeg2k_decode": (90, 91)}
SYNTAXES |= {f"{UID}1.2.4.{number}": name for name, numbers in DECODERS.items() for number in numbers}
"""Transfer syntaxes, and what decodes them in imagecodecs; "": pydicom does. The first 3 do not compress."""

STORAGE = UID + "5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Presentation states, reports, documents, contours and plans, which often lie in a series' folder."""

KIND, SYNTAX = b"\x02\x00\x02\x00UI", b"\x02\x00\x10\x00UI"  # elements with which a file begins

TIMES = ["TemporalPositionIndex", "TemporalPositionIdentifier", "AcquisitionNumber", "TriggerTime"]
TIMES += ["DiffusionBValue", "EchoTime", "AcquisitionTime", "ContentTime", "InstanceNumber"]
"""Elements that tell images at one place apart."""

AWAY = 0.1  # the part of a voxel by which a slice may be away from its place: lengths are rounded


class Slice(NamedTuple):
    """One image of a series."""

    file: Path
    frame: int
    elements: Any  # those of its frame in place of those of the file
    shape: tuple[int, int, int]  # of all frames of the file
    place: np.ndarray
    grid: np.ndarray  # distances between rows and between columns, and the directions of both

    @property
    def name(self) -> str:
        return self.file.name if self.shape[0] == 1 else f"frame {self.frame + 1}"


def is_dicom(path: Path) -> bool:
    """Whether a file is DICOM, by the four letters after its preamble."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """The DICOM images in a folder, and what is named like one; but no index of files, and no reports."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.upper() != "DICOMDIR")
    named = {file for file in files if file.suffix.lower() == ".dcm" and not file.name.startswith(".")}
    images = [file for file in files if file in named or is_dicom(file)]
    return [file for file in images if not _meta(file, KIND).startswith(NO_IMAGES)]


def folders_below(folder: Path) -> list[Path]:
    """Folders that hold DICOM images, up to 4 levels down, of 1000 a level at most."""
    below, found = [folder], []
    for _ in range(4):
        below = [each for parent in below for each in sorted(parent.iterdir()) if each.is_dir()][:1000]
        found += [each for each in below if dicom_files(each)]
    return found


def read_dicom(path: Path, spacing: Any = None, time: int | None = None) -> ImageRecord:
    """Reader for a folder of one series, a file of a series, a file of several frames, and a DICOMDIR of one
    series. `spacing`: for slices that do not say theirs. `time`: which of several images at each place."""
    if path.name.upper() == "DICOMDIR":
        folders = folders_below(path.parent)
        told = ", ".join(str(each.relative_to(path.parent)) for each in folders[:8]) or "no folder"
        hint = "beside it holds DICOM images. Give the path of one of them."
        check(len(folders) == 1, f": {told} {hint}")
        with refusing(folders[0]):
            return read_dicom(folders[0], spacing, time)
    headers = series_headers(path)
    slices = [each for file, header in headers.items() for each in _slices(file, header, spacing)]
    must = "must hold at least 2 slices of a series, and fewer than 2**31 voxels"
    is_volume = 2 <= len(slices) <= MOST_VOXELS // math.prod(slices[0].shape[1:] if slices else (1,))
    check(is_volume, f"{must}; got {len(slices)}.")
    first, must = slices[0], "slices of one series must agree in size, spacing and directions"
    for each in slices:
        alike = each.shape[1:] == first.shape[1:] and np.allclose(each.grid, first.grid, rtol=1e-4, atol=1e-4)
        got = " and ".join(f"{one.shape[1:]} {one.grid.tolist()}" for one in (first, each))
        names = f"{first.name} and {each.name} do not: {got}. Is one an overview?"
        check(alike, f": {must}; {names}")
    down, across, (rows, columns) = *first.grid[:2], first.grid[2:].reshape(2, 3)
    turn = np.column_stack([rows, columns, np.cross(rows, columns)])
    rows, columns, normal = directions(f"path: {path}: rows and columns of {first.name}", turn).T
    slices = sorted(slices, key=lambda each: float(each.place @ normal))
    slices, count = _at_one_time(path, slices, normal, time)
    step = _even_step(slices, normal, min(across, down))
    grid = grid_of(np.column_stack([rows * across, columns * down, step, slices[0].place]))
    told = f"DICOM, {len(slices)} slices" + (f", one of {count} at each place" if count > 1 else "")
    place: dict[str, Any] = {"units": "mm", "convention": "LPS", **grid}
    return ImageRecord(_values(slices), "zyx", format=told, is_chosen=count > 1, **place)


def _at_one_time(path: Path, slices: list[Slice], normal: np.ndarray, time: Any) -> tuple[list[Slice], int]:
    """One image at each place, by `time` where there are as many at each; and how many there are."""
    along = np.array([each.place @ normal for each in slices])
    cuts = np.flatnonzero(np.diff(along) > 1e-3 * np.ptp(along) / len(along)) + 1
    groups = [slices[a:b] for a, b in zip([0, *cuts], [*cuts, len(slices)], strict=True)]
    count = len(groups[0])
    if count == 1 or len(groups) == 1 or {len(group) for group in groups} != {count}:
        check(time is None, f"time: {path} has no such axis; it holds one image at each place.")
        return slices, 1
    differs = (name for name in TIMES if len({str(each.elements.get(name)) for each in groups[0]}) == count)
    key = next(differs, TIMES[-1])
    groups = [sorted(group, key=lambda each: _rank(each.elements.get(key))) for group in groups]
    words = re.sub("(?<=[a-z])(?=[A-Z])", " ", key).lower()
    values = ", ".join(str(each.elements.get(key)) for each in groups[0][:6])
    told = f"holds {count} images at each of {len(groups)} places ({words} {values})"
    check(time is not None, f"{told}: time must be given, from 0 to {count - 1}.")
    at = integer("time", time, 0, count - 1)
    return [group[at] for group in groups], count


def _rank(value: Any) -> tuple[float, str]:
    """A key that sorts numbers by size, before texts."""
    try:
        return float(value), str(value)
    except (TypeError, ValueError):
        return math.inf, str(value)


def _even_step(slices: list[Slice], normal: np.ndarray, pixel: float) -> np.ndarray:
    """The step from slice to slice. The gantry may be tilted."""
    at, names = np.array([each.place for each in slices]), [each.name for each in slices]
    mean = (at[-1] - at[0]) / (len(at) - 1)
    for step in (normal * (mean @ normal), mean):
        away = at - at[0] - np.outer(np.arange(len(at)), step)
        along = away @ normal
        sideways = np.abs(away - np.outer(along, normal)).max(axis=1)
        even = (np.abs(along) <= AWAY * (mean @ normal)) & (sideways <= AWAY * pixel)
        if even.all() and mean @ normal >= 1e-6:
            return step
    steps = np.diff(at @ normal)
    usual = float(np.median(steps))
    k = int(np.argmax(np.abs(steps - usual)))
    missing = round(steps[k] / usual) - 1 if usual > 1e-6 else 0
    if abs(steps[k] - usual) <= AWAY * usual:
        k = int(np.argmin(even)) - 1
        told = f"{along[k + 1]:.4g} too far along their normal, and {sideways[k + 1]:.4g} sideways, lies"
    elif missing > 0:
        told = f"{missing} of {usual:.4g} mm {'is' if missing == 1 else 'are'} missing between {names[k]} and"
    else:
        told = f"{steps[k]:.4g} mm for {usual:.4g}: one is there twice, or shifted, between {names[k]} and"
    raise Refused(f"must hold slices evenly spaced along a line; {told} {names[k + 1]}.")


def series_headers(path: Path) -> dict[Path, Any]:
    """Headers, by file, of the only series in a folder, or of the one that a file belongs to."""
    headers = {file: _header(file) for file in dicom_files(path if path.is_dir() else path.parent)}
    series = {file: str(header.get("SeriesInstanceUID", "")) for file, header in headers.items()}
    if path.is_file():
        own = str(_header(path).get("SeriesInstanceUID", ""))
        return {file: header for file, header in headers.items() if series[file] == own}
    examples = {uid: file for file, uid in series.items()}.values()
    told = ", ".join(f"{headers[file].get('SeriesDescription', '')} (as {file.name})" for file in examples)
    hint = "Give the path of one file of the series that you want, or put each into a folder of its own."
    check(len(examples) < 2, f"holds several series: {told}. {hint}")
    return headers


def _header(path: Path, *, pixels: bool = False) -> Any:
    """The elements of a file, through a map of it: pydicom asks for as many bytes as lengths say."""
    with refusing(path), path.open("rb") as stream:
        check(is_dicom(path), 'is no DICOM file: it has no "DICM" at byte 128. Remove it from there.')
        content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        return library("pydicom", path).dcmread(content, stop_before_pixels=not pixels)


def _meta(path: Path, element: bytes) -> str:
    """A UID from the meta information, which is some hundred bytes; "" if it is not there."""
    with path.open("rb") as stream:
        content = stream.read(2**16)
    at = content.find(element, 132)
    length = int.from_bytes(content[at + 6 : at + 8], "little") if at >= 0 else 0
    return content[at + 8 : at + 8 + length].rstrip(b"\0 ").decode("latin-1") if length <= 64 else ""


def _slices(path: Path, header: Any, spacing: Any) -> list[Slice]:
    """The images of a file."""
    with refusing(path):
        syntax, hint = _meta(path, SYNTAX), "Decompress the series first, for example with gdcmconv --raw."
        check(syntax in SYNTAXES, f"is stored in the transfer syntax {syntax}, which is not read. {hint}")
        shape = int(header.get("NumberOfFrames") or 1), int(header.Rows), int(header.Columns)
        channels, bits = int(header.get("SamplesPerPixel", 1)), int(header.get("BitsAllocated", 0))
        is_grey = channels == 1 and min(shape) > 0 and bits in (1, 8, 16, 32, 64)
        got = f"{shape} of {channels} values of {bits} bits"
        check(is_grey, f"must hold slices of one value per pixel; got {got}.")
        held = path.stat().st_size * (1 if syntax in [*SYNTAXES][:3] else MOST_COMPRESSED)
        check_size(held, math.prod(shape) * bits // 8, more=True)
        shared = list(header.get("SharedFunctionalGroupsSequence") or [])[:1]
        single = list(header.get("PerFrameFunctionalGroupsSequence") or [])
        is_placed = len(single) == shape[0] or (shape[0] == 1 and not single)
        check(is_placed, f": each of {shape[0]} frames must say where it lies; {len(single)} do.")
        groups = [[*shared, *single[k : k + 1]] for k in range(shape[0])]
        return [_slice(path, k, shape, header, parts, spacing) for k, parts in enumerate(groups)]


def _slice(path: Path, k: int, shape: Any, header: Any, groups: list[Any], spacing: Any) -> Slice:
    """Frame k of a file. `groups`: sequences of elements that count more than those of the header."""
    items = [item for group in groups for each in group if each.VR == "SQ" for item in each.value[:1]]
    elements = library("pydicom", path).Dataset() if items else header
    if items:
        elements.set_original_encoding(*header.original_encoding)
        for each in (header, *items):
            elements.update(each)
    place = _numbers(elements, 3, "ImagePositionPatient")
    turn = _numbers(elements, 6, "ImageOrientationPatient")
    if spacing is None:
        pixel = _numbers(elements, 2, "PixelSpacing", "ImagerPixelSpacing")
    else:  # of the axes as loaded, to which rows and columns are nearest
        x_and_y = np.abs(turn.reshape(2, 3)).argmax(axis=1)
        pixel = np.asarray(finite_array("spacing", spacing, (3,)))[x_and_y[::-1]]
    return Slice(path, k, elements, shape, place, np.array([*pixel, *turn], float))


def _numbers(elements: Any, count: int, *names: str) -> np.ndarray:
    """The numbers of the first of these elements that has as many; two are positive distances."""
    texts = []
    for name in names:
        value = getattr(elements.get_item(name), "value", None) or b""
        text = value.decode("latin-1") if isinstance(value, bytes) else "\\".join(map(str, value))
        texts.append(shortened(text.strip()))
        try:
            numbers = np.array(text.strip("\0 ").split("\\"), float)
        except ValueError:
            continue
        if numbers.shape == (count,) and np.isfinite(numbers).all() and (count > 2 or np.all(numbers > 0)):
            return numbers
    fault, kind, hint = "must say where it lies", "numbers", ""
    if count == 2:
        fault, kind = "does not say how far its pixels are apart", "positive numbers"
        hint = " Give spacing=(x, y, z), --spacing."
    told = f"{' or '.join(names)} must be {count} {kind}; got {' and '.join(texts)}."
    raise Refused(f"{fault}: {told}{hint}")


def _values(slices: list[Slice]) -> np.ndarray:
    """Values [z, y, x] in a common type: each slice may have its own scale or table."""
    planes, pixels, last = [], np.empty(0), None
    for each in slices:
        with refusing(each.file):
            if each.file != last:
                pixels, last = _pixels(each), each.file
            plane, elements = pixels[each.frame], each.elements
            if elements.get("ModalityLUTSequence"):
                plane = library("pydicom.pixels", each.file).apply_modality_lut(plane, elements)
            slope, intercept = elements.get("RescaleSlope"), elements.get("RescaleIntercept")
            record = ImageRecord(plane, "yx", slope=float(slope or 1), intercept=float(intercept or 0))
            planes.append(record.decode(plane)[0])
    return np.stack(planes)


def _pixels(image: Slice) -> np.ndarray:
    """Stored numbers of all frames of a file."""
    whole, decoder = _header(image.file, pixels=True), SYNTAXES[_meta(image.file, SYNTAX)]
    if not decoder:
        return whole.pixel_array.reshape(image.shape)
    decode = getattr(library("imagecodecs", image.file), decoder)
    encaps = library("pydicom.encaps", image.file)
    frames = encaps.generate_frames(whole.PixelData, number_of_frames=image.shape[0])
    pixels = np.stack([decode(frame) for frame in frames]).reshape(image.shape)
    if whole.PixelRepresentation == 1 and pixels.dtype.kind == "u":  # signed numbers of fewer bits
        unused = 32 - int(whole.BitsStored)
        return (pixels.astype(np.int32) << unused >> unused).astype(f"i{pixels.itemsize}")
    return pixels
