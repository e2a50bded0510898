"""Reads stacks of TIFF images with tifffile: the pages of one file, or the files of a folder."""

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, check_pixels, file_size


ENDINGS = (".tif", ".tiff")

LENGTHS = {"mm": 1.0, "millimeter": 1.0, "cm": 10.0, "inch": 25.4, "nm": 1e-6}
LENGTHS |= dict.fromkeys(("µm", "um", "micron", "\\u00b5m"), 1e-3)
"""Units of length that ImageJ and OME write, in mm."""


def read_tiff(path: Path) -> dict[str, Any]:
    """Reader for a file of several pages. Spacing is what ImageJ or OME wrote, if they did."""
    images, spacing = _images(path)
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


def read_tiff_folder(folder: Path) -> dict[str, Any]:
    """Reader for a folder of files of one page each, in the order of the numbers in their names.

    **Raises:** `ValueError` naming the files for images of different sizes or types, and for a number that is
    missing in a sequence.
    """
    files = tiff_files(folder)
    numbers = [int(found[-1]) for file in files if (found := re.findall(r"[0-9]+", file.stem))]
    steps = np.diff(numbers)
    if len(numbers) == len(files) and steps.size and np.all(steps > 0) and steps.min() != steps.max():
        i = int(np.argmax(steps))
        raise ValueError(
            f"path: slices are missing in {folder}: {files[i].name} is followed by {files[i + 1].name}."
        )
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


def _tifffile(path: Path) -> Any:
    try:
        import tifffile  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"reading {path} needs tifffile: pip install jaxvol[io]") from fault
    return tifffile


def _images(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """The images [z, y, x] in a file, and their spacing where it is known."""
    tifffile = _tifffile(path)
    file_size(path)
    try:
        with tifffile.TiffFile(path) as file:
            _check_last(path, file)
            pages = [page.aspage() for page in file.pages]
            first, kinds = pages[0], {(page.shape, page.dtype) for page in pages}
            axes, whole = file.series[0].axes, file.is_imagej or len(pages) == 1
            # ImageJ may hold a stack in its only page
            shape = file.series[0].shape if whole else (len(pages), *first.shape)
            several = len(kinds) > 1 or (file.is_ome and (len(file.series) > 1 or set(axes) & set("CT")))
            several = several or len(shape) not in (2, 3) or first.samplesperpixel != 1
            if several or first.dtype is None or not 0 < math.prod(shape) <= MOST_VOXELS:
                raise ValueError(
                    f"path: {path} must hold one stack of images of one size, type and value per pixel, and "
                    f"fewer than 2**31 voxels; got {len(file.series)} stacks, the first of shape "
                    f"{file.series[0].shape} ({axes}), and pages of {len(kinds)} kinds."
                )
            packed = first.compression != 1 or first.bitspersample < 8 * first.dtype.itemsize
            check_pixels(path, math.prod(shape) * first.dtype.itemsize, compressed=packed)
            images = file.asarray() if whole else np.stack([page.asarray() for page in pages])
            return images.reshape(-1, *shape[-2:]), _spacing(file)
    except MemoryError:
        raise
    except Exception as fault:
        if isinstance(fault, ValueError) and str(fault).startswith("path:"):
            raise
        raise ValueError(f"path: {path} cannot be read: corrupt, cut short, or {fault}") from fault


def _check_last(path: Path, file: Any) -> None:
    """**Raises** `ValueError` if the pages that were found are followed by others: tifffile leaves out what
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
        if file.is_ome:
            image = _tifffile(Path(file.filename)).xml2dict(file.ome_metadata)["OME"]["Image"]
            told = (image[0] if isinstance(image, list) else image)["Pixels"]
            units = [told.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"]
            steps = [float(told[f"PhysicalSize{axis}"]) for axis in "XYZ"]
        else:
            told, tags = file.imagej_metadata or {}, file.pages[0].aspage().tags
            (nx, dx), (ny, dy) = (tags[name].value for name in ("XResolution", "YResolution"))
            units, steps = [told.get("unit", "")] * 3, [dx / nx, dy / ny, float(told["spacing"])]
        steps = [step * LENGTHS.get(str(unit).lower(), 1.0) for step, unit in zip(steps, units, strict=True)]
    except (KeyError, IndexError, ZeroDivisionError, TypeError, ValueError):
        return {}
    return {"spacing": steps} if all(0 < step < math.inf for step in steps) else {}
