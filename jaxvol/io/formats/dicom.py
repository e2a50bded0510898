"""Reads series of DICOM slices, and files of several frames, with pydicom, sorted by where they lie."""

import math
import mmap
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.affine import directions
from ..._util.checks import finite_array, shortened
from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, check_size, file_size, library, reason
from ..._util.image_record import ImageRecord


UID = "1.2.840.10008."
PLAIN = {UID + end for end in ("1.2", "1.2.1", "1.2.2", "1.2.1.99")}
JPEG = "ljpeg" if False else "jpeg"
PACKED = dict.fromkeys((f"{UID}1.2.4.{number}" for number in (50, 51, 57, 70)), "jpeg_decode")
PACKED |= dict.fromkeys((f"{UID}1.2.4.{number}" for number in (80, 81)), "jpegls_decode")
PACKED |= dict.fromkeys((f"{UID}1.2.4.{number}" for number in (90, 91)), "jpeg2k_decode")
"""Transfer syntaxes, and what decodes them in imagecodecs; run lengths (1.2.5) by pydicom."""

STORAGE = UID + "5.1.4.1.1."
NO_IMAGES = tuple(STORAGE + kind for kind in ("11.", "88.", "104.", "481.3", "481.5"))
"""Presentation states, reports, documents, contours and plans, which often lie in a series' folder."""

TIMES = "AcquisitionNumber", "TemporalPositionIdentifier", "TriggerTime", "DiffusionBValue", "EchoTime"
TIMES += "ContentTime", "InstanceNumber"
"""Elements that tell images of one place apart."""

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
    return [file for file in images if not _kind(file).startswith(NO_IMAGES)]


def _kind(path: Path) -> str:
    """The class of what a file holds, from the meta information at its begin; "" if it is not there."""
    with path.open("rb") as stream:
        found = re.search(rb"\x02\x00\x02\x00UI(.)\x00([0-9.]{1,64})", stream.read(2**16), re.DOTALL)
    return found[2].decode() if found else ""


def folders_below(folder: Path) -> list[Path]:
    """Folders that hold DICOM images, up to 4 levels down, 1000 at most."""
    found: list[Path] = []
    below = [folder]
    for _ in range(4):
        below = [each for parent in below for each in sorted(parent.iterdir()) if each.is_dir()][:1000]
        found += [each for each in below if dicom_files(each)]
    return found


def read_dicom(path: Path, spacing: Any = None, time: int | None = None) -> ImageRecord:
    """Reader for a folder that holds one series, for one file of a series, whose others are in its folder, for
    a disc by its DICOMDIR, and for a file of several frames.

    Args:
        path: the folder, or the file.
        spacing: of the volume, if the caller knows it; for slices that do not say theirs.
        time: which one of several images at each place.

    Raises:
        ValueError: for several series, and for slices that are missing, of different sizes or directions,
            without spacing, shifted unevenly, cut short, or compressed in a way that is not read.
    """
    if path.name.upper() == "DICOMDIR":
        folders = folders_below(path.parent)
        if len(folders) != 1:
            told = ", ".join(str(folder.relative_to(path.parent)) for folder in folders[:8]) or "no folder"
            raise ValueError(
                f"path: {path}: {told} beside it holds DICOM images. Give the path of one of them."
            )
        path = folders[0]
    headers = series_headers(path)
    frames = [frame for file, header in headers.items() for frame in _frames(file, header, spacing)]
    shapes = {frame["shape"] for frame in frames}
    if len(frames) < 2 or len(frames) * math.prod(max(shapes)) > MOST_VOXELS:
        raise ValueError(
            f"path: {path} must hold at least 2 slices of a series, and fewer than 2**31 voxels; got {len(frames)}."
        )
    first = frames[0]
    for frame in frames:
        same = np.allclose(frame["grid"], first["grid"], rtol=1e-4, atol=1e-4)
        if not same or frame["shape"] != first["shape"]:
            raise ValueError(
                f"path: {path}: slices of one series must agree in size, spacing and directions; {first['name']} and "
                f"{frame['name']} do not: {first['shape']} {first['grid']} and {frame['shape']} {frame['grid']}. Is one an "
                "overview?"
            )
    down, across = first["grid"][:2]
    turn = np.reshape(first["grid"][2:], (2, 3)).T
    turn = np.column_stack([turn, np.cross(*turn.T)])
    turn = directions(f"path: {path}: rows and columns of {first['name']}", turn)
    frames, count = _one_time(
        path, sorted(frames, key=lambda frame: float(frame["at"] @ turn[:, 2])), turn[:, 2], time
    )
    step, length = _even(path, frames, turn[:, 2], min(across, down))
    turn[:, 2] = step / length
    # the last step is a list of planes, since each may have its own scale
    planes = [frame["values"]() for frame in frames]
    return ImageRecord(
        np.stack(planes),
        "zyx",
        {"x": across, "y": down, "z": length},
        "mm",
        frames[0]["at"],
        turn,
        "LPS",
        what=f"path: {path}: rows, columns and slices",
        format=f"DICOM, {len(frames)} slices" + (f", {count} at each place" if count > 1 else ""),
    )


def _one_time(path: Path, frames: list[Any], normal: np.ndarray, time: int | None) -> tuple[list[Any], int]:
    """One image at each place, by `time` where there are as many at each; and how many there are."""
    along = np.array([frame["at"] @ normal for frame in frames])
    apart = np.flatnonzero(np.diff(along) > 1e-3 * max(np.ptp(along) / len(along), 1e-6)) + 1
    groups = np.split(np.arange(len(frames)), apart)
    count = len(groups[0])
    if count == 1 or len({len(group) for group in groups}) > 1 or len(groups) < 2:
        if time is not None:
            raise ValueError(f"time: {path} has no such axis; it holds one image at each place.")
        return frames, 1
    keys = [name for name in TIMES if len({str(frames[i]["told"].get(name)) for i in groups[0]}) == count]
    key = keys[0] if keys else ""
    told = sorted({frames[i]["told"].get(key) for i in groups[0]}, key=_number) if key else []
    if time is None:
        by = (
            f" ({re.sub('(?<!^)([A-Z])', lambda m: ' ' + m[1].lower(), key)} {', '.join(map(str, told[:6]))})"
            if key
            else ""
        )
        raise ValueError(
            f"path: {path} holds {count} images at each of {len(groups)} places{by}: time must be given, from 0 to "
            f"{count - 1}."
        )
    if not 0 <= time < count:
        raise ValueError(f"time must be an integer from 0 to {count - 1}; got {time!r}.")
    chosen = [sorted(group, key=lambda i: _number(frames[i]["told"].get(key)))[time] for group in groups]
    return [frames[i] for i in chosen], count


def _number(value: Any) -> tuple[float, str]:
    try:
        return float(value), ""
    except (TypeError, ValueError):
        return math.inf, str(value)


def _even(path: Path, frames: list[Any], normal: np.ndarray, pixel: float) -> tuple[np.ndarray, float]:
    """The step from slice to slice, and its length. The gantry may be tilted."""
    at = np.array([frame["at"] for frame in frames])
    mean = (at[-1] - at[0]) / (len(at) - 1)
    for step in (normal * (mean @ normal), mean):
        away = at - at[0] - np.outer(np.arange(len(at)), step)
        along = away @ normal
        sideways = np.abs(away - np.outer(along, normal)).max(axis=1)
        even = (np.abs(along) <= AWAY * (mean @ normal)) & (sideways <= AWAY * pixel)
        if even.all() and mean @ normal >= 1e-6:
            return step, float(np.linalg.norm(step))
    told, steps = f"path: {path} must hold slices evenly spaced along a line", np.diff(at @ normal)
    usual, names = float(np.median(steps)), [frame["name"] for frame in frames]
    for k in np.flatnonzero(np.abs(steps - usual) > 2 * AWAY * usual)[:1] if usual > 0 else []:
        between = f"between {names[k]} and {names[k + 1]}"
        if (missing := round(steps[k] / usual) - 1) > 0:
            raise ValueError(
                f"{told}: {missing} of {usual:.4g} mm {'is' if missing == 1 else 'are'} missing {between}."
            )
        fault = (
            "two are there twice, at one place:"
            if steps[k] < 0.01 * usual
            else f"{steps[k]:.4g} mm in place of {usual:.4g}"
        )
        raise ValueError(f"{told}: {fault} {between}.")
    i = int(np.argmin(even))
    raise ValueError(
        f"{told}; of {len(at)}, {names[i]} lies {along[i]:.4g} too far along their normal, and {sideways[i]:.4g} "
        "sideways. Are slices missing or there twice?"
    )


def series_headers(path: Path) -> dict[Path, Any]:
    """Headers, by file, of the only series in a folder, or of the one that a file belongs to."""
    headers = {file: _header(file) for file in dicom_files(path if path.is_dir() else path.parent)}
    series = {file: str(header.get("SeriesInstanceUID", "")) for file, header in headers.items()}
    if path.is_file():
        own = str(_header(path).get("SeriesInstanceUID", ""))
        return {file: header for file, header in headers.items() if series[file] == own}
    examples = {uid: file for file, uid in series.items()}
    if len(examples) > 1:
        told = [
            f"{headers[file].get('SeriesDescription', '')} (as {file.name})" for file in examples.values()
        ]
        raise ValueError(
            f"path: {path} holds several series: {', '.join(told)}. Give the path of one file of the series "
            "that you want, or put each into a folder of its own."
        )
    return headers


def _header(path: Path, *, pixels: bool = False) -> Any:
    """The elements of a file, through a map of it: pydicom asks for as many bytes as lengths say."""
    pydicom = library("pydicom", path)
    if not is_dicom(path):
        raise ValueError(
            f'path: {path} is no DICOM file: it has no "DICM" at byte 128. Remove it from there.'
        )
    return _trying(path, lambda: pydicom.dcmread(_mapped(path), stop_before_pixels=not pixels))


def _mapped(path: Path) -> mmap.mmap:
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)


def _trying(path: Path, read: Callable[[], Any]) -> Any:
    """What a function of pydicom returns; any of its many errors as one that says what is wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return read()
    except MemoryError:
        raise
    except Exception as fault:
        if str(fault).startswith("path:"):
            raise
        told = f"{reason(fault)}. Is it cut short, or of a kind that is not supported?"
        raise ValueError(f"path: {path} cannot be read: {told}") from fault


def _numbers(path: Path, parts: list[Any], name: str, count: int) -> np.ndarray:
    """The numbers of an element of the first of these parts that has it; none if it holds something else."""
    for part in parts:
        try:
            value = np.asarray(part[name].value, float) if name in part else np.empty(0)
        except Exception:  # of numbers that are none
            value = np.empty(0)
        if value.shape == (count,) and np.isfinite(value).all():
            return value
    return np.empty(0)


def _frames(path: Path, header: Any, spacing: Any) -> list[dict[str, Any]]:
    """The slices of a file: where each lies, and a function that returns its values."""
    return _trying(path, lambda: _slices(path, header, spacing))


def _slices(path: Path, header: Any, spacing: Any) -> list[dict[str, Any]]:
    syntax = str(header.file_meta.get("TransferSyntaxUID", ""))
    if syntax not in PLAIN | PACKED.keys() | {UID + "1.2.5"}:
        raise ValueError(
            f"path: {path} is stored in the transfer syntax {syntax}, which is not read. Decompress the series "
            "first, for example with gdcmconv --raw."
        )
    count, shape = int(header.get("NumberOfFrames") or 1), (int(header.Rows), int(header.Columns))
    channels, bits = int(header.get("SamplesPerPixel", 1)), int(header.BitsAllocated)
    if channels != 1 or count < 1 or min(shape) < 1 or bits not in (1, 8, 16, 32, 64):
        raise ValueError(
            f"path: {path} must hold slices of one value per pixel; got {count} of {shape}, {channels} values of {bits} bits."
        )
    held = file_size(path) * (1 if syntax in PLAIN and not syntax.endswith(".99") else MOST_COMPRESSED)
    check_size(path, held, count * math.prod(shape) * bits // 8, more=True)
    shared = list(header.get("SharedFunctionalGroupsSequence") or [])[:1]
    single = list(header.get("PerFrameFunctionalGroupsSequence") or [])
    if len(single) not in ((0, 1, count) if count == 1 else (count,)):
        raise ValueError(f"path: {path}: {count} frames must say where they lie; {len(single)} do.")
    pixels: list[np.ndarray] = []

    def values(k: int, parts: list[Any]) -> np.ndarray:
        if not pixels:
            pixels.append(_trying(path, lambda: _pixels(path, syntax, (count, *shape))))
        plane, pixels[0:] = pixels[0][k], pixels if k < count - 1 else []
        return _trying(path, lambda: _scaled(path, plane, parts))

    found = []
    for k in range(count):
        groups = [*(single[k : k + 1]), *shared]
        parts = [item for group in groups for e in group if e.VR == "SQ" for item in e.value[:1]] + [header]
        at, turn = (
            _numbers(path, parts, "ImagePositionPatient", 3),
            _numbers(path, parts, "ImageOrientationPatient", 6),
        )
        for name, tag, told, n in (
            ("ImagePositionPatient", "0020|0032", at, 3),
            ("ImageOrientationPatient", "0020|0037", turn, 6),
        ):
            if told.size != n:
                raw = header.get_item(name) if name in header else None
                got = shortened(
                    ""
                    if raw is None
                    else raw.value.decode("latin-1")
                    if isinstance(raw.value, bytes)
                    else raw.value
                )
                raise ValueError(
                    f"path: {path} must say where it lies: element ({tag}) must be {n} numbers; got {got}."
                )
        pixel = next(
            (
                p
                for name in ("PixelSpacing", "ImagerPixelSpacing")
                if (p := _numbers(path, parts, name, 2)).size
            ),
            None,
        )
        if pixel is None or not np.all(pixel > 0):
            if spacing is None:
                texts = [
                    shortened(getattr(header.get_item(n), "value", b"") if n in header else "")
                    for n in ("PixelSpacing", "ImagerPixelSpacing")
                ]
                raise ValueError(
                    f"path: {path} does not say how far its pixels are apart: PixelSpacing (0028|0030) and "
                    f"ImagerPixelSpacing (0018|1164) must be 2 positive numbers; got {texts[0]} and {texts[1]}. "
                    "Give spacing=(x, y, z), --spacing."
                )
            # of the axes as loaded, to which rows and columns are nearest
            x_and_y = np.abs(turn.reshape(2, 3)).argmax(axis=1)
            pixel = np.asarray(finite_array("spacing", spacing, (3,)))[x_and_y[::-1]]
        told = {name: part[name].value for name in TIMES for part in parts[::-1] if name in part}
        name = path.name if count == 1 else f"frame {k + 1}"
        found.append(
            {"name": name, "shape": shape, "at": at, "grid": [*map(float, pixel), *turn], "told": told}
        )
        found[-1]["values"] = lambda k=k, parts=parts: values(k, parts)
    return found


def _pixels(path: Path, syntax: str, shape: tuple[int, int, int]) -> np.ndarray:
    """Stored numbers of all frames. `imagecodecs` decodes what is compressed."""
    whole = _header(path, pixels=True)
    if syntax not in PACKED:
        return whole.pixel_array.reshape(shape)
    import imagecodecs
    from pydicom.encaps import generate_frames

    decode = getattr(imagecodecs, PACKED[syntax])
    frames = [decode(frame) for frame in generate_frames(whole.PixelData, number_of_frames=shape[0])]
    found = np.stack(frames).reshape(shape)
    bits, stored = whole.BitsAllocated, int(whole.BitsStored)
    if whole.PixelRepresentation == 1 and found.dtype.kind == "u":  # signed numbers, of fewer bits
        found = (found.astype(np.int32) << (32 - stored) >> (32 - stored)).astype(f"i{bits // 8}")
    return found


def _scaled(path: Path, plane: np.ndarray, parts: list[Any]) -> np.ndarray:
    """Values by the Modality LUT, a table or a line."""
    from pydicom.pixels import apply_modality_lut

    header = next((part for part in parts if "ModalityLUTSequence" in part), None)
    if header is not None:
        return apply_modality_lut(plane, header)
    slope, intercept = (
        float(next((part[n].value for part in parts if n in part and part[n].value is not None), k))
        for n, k in (("RescaleSlope", 1), ("RescaleIntercept", 0))
    )
    return ImageRecord(plane, "yx", slope=slope or 1.0, intercept=intercept).decode(plane)[0]
