"""Readers of stacks of images: TIFF by tifffile, and folders of TIFF, PNG and JPEG."""

import io
import math
import re
import struct
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, check, check_size, file_size, library, refusing
from ..._util.image_record import ImageRecord
from ..._util.units import AXES


ENDINGS = (".tif", ".tiff")
PICTURES = (".png", ".jpg", ".jpeg")


def read_tiff(path: Path) -> ImageRecord:
    """Reader of a file's first series, with axes and scale by OME, ImageJ or tifffile; plain pages are z."""
    tifffile = library("tifffile", path)
    with refusing(path):
        try:
            with tifffile.TiffFile(path) as file:
                return _series(path, file, tifffile)
        except Exception as fault:
            if "imagecodecs" not in str(fault):
                raise
            hint = "pip install 'jaxvol[io]'"
            raise ImportError(f"reading {path} needs imagecodecs ({fault}): {hint}") from fault


def _series(path: Path, file: Any, tifffile: Any) -> ImageRecord:
    pixels: dict[str, Any] = _ome_pixels(path, file, tifffile) if file.is_ome else {}
    if not pixels:  # pages of OME may lie in other files
        _check_last(file)
    stacks, first = list(file.series), file.pages[0].aspage()
    axes, kinds = stacks[0].axes, {(stack.shape, stack.dtype) for stack in stacks}
    one_by_one = len(stacks) > 1 and len(kinds) == 1 and {*axes} <= {*"YXS"}
    is_stack = (len(stacks) == 1 or one_by_one) and {*axes} <= {*"XYZTCSQIAPRHEV"} and first.dtype
    sizes = "; ".join(f"{stack.shape} ({stack.axes})" for stack in stacks[:4])
    must, got = "must hold one stack of images of one size and type", f"got {len(stacks)} stacks"
    hint = "Choose one, as by tifffile.imread(path, series=0)."
    check(is_stack, f"{must}; {got}, and pages of {len(kinds)} kinds: {sizes}. {hint}")
    record, shape = ImageRecord(None, ""), stacks[0].shape
    if not {*axes} - {*"YXS"}:
        axes, shape = "I" + axes, (len(stacks), *shape)
    further = [a for a in axes if a not in "YXS"]
    if len(further) == 1 and not pixels:  # the axis of an ImageJ stack may be time
        if further[0] in "TC" and file.is_shaped:
            record.note(f"axis {further[0]}: taken as z")
        axes = axes.replace(further[0], "Z")
    free = iter(letter for letter in "ZTC" if letter not in axes)
    record.axes = "".join(a if a in "ZTCYXS" else next(free, a) for a in axes[::-1])[::-1]  # the fastest is z
    pages = [page for stack in stacks for page in stack.pages]
    held = [page for page in pages if page is not None or not pixels]
    if missing := len(pages) - len(held):
        record.note(f"{missing} of {len(pages)} planes are not in the file: filled with 0")
    check(0 < math.prod(shape) < 2**62, f"must hold images; its header says {shape}.")
    packed = first.compression != 1 or first.bitspersample < 8 * first.dtype.itemsize
    files = {page.parent.filehandle.path for page in held if page is not None} if pixels else {path}
    size = sum(Path(name).stat().st_size for name in files) * (MOST_COMPRESSED if packed else 1)
    check_size(size, math.prod(shape) * first.dtype.itemsize * len(held) // len(pages), more=True)
    strips = [n for page in held if page is not None for n in page.databytecounts]
    check_size(size, max(strips, default=0), more=True)  # tifffile would allocate them
    arrays = [stack.asarray() for stack in stacks]
    record.data = (np.stack(arrays) if one_by_one else arrays[0]).reshape(shape)
    _calibrate(record, file, first, pixels)
    return record


def _calibrate(record: ImageRecord, file: Any, first: Any, pixels: dict[str, Any]) -> None:
    """Set scale (GDAL, ImageJ) and steps (ImageJ, which omits a z step of 1; OME) of a record."""
    if "GDAL_NODATA" in first.tags:
        record.missing = (float(first.nodata),)
    gdal = str(first.tags["GDAL_METADATA"].value) if "GDAL_METADATA" in first.tags else ""
    for role, name in (("scale", "slope"), ("offset", "intercept")):
        if match := re.search(rf'role="{role}"[^>]*>([^<]+)<', gdal):
            setattr(record, name, float(match[1]))
    imagej = (file.imagej_metadata or {}) if file.is_imagej else {}
    if imagej.get("cf") == 0:  # linear; 20 and 22: no calibration
        record.slope, record.intercept = float(imagej.get("c1", 1)), float(imagej.get("c0", 0))
    elif imagej.get("cf", 20) not in (20, 22):
        record.note(f"ImageJ's calibration function {imagej['cf']} is not read: stored numbers are shown")
    units = {axis: imagej.get(f"{axis}unit", imagej.get("unit")) for axis in "xyz"}
    steps = {"z": float(imagej.get("spacing", 1.0))} if {"spacing", "unit"} & imagej.keys() else {}
    for axis in "xy" if steps else "":
        tag = first.tags.get(f"{axis.upper()}Resolution")
        numerator, denominator = tag.value if tag else (0, 1)
        steps |= {axis: denominator / numerator} if numerator > 0 else {}
    if pixels:
        steps = {a.lower(): float(pixels[f"PhysicalSize{a}"]) for a in "XYZ" if f"PhysicalSize{a}" in pixels}
        units = {a.lower(): pixels.get(f"PhysicalSize{a}Unit", "µm") for a in "XYZ"}
    if all(0 < abs(step) < math.inf for step in steps.values()):
        record.steps, record.units = {axis: abs(step) for axis, step in steps.items()}, units


def _ome_pixels(path: Path, file: Any, tifffile: Any) -> dict[str, Any]:
    """Element `Pixels` of the first image of OME's XML. Raises `ValueError` if a file is missing."""
    match = re.search(r'<OME [^>]*UUID="([^"]*)"', file.ome_metadata)
    for name, uuid in {*re.findall(r'<UUID FileName="([^"]*)">\s*([^<\s]*)', file.ome_metadata)}:
        exists = (match and uuid == match[1]) or (Path(name).name == name and (path.parent / name).is_file())
        check(exists, f"is one of several files of an image: {name} is not beside it.")
    image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
    return (image[0] if isinstance(image, list) else image)["Pixels"]


def _check_last(file: Any) -> None:
    """Refuse a file if further pages follow: tifffile ignores pages beyond the file's end."""
    format, handle = file.tiff, file.filehandle
    handle.seek(file.pages[-1].aspage().offset)
    (tags,) = struct.unpack(format.tagnoformat, handle.read(format.tagnosize))
    handle.seek(tags * format.tagsize, 1)
    following = handle.read(format.offsetsize)
    is_last = len(following) == format.offsetsize and not any(following)
    check(is_last, f"is cut short: after {len(file.pages)} images, the next is not there.")


def slice_files(folder: Path) -> list[Path]:
    """Images in a folder, of the commonest ending, with numbers in their names in numeric order."""
    files = [file for file in folder.iterdir() if file.is_file()]
    kinds = (ENDINGS, *((ending,) for ending in PICTURES))
    groups = [[file for file in files if file.suffix.lower() in kind] for kind in kinds]
    return sorted(max(groups, key=len), key=_words)


def _words(file: Path) -> list[Any]:
    """Name of a file without ending, split into words and the numbers between them."""
    words = re.split(r"([0-9]+)", file.stem.lower())
    return [int(word) if k % 2 else word for k, word in enumerate(words)]


def read_slices(folder: Path) -> ImageRecord:
    """Reader of a folder of images of one size and type, in the order of the numbers in their names, one of
    which may count channels or times. Refuses missing numbers."""
    axes, counts, files = _counted(folder, slice_files(folder))
    record, planes = ImageRecord(None, axes), list[np.ndarray]()
    for file in files:
        image = read_tiff(file) if file.suffix.lower() in ENDINGS else _picture(file)
        plane = image.decode(np.asarray(image.data))[0]
        record.steps, record.units = (record.steps, record.units) if planes else (image.steps, image.units)
        planes.append(plane)
        first, last = (f"{array.shape[1:]} of {array.dtype}" for array in (planes[0], plane))
        must = f"path: each file in {folder} must hold one image of the same size and type, fewer than 2**31"
        got = f"{files[0].name} has {first}, and {file.name} {len(plane)} of {last}."
        is_image = image.axes in ("ZYX", "ZYXS") and len(plane) == 1
        is_alike = is_image and first == last and len(files) * plane.size <= MOST_VOXELS
        check(is_alike, f"{must} voxels in all; {got}")
    record.data = np.concatenate(planes).reshape(*counts, *planes[0].shape[1:])
    record.axes = axes + "yxs"[: record.data.ndim - len(axes)]
    return record


def _picture(path: Path) -> ImageRecord:
    """Reader of a PNG or JPEG, by Pillow."""
    from PIL import Image

    size = file_size(path)
    with refusing(path), Image.open(io.BytesIO(path.read_bytes())) as image:  # its lengths are unchecked
        if image.width * image.height > size * MOST_COMPRESSED:
            raise ValueError(f"its header says {image.size}, more than its bytes can hold")
        data = np.asarray(image)
    return ImageRecord(data[None], "ZYXS"[: data.ndim + 1])


def _counted(folder: Path, files: Sequence[Path]) -> tuple[str, list[int], Sequence[Path]]:
    """Axes counted by numbers in the names of files, sizes along them, and the files in order."""
    words, hint = {file: _words(file) for file in files}, "Put every series into a folder by itself."
    patterns = Counter("#".join(parts[::2]) for parts in words.values())
    names = ", ".join(f"{count} named {pattern}" for pattern, count in patterns.most_common(4))
    is_one = len(patterns) == 1 or min(patterns.values()) == 1
    check(is_one, f"holds {len(patterns)} series of images: {names}. {hint}")
    numbers = [] if len(patterns) > 1 else [*zip(*(parts[1::2] for parts in words.values()), strict=True)]
    sizes = {k: len({*column}) for k, column in enumerate(numbers) if len({*column}) > 1}
    unique = [k for k, size in sizes.items() if size == len(files)]
    if len(sizes) > 1 and not unique:
        before = [([*re.findall("[a-z]+", words[files[0]][2 * k]), ""][-2:])[0] for k in sizes]
        axes = ["c" if name == "w" else AXES.get(name, "z") for name in before]
        axes = [axis if axis in "ct" else "z" for axis in axes]
        n = max(sizes.values())
        names = f"names such as {files[0].name} and {files[-1].name} count by {len(sizes)} numbers"
        is_grid = len({*axes}) == len(axes) and math.prod(sizes.values()) == len(files)
        check(is_grid, f"holds {len(files) // n} series of {n} images: {names}. {hint}")
        files = sorted(files, key=lambda file: [words[file][2 * k + 1] for k in sizes])
        return "".join(axes), [*sizes.values()], files
    steps = np.diff(np.array(numbers[unique[-1]], float)).tolist() if unique else [1]
    before, after = (files[min(steps.index(max(steps)) + k, len(files) - 1)].name for k in (0, 1))
    is_whole = len({*steps}) <= 1 or min(steps) <= 0
    check(is_whole, f"path: slices are missing in {folder}: {before} is followed by {after}.")
    return "z", [len(files)], files
