"""Reads stacks of TIFF images with tifffile: the pages of one file, or the files of a folder."""

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, check_size, file_size


ENDINGS = (".tif", ".tiff")

LENGTHS = {"mm": 1.0, "millimeter": 1.0, "cm": 10.0, "inch": 25.4, "nm": 1e-6}
LENGTHS |= dict.fromkeys(("µm", "um", "micron", "\\u00b5m"), 1e-3)
"""Units of length that ImageJ and OME write, in mm."""


def read_tiff(path: Path) -> dict[str, Any]:
    """Reader for a file of several pages. Spacing is what ImageJ or OME wrote, if they did."""
    images, axes, spacing = _images(path)
    order = [axis for axis in "XYZTCS" if axis in axes]
    data = images.transpose([axes.index(axis) for axis in order])
    return {"data": data, "axes": "".join(order).lower()} | spacing


def tiff_files(folder: Path) -> list[Path]:
    """The TIFF files in a folder, with numbers in their names in numeric order."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in ENDINGS and file.is_file()]

    def key(file: Path) -> list[Any]:
        words: list[Any] = re.split(r"([0-9]+)", file.name.lower())
        words[1::2] = map(int, words[1::2])
        return words

    return sorted(files, key=key)


def read_tiff_folder(folder: Path) -> dict[str, Any]:
    """Reader for a folder of files of one page each, in the order of the numbers in their names. Raises
    `ValueError` naming the files for images of different sizes or types, and for a number that is missing."""
    files, slices = tiff_files(folder), []
    numbers = [int(found[-1]) for file in files if (found := re.findall(r"[0-9]+", file.stem))]
    steps = np.diff(numbers).tolist()
    if len(numbers) == len(files) and len(set(steps)) > 1 and min(steps) > 0:
        i = int(np.argmax(steps))
        raise ValueError(
            f"path: slices are missing in {folder}: {files[i].name} is followed by {files[i + 1].name}."
        )
    for file in files:
        image, axes, _ = _images(file)
        slices.append(image)
        first, last = (f"{each.shape[1:]} of {each.dtype}" for each in (slices[0], image))
        if axes != "ZYX" or len(image) != 1 or first != last or len(slices) * image.size > MOST_VOXELS:
            raise ValueError(
                f"path: each file in {folder} must hold one image of the same size and type, fewer than "
                f"2**31 voxels in all; {files[0].name} has {first}, and {file.name} {len(image)} of {last}."
            )
    return {"data": np.concatenate(slices).transpose(2, 1, 0)}


def _images(path: Path) -> tuple[np.ndarray, str, dict[str, Any]]:
    """The images in a file, the letters of their axes, with one Z at least, and spacing where it is known."""
    try:
        import tifffile  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"reading {path} needs tifffile: pip install 'jaxvol[io]'") from fault
    file_size(path)
    try:
        with tifffile.TiffFile(path) as file:
            _check_last(path, file)
            pages = [page.aspage() for page in file.pages]
            first, kinds = pages[0], {(page.shape, page.dtype) for page in pages}
            series, whole = file.series[0], file.is_imagej or len(pages) == 1
            told = whole or file.is_ome  # ImageJ may hold a stack in its only page
            axes, shape = series.axes, series.shape
            if not told:
                axes, shape = f"Z{first.axes}", (len(pages), *first.shape)
            further = axes.translate(str.maketrans("", "", "YXS"))
            if len(further) == 1 and not file.is_ome:  # ImageJ's stacks may be of times
                axes = axes.replace(further, "Z")
            if "Z" not in axes:
                axes, shape = f"Z{axes}", (1, *shape)
            strange = (
                len(kinds) > 1 or (file.is_ome and len(file.series) > 1) or not set(axes) <= set("XYZTCS")
            )
            if strange or first.dtype is None or not 0 < math.prod(shape) <= MOST_VOXELS:
                raise ValueError(
                    f"path: {path} must hold one stack of images of one size and type, and fewer than 2**31 "
                    f"voxels; got {len(file.series)} stacks, the first of shape {series.shape} "
                    f"({series.axes}), and pages of {len(kinds)} kinds."
                )
            packed = first.compression != 1 or first.bitspersample < 8 * first.dtype.itemsize
            held = path.stat().st_size * (MOST_COMPRESSED if packed else 1)
            check_size(path, held, math.prod(shape) * first.dtype.itemsize, more=True)
            images = file.asarray() if whole else np.stack([page.asarray() for page in pages])
            return images.reshape(shape), axes, _spacing(tifffile, file)
    except MemoryError:
        raise
    except Exception as fault:
        if "imagecodecs" in str(fault):
            raise ImportError(
                f"reading {path} needs imagecodecs ({fault}): pip install 'jaxvol[io]'"
            ) from fault
        if isinstance(fault, ValueError) and str(fault).startswith("path:"):
            raise
        raise ValueError(f"path: {path} cannot be read: corrupt, cut short, or {fault}") from fault


def _check_last(path: Path, file: Any) -> None:
    """Raises `ValueError` if more pages follow: tifffile leaves out what lies beyond the file's end."""
    format, handle = file.tiff, file.filehandle
    handle.seek(file.pages[-1].aspage().offset)
    (tags,) = struct.unpack(format.tagnoformat, handle.read(format.tagnosize))
    handle.seek(tags * format.tagsize, 1)
    following = handle.read(format.offsetsize)
    if len(following) < format.offsetsize or any(following):
        raise ValueError(f"path: {path} is cut short: after {len(file.pages)} images, the next is not there.")


def _spacing(tifffile: Any, file: Any) -> dict[str, Any]:
    """Spacing (x, y, z) as OME or ImageJ wrote it, in mm, or in its own unit if that is none of length."""
    try:
        if file.is_ome:
            image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
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
