"""Reader of series of DICOM slices, and of files of several frames, by pydicom, sorted by position."""

import math
import mmap
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..._util.affine import directions
from ..._util.checks import Arrayable, finite_array, integer, shortened
from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, Refused, check, check_size, library, refusing
from ..._util.image_record import ImageRecord
from ..._util.named_axes import grid_of


UID = "1.2.840.10008."
SYNTAXES = {UID + end: "" for end in ("1.2", "1.2.1", "1.2.2", "1.2.1.99", "1.2.5")}
DECODERS = {"jpeg_decode": (50, 51, 57, 70), "jpegls_decode": (80, 81), "jpeg2k_decode": (90, 91)}
SYNTAXES |= {f"{UID}1.2.4.{number}": name for name, numbers in DECODERS.items() for number in numbers}
"""Transfer syntaxes, and their decoders in imagecodecs; "": pydicom. The first 3 are not compressed."""

STORAGE = UID + "5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Presentation states, reports, documents, contours and plans, which often lie in a series' folder."""

KIND, SYNTAX = b"\x02\x00\x02\x00UI", b"\x02\x00\x10\x00UI"  # elements at the beginning of a file

TIMES = ["TemporalPositionIndex", "TemporalPositionIdentifier", "AcquisitionNumber", "TriggerTime"]
TIMES += ["DiffusionBValue", "EchoTime", "AcquisitionTime", "ContentTime", "InstanceNumber"]
"""Elements that distinguish images at one place."""

TOLERANCE = 0.1  # maximum distance of a slice from its place in voxels, since lengths are rounded


class Slice(NamedTuple):
    """One image of a series."""

    file: Path
    frame: int
    elements: Any  # of the file, updated by those of the frame
    shape: tuple[int, int, int]  # (frames, rows, columns) of the file
    place: np.ndarray
    grid: np.ndarray  # distances between rows and between columns, and directions of both

    @property
    def name(self) -> str:
        return self.file.name if self.shape[0] == 1 else f"frame {self.frame + 1}"


def is_dicom(path: Path) -> bool:
    """Test for a DICOM file, by the four letters after its preamble."""
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def dicom_files(folder: Path) -> list[Path]:
    """DICOM images in a folder, and other files named `.dcm`; without a DICOMDIR and reports."""
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.upper() != "DICOMDIR")
    named = {file for file in files if file.suffix.lower() == ".dcm" and not file.name.startswith(".")}
    images = [file for file in files if file in named or is_dicom(file)]
    return [file for file in images if not _meta(file, KIND).startswith(NO_IMAGES)]


def folders_below(folder: Path) -> list[Path]:
    """Folders that hold DICOM images, up to 4 levels down, among at most 1000 per level."""
    level, folders = [folder], []
    for _ in range(4):
        level = [child for parent in level for child in sorted(parent.iterdir()) if child.is_dir()][:1000]
        folders += filter(dicom_files, level)
    return folders


def read_dicom(path: Path, spacing: Arrayable | None = None, time: int | None = None) -> ImageRecord:
    """Reader of a folder of one series, a file of a series, a file of several frames, and a DICOMDIR of one
    series. `spacing`: of slices without one. `time`: index among several images at every place."""
    if path.name.upper() == "DICOMDIR":
        folders = folders_below(path.parent)
        names = ", ".join(str(folder.relative_to(path.parent)) for folder in folders[:8]) or "no folder"
        check(len(folders) == 1, f": {names} beside it holds DICOM images. Give the path of one of them.")
        with refusing(folders[0]):
            return read_dicom(folders[0], spacing, time)
    headers = series_headers(path)
    slices = [image for file, header in headers.items() for image in _slices(file, header, spacing)]
    is_volume = 2 <= len(slices) <= MOST_VOXELS // math.prod(slices[0].shape[1:] if slices else (1,))
    check(is_volume, f"must hold at least 2 slices, and fewer than 2**31 voxels; got {len(slices)} slices.")
    first, must = slices[0], "slices of one series must agree in size, spacing and directions"
    for image in slices:
        has_grid = np.allclose(image.grid, first.grid, rtol=1e-4, atol=1e-4)
        got = " and ".join(f"{s.shape[1:]} {s.grid.tolist()}" for s in (first, image))
        names = f"{first.name} and {image.name} do not: {got}. Is one an overview?"
        check(has_grid and image.shape[1:] == first.shape[1:], f": {must}; {names}")
    down, across, (rows, columns) = *first.grid[:2], first.grid[2:].reshape(2, 3)
    turn = np.column_stack([rows, columns, np.cross(rows, columns)])
    rows, columns, normal = directions(f"path: {path}: rows and columns of {first.name}", turn).T
    slices = sorted(slices, key=lambda image: float(image.place @ normal))
    slices, count = _at_one_time(path, slices, normal, time)
    step = _even_step(slices, normal, min(across, down))
    grid = grid_of(np.column_stack([rows * across, columns * down, step, slices[0].place]))
    title = f"DICOM, {len(slices)} slices" + (f", one of {count} at each place" if count > 1 else "")
    place: dict[str, Any] = {"units": "mm", "convention": "LPS", **grid}
    return ImageRecord(_values(slices), "zyx", format=title, is_chosen=count > 1, **place)


def _at_one_time(path: Path, slices: list[Slice], normal: np.ndarray, time: Any) -> tuple[list[Slice], int]:
    """One image per place, selected by `time` if all places have equally many, and their number."""
    depths = np.array([image.place @ normal for image in slices])
    cuts = np.flatnonzero(np.diff(depths) > 1e-3 * np.ptp(depths) / len(depths)) + 1
    groups = [slices[a:b] for a, b in zip([0, *cuts], [*cuts, len(slices)], strict=True)]
    count = len(groups[0])
    if count == 1 or len(groups) == 1 or {len(group) for group in groups} != {count}:
        check(time is None, f"time: {path} has no such axis; it holds one image at each place.")
        return slices, 1
    unique = (name for name in TIMES if len({str(s.elements.get(name)) for s in groups[0]}) == count)
    key = next(unique, TIMES[-1])
    groups = [sorted(group, key=lambda image: _rank(image.elements.get(key))) for group in groups]
    words = re.sub("(?<=[a-z])(?=[A-Z])", " ", key).lower()
    values = ", ".join(str(image.elements.get(key)) for image in groups[0][:6])
    fault = f"holds {count} images at each of {len(groups)} places ({words} {values})"
    check(time is not None, f"{fault}: time must be given, from 0 to {count - 1}.")
    index = integer("time", time, 0, count - 1)
    return [group[index] for group in groups], count


def _rank(value: Any) -> tuple[float, str]:
    """Sort key: numbers by size, before texts."""
    try:
        return float(value), str(value)
    except (TypeError, ValueError):
        return math.inf, str(value)


def _even_step(slices: list[Slice], normal: np.ndarray, pixel: float) -> np.ndarray:
    """Step from slice to slice. The gantry may be tilted."""
    places, names = np.array([image.place for image in slices]), [image.name for image in slices]
    mean = (places[-1] - places[0]) / (len(places) - 1)
    for step in (normal * (mean @ normal), mean):
        offsets = places - places[0] - np.outer(np.arange(len(places)), step)
        heights = offsets @ normal
        shifts = np.abs(offsets - np.outer(heights, normal)).max(axis=1)
        even = (np.abs(heights) <= TOLERANCE * (mean @ normal)) & (shifts <= TOLERANCE * pixel)
        if even.all() and mean @ normal >= 1e-6:
            return step
    steps = np.diff(places @ normal)
    usual = float(np.median(steps))
    k = int(np.argmax(np.abs(steps - usual)))
    missing = round(steps[k] / usual) - 1 if usual > 1e-6 else 0
    if abs(steps[k] - usual) <= TOLERANCE * usual:
        k = int(np.argmin(even)) - 1
        text = f"{heights[k + 1]:.4g} too far along their normal, and {shifts[k + 1]:.4g} sideways, lies"
    elif missing > 0:
        text = f"{missing} of {usual:.4g} mm {'is' if missing == 1 else 'are'} missing between {names[k]} and"
    else:
        text = f"{steps[k]:.4g} mm for {usual:.4g}: a slice is repeated or shifted between {names[k]} and"
    raise Refused(f"must hold slices evenly spaced along a line; {text} {names[k + 1]}.")


def series_headers(path: Path) -> dict[Path, Any]:
    """Headers, by file, of the only series in a folder, or of the series of a file."""
    headers = {file: _header(file) for file in dicom_files(path if path.is_dir() else path.parent)}
    series = {file: str(header.get("SeriesInstanceUID", "")) for file, header in headers.items()}
    if path.is_file():
        uid = str(_header(path).get("SeriesInstanceUID", ""))
        return {file: header for file, header in headers.items() if series[file] == uid}
    examples = {uid: file for file, uid in series.items()}.values()
    names = ", ".join(f"{headers[file].get('SeriesDescription', '')} (as {file.name})" for file in examples)
    hint = "Give the path of one file of the series to load, or put every series into a folder by itself."
    check(len(examples) < 2, f"holds several series: {names}. {hint}")
    return headers


def _header(path: Path, *, pixels: bool = False) -> Any:
    """Elements of a file, by a memory map: pydicom requests as many bytes as unchecked lengths say."""
    with refusing(path), path.open("rb") as stream:
        check(is_dicom(path), 'is no DICOM file: it has no "DICM" at byte 128. Remove it from the folder.')
        content = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        return library("pydicom", path).dcmread(content, stop_before_pixels=not pixels)


def _meta(path: Path, element: bytes) -> str:
    """UID from the meta information at the beginning of a file; "" if missing."""
    with path.open("rb") as stream:
        content = stream.read(2**16)
    at = content.find(element, 132)
    length = int.from_bytes(content[at + 6 : at + 8], "little") if at >= 0 else 0
    return content[at + 8 : at + 8 + length].rstrip(b"\0 ").decode("latin-1") if length <= 64 else ""


def _slices(path: Path, header: Any, spacing: Arrayable | None) -> list[Slice]:
    """Images of a file."""
    with refusing(path):
        syntax, hint = _meta(path, SYNTAX), "Decompress the series first, for example with gdcmconv --raw."
        check(syntax in SYNTAXES, f"is stored in the transfer syntax {syntax}, which is not read. {hint}")
        shape = int(header.get("NumberOfFrames") or 1), int(header.Rows), int(header.Columns)
        channels, bits = int(header.get("SamplesPerPixel", 1)), int(header.get("BitsAllocated", 0))
        is_grey = channels == 1 and min(shape) > 0 and bits in (1, 8, 16, 32, 64)
        check(is_grey, f"must hold one value per pixel; got {shape} of {channels} values of {bits} bits.")
        held = path.stat().st_size * (1 if syntax in [*SYNTAXES][:3] else MOST_COMPRESSED)
        check_size(held, math.prod(shape) * bits // 8, more=True)
        shared = list(header.get("SharedFunctionalGroupsSequence") or [])[:1]
        single = list(header.get("PerFrameFunctionalGroupsSequence") or [])
        is_placed = len(single) == shape[0] or (shape[0] == 1 and not single)
        check(is_placed, f": each of {shape[0]} frames must say where it lies; {len(single)} do.")
        groups = [[*shared, *single[k : k + 1]] for k in range(shape[0])]
        return [_slice(path, k, shape, header, parts, spacing) for k, parts in enumerate(groups)]


def _slice(path: Path, k: int, shape: Any, header: Any, groups: list[Any], spacing: Any) -> Slice:
    """Frame k of a file. `groups`: sequences of elements that override those of the header."""
    items = [item for group in groups for tag in group if tag.VR == "SQ" for item in tag.value[:1]]
    elements = library("pydicom", path).Dataset() if items else header
    if items:
        elements.set_original_encoding(*header.original_encoding)
        for item in (header, *items):
            elements.update(item)
    place = _numbers(elements, 3, "ImagePositionPatient")
    turn = _numbers(elements, 6, "ImageOrientationPatient")
    if spacing is None:
        pixel = _numbers(elements, 2, "PixelSpacing", "ImagerPixelSpacing")
    else:  # of the axes as loaded: the nearest ones to rows and columns
        x_and_y = np.abs(turn.reshape(2, 3)).argmax(axis=1)
        pixel = np.asarray(finite_array("spacing", spacing, (3,)))[x_and_y[::-1]]
    return Slice(path, k, elements, shape, place, np.array([*pixel, *turn], float))


def _numbers(elements: Any, count: int, *names: str) -> np.ndarray:
    """Numbers of the first of the named elements that has `count` numbers; two are positive distances."""
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
    must = f"{' or '.join(names)} must be {count} {kind}"
    raise Refused(f"{fault}: {must}; got {' and '.join(texts)}.{hint}")


def _values(slices: list[Slice]) -> np.ndarray:
    """Values [z, y, x] in a common type. Scales and tables may differ between slices."""
    planes, pixels, last = [], np.empty(0), None
    for image in slices:
        with refusing(image.file):
            if image.file != last:
                pixels, last = _pixels(image), image.file
            plane, elements = pixels[image.frame], image.elements
            if elements.get("ModalityLUTSequence"):
                plane = library("pydicom.pixels", image.file).apply_modality_lut(plane, elements)
            slope, intercept = elements.get("RescaleSlope"), elements.get("RescaleIntercept")
            record = ImageRecord(plane, "yx", slope=float(slope or 1), intercept=float(intercept or 0))
            planes.append(record.decode(plane)[0])
    return np.stack(planes)


def _pixels(image: Slice) -> np.ndarray:
    """Stored numbers of all frames of a file."""
    elements, decoder = _header(image.file, pixels=True), SYNTAXES[_meta(image.file, SYNTAX)]
    if not decoder:
        return elements.pixel_array.reshape(image.shape)
    decode = getattr(library("imagecodecs", image.file), decoder)
    encaps = library("pydicom.encaps", image.file)
    frames = encaps.generate_frames(elements.PixelData, number_of_frames=image.shape[0])
    pixels = np.stack([decode(frame) for frame in frames]).reshape(image.shape)
    if elements.PixelRepresentation == 1 and pixels.dtype.kind == "u":  # signed numbers of fewer bits
        unused = 32 - int(elements.BitsStored)
        return (pixels.astype(np.int32) << unused >> unused).astype(f"i{pixels.itemsize}")
    return pixels
