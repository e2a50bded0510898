"""Reads stacks of TIFF images with tifffile: the pages of one file, or the files of a folder."""

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, Header, file_size


ENDINGS = (".tif", ".tiff")

MOST_COMPRESSED = 2000
"""Bytes of pixels per byte of a compressed file, at most. A header that says more is not believed."""

LENGTHS = {
    "mm": 1.0,
    "millimeter": 1.0,
    "cm": 10.0,
    "inch": 25.4,
    "µm": 1e-3,
    "um": 1e-3,
    "micron": 1e-3,
    "nm": 1e-6,
}
"""Units of length that ImageJ and OME write, in mm."""


def read_tiff(path: Path, header: Header) -> dict[str, Any]:
    """Reader for a file of several pages. Spacing is what ImageJ or OME wrote, if they did."""
    header.refuse(path)
    images, spacing = _images(path)
    if len(images) < 2:
        raise ValueError(
            f"path: {path} must hold at least 2 images; got {len(images)}. For a folder of images, give the "
            "path of the folder."
        )
    return {"data": images.transpose(2, 1, 0)} | spacing


def tiff_spacing(path: Path) -> dict[str, Any]:
    """The spacing that a file tells, as `read_tiff` has it; its images are not read."""
    with _tifffile(path).TiffFile(path) as file:
        return _spacing(file)


def tiff_files(folder: Path) -> list[Path]:
    """The TIFF files in a folder, with numbers in their names in numeric order."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in ENDINGS and file.is_file()]

    def key(file: Path) -> list[tuple[int, str]]:
        words = re.split(r"([0-9]+)", file.name.lower())
        return [(int(word), "") if word.isdigit() else (-1, word) for word in words]

    return sorted(files, key=key)


def read_tiff_folder(folder: Path, header: Header) -> dict[str, Any]:
    """Reader for a folder of files of one page each, in the order of the numbers in their names.

    **Raises:** `ValueError` naming the files for images of different sizes or types, and for a number that is
    missing in a sequence.
    """
    header.refuse(folder)
    files = tiff_files(folder)
    _check_numbers(folder, files)
    slices: list[np.ndarray] = []
    for file in files:
        images, _ = _images(file)
        if len(images) != 1:
            raise ValueError(f"path: {file} must hold one image, as a slice of {folder}; got {len(images)}.")
        slices.append(images[0])
        first, last = (f"{each.shape} of {each.dtype}" for each in (slices[0], slices[-1]))
        if first != last or len(slices) * images.size > MOST_VOXELS:
            raise ValueError(
                f"path: the slices in {folder} must have the same size and type, and fewer than 2**31 "
                f"voxels; {files[0].name} has {first}, and {file.name} {last}."
            )
    return {"data": np.stack(slices).transpose(2, 1, 0)}


def _check_numbers(folder: Path, files: list[Path]) -> None:
    """**Raises** `ValueError` if files' names differ in one number, and some of its values are missing."""
    if len(files) < 2:
        raise ValueError(f"path: {folder} must hold at least 2 slices; got {len(files)}.")
    numbers = [[int(number) for number in re.findall(r"[0-9]+", file.stem)] for file in files]
    if not all(numbers) or len({tuple(each[:-1]) for each in numbers}) > 1:
        return
    steps = np.diff([each[-1] for each in numbers])
    if steps.min() != steps.max():
        i = int(np.argmax(steps)) if steps.max() > np.median(steps) else int(np.argmin(steps))
        raise ValueError(
            f"path: slices are missing in {folder}, or there twice: {files[i].name} is followed by "
            f"{files[i + 1].name}."
        )


def _tifffile(path: Path) -> Any:
    try:
        import tifffile  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"reading {path} needs tifffile: pip install jaxvol[io]") from fault
    return tifffile


def _images(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """The images [z, y, x] in a file, and their spacing where it is known."""
    tifffile = _tifffile(path)
    n_bytes = file_size(path)
    try:
        with tifffile.TiffFile(path) as file:
            _check_last(path, file)
            pages = [page.aspage() for page in file.pages]
            first, kinds = pages[0], {(page.shape, page.dtype) for page in pages}
            axes, whole = file.series[0].axes, file.is_imagej or len(pages) == 1
            # ImageJ may hold a stack in its only page
            shape = file.series[0].shape if whole else (len(pages), *first.shape)
            several = file.is_ome and (len(file.series) > 1 or set(axes) & set("CT"))
            if several or len(kinds) > 1 or len(shape) not in (2, 3) or first.samplesperpixel != 1:
                raise ValueError(
                    f"path: {path} must hold one stack of images of one size, type and value per pixel; got "
                    f"{len(file.series)} stacks, the first of shape {file.series[0].shape} ({axes}), and "
                    f"pages of {len(kinds)} kinds. Save one stack alone."
                )
            if not 0 < math.prod(shape) <= MOST_VOXELS or first.dtype is None:
                raise ValueError(
                    f"path: {path} must hold 1 to 2**31 - 1 voxels of a known type; got shape {shape}."
                )
            expected = math.prod(shape) * first.dtype.itemsize
            packed = first.compression != 1 or first.bitspersample < 8 * first.dtype.itemsize
            if n_bytes * (MOST_COMPRESSED if packed else 1) < expected:
                raise ValueError(
                    f"path: {path} is cut short: it has {n_bytes} bytes, and its header announces voxels of "
                    f"{expected}."
                )
            images = file.asarray() if whole else np.stack([page.asarray() for page in pages])
            return images.reshape(-1, *shape[-2:]), _spacing(file)
    except MemoryError:
        raise
    except Exception as fault:
        if isinstance(fault, ValueError) and str(fault).startswith("path:"):
            raise
        raise ValueError(f"path: {path} cannot be read: corrupt, cut short, or {fault}") from fault


def _check_last(path: Path, file: Any) -> None:
    """**Raises** `ValueError` if the pages that were found are followed by others. tifffile leaves out what
    lies beyond the end of the file."""
    format, handle = file.tiff, file.filehandle
    handle.seek(file.pages[-1].aspage().offset)
    (tags,) = struct.unpack(format.tagnoformat, handle.read(format.tagnosize))
    handle.seek(tags * format.tagsize, 1)
    following = handle.read(format.offsetsize)
    if len(following) < format.offsetsize or any(following):
        raise ValueError(f"path: {path} is cut short: after {len(file.pages)} images, the next is not there.")


def _spacing(file: Any) -> dict[str, Any]:
    """Spacing (x, y, z) as OME or ImageJ wrote it, in mm, or in its own unit if that is none of length."""
    try:
        steps = _ome_spacing(file) if file.is_ome else _imagej_spacing(file)
    except (KeyError, IndexError, ZeroDivisionError, TypeError, ValueError):
        return {}
    return {"spacing": steps} if all(0 < step < math.inf for step in steps) else {}


def _ome_spacing(file: Any) -> list[float]:
    image = _tifffile(Path(file.filename)).xml2dict(file.ome_metadata)["OME"]["Image"]
    pixels = (image[0] if isinstance(image, list) else image)["Pixels"]
    return [
        float(pixels[f"PhysicalSize{axis}"]) * _unit(pixels.get(f"PhysicalSize{axis}Unit", "µm"))
        for axis in "XYZ"
    ]


def _imagej_spacing(file: Any) -> list[float]:
    found, tags = file.imagej_metadata or {}, file.pages[0].aspage().tags
    (nx, dx), (ny, dy) = (tags[name].value for name in ("XResolution", "YResolution"))
    unit = _unit(found.get("unit", ""))
    return [dx / nx * unit, dy / ny * unit, float(found["spacing"]) * unit]


def _unit(name: Any) -> float:
    return LENGTHS.get(str(name).replace("\\u00B5", "µ").lower(), 1.0)
