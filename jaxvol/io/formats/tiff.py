"""Reads stacks of images: TIFF with tifffile, by the series that it knows, and folders of TIFF, PNG and JPEG."""

import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_COMPRESSED, MOST_VOXELS, check_size, file_size, library, reason, refusing
from ..._util.image_record import ImageRecord
from ..._util.units import AXES


ENDINGS = (".tif", ".tiff")
PICTURES = (".png", ".jpg", ".jpeg")
NO_CURVE = (None, 20, 22)
"""ImageJ's calibration functions that change nothing; 0 is a line."""


def read_tiff(path: Path) -> ImageRecord:
    """Reader for the first series of a file: axes are those of OME's XML, of ImageJ, or of tifffile's own
    metadata, and of plain pages z; lengths and scale are what OME or ImageJ wrote."""
    tifffile = library("tifffile", path)
    file_size(path)
    with refusing(path):
        try:
            with tifffile.TiffFile(path) as file:
                return _series(path, file, tifffile)
        except Exception as fault:
            if "imagecodecs" in str(fault):
                told = f"reading {path} needs imagecodecs ({fault}): pip install 'jaxvol[io]'"
                raise ImportError(told) from fault
            raise


def _series(path: Path, file: Any, tifffile: Any) -> ImageRecord:
    if not file.is_ome:  # whose pages may lie in other files
        _check_last(path, file)
    image, first, notes = _ome(path, file, tifffile), file.pages[0].aspage(), []
    several, series = list(file.series), file.series[0]
    kinds = {(each.shape, each.dtype) for each in several}
    pages = len(several) > 1 and len(kinds) == 1 and set(series.axes) <= set("YXS")  # written one by one
    if (
        (len(several) > 1 and not pages)
        or not set(series.axes) <= set("XYZTCSQIAPRHEV")
        or first.dtype is None
    ):
        told = "; ".join(f"{each.shape} ({each.axes})" for each in several[:4])
        raise ValueError(
            f"path: {path} must hold one stack of images of one size and type; got {len(several)} stacks, and "
            f"pages of {len(kinds)} kinds: {told}. Choose one, as by tifffile.imread(path, series=0)."
        )
    axes, shape = ("Z" + series.axes, (len(several), *series.shape)) if pages else (series.axes, series.shape)
    unknown = [at for at, axis in enumerate(axes) if axis not in "ZTCYXS"]
    free = [letter for letter in "ZTC" if letter not in axes]
    for at, letter in zip(unknown[::-1], free, strict=False):  # the fastest is z
        axes = axes[:at] + letter + axes[at + 1 :]
    further = axes.translate(str.maketrans("", "", "YXS"))
    if len(further) == 1 and not file.is_ome:  # ImageJ's stacks may be of times
        axes = axes.replace(further, "Z")
        notes += [f"axis {further}: taken as z"] if further != "Z" and file.is_shaped else []
    if "Z" not in axes:
        axes, shape = f"Z{axes}", (1, *shape)
    if not 0 < math.prod(shape) < 2**62:
        raise ValueError(f"path: {path} must hold images; its header says {shape}.")
    packed = first.compression != 1 or first.bitspersample < 8 * first.dtype.itemsize
    files = (
        {page.parent.filehandle.path for page in series.pages if page is not None} if file.is_ome else {path}
    )
    held = sum(Path(each).stat().st_size for each in files) * (MOST_COMPRESSED if packed else 1)
    expected = math.prod(shape) * first.dtype.itemsize
    if missing := sum(page is None for page in series.pages) if file.is_ome else 0:
        notes.append(f"{missing} of {len(series.pages)} planes are not in the file: filled with 0")
        expected = expected * (len(series.pages) - missing) // len(series.pages)
    check_size(path, held, expected, more=True)
    if (
        math.prod(shape) > MOST_VOXELS and not file.is_memmappable_ome
        if hasattr(file, "is_memmappable_ome")
        else False
    ):
        raise ValueError(f"path: {path} must hold fewer than 2**31 voxels; got {shape}.")
    data = np.stack([each.asarray() for each in several]) if pages else series.asarray()
    record = ImageRecord(data.reshape(shape), axes, assumed=notes, what=f"path: {path}")
    if "GDAL_NODATA" in first.tags:
        record.missing = (float(first.nodata),)
    for role in ("scale", "offset") if "GDAL_METADATA" in first.tags else ():
        if found := re.search(rf'role="{role}"[^>]*>([^<]+)<', str(first.tags["GDAL_METADATA"].value)):
            setattr(record, {"scale": "slope", "offset": "intercept"}[role], float(found[1]))
    told = file.imagej_metadata or {}
    if file.is_imagej and told.get("cf") not in NO_CURVE:
        if told["cf"] != 0:
            record.note(f"ImageJ's calibration function {told['cf']} is not read: stored numbers are shown")
        else:
            record.slope, record.intercept = float(told.get("c1", 1)), float(told.get("c0", 0))
    steps, units = _imagej(told, first.tags) if file.is_imagej else _of_pixels(image)
    if all(0 < abs(step) < math.inf for step in steps.values()):
        record.steps, record.units = {axis: abs(step) for axis, step in steps.items()}, units
    return record


def _ome(path: Path, file: Any, tifffile: Any) -> dict[str, Any]:
    """The pixels of the first image of OME's XML. Raises `ValueError` for files that it names and are not there."""
    if not file.is_ome:
        return {}
    for name in set(re.findall(r'FileName="([^"]*)"', file.ome_metadata)):
        if Path(name).name != name or not (path.parent / name).is_file():
            raise ValueError(f"path: {path} is one of several files of an image: {name} is not beside it.")
    image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
    return (image[0] if isinstance(image, list) else image)["Pixels"]


def _of_pixels(pixels: dict[str, Any]) -> tuple[dict[str, float], dict[str, str | None]]:
    """Steps and units as OME has them: µm, unless said otherwise."""
    steps = {a.lower(): float(pixels[f"PhysicalSize{a}"]) for a in "XYZ" if f"PhysicalSize{a}" in pixels}
    return steps, {a.lower(): pixels.get(f"PhysicalSize{a}Unit", "µm") for a in "XYZ"}


def _imagej(told: dict[str, Any], tags: Any) -> tuple[dict[str, float], dict[str, str | None]]:
    """Steps and units as ImageJ has them: the step along z is 1 where it is not there."""
    units = {
        axis: told.get(name, told.get("unit"))
        for axis, name in zip("xyz", ("xunit", "yunit", "zunit"), strict=True)
    }
    steps = {"z": float(told["spacing"])} if "spacing" in told else {}
    for axis, name in (("x", "XResolution"), ("y", "YResolution")):
        numerator, denominator = tags[name].value if name in tags else (0, 1)
        if numerator > 0:
            steps[axis] = denominator / numerator
    if told.get("unit") and "x" in steps:
        steps.setdefault("z", 1.0)
    return (steps if "unit" in told or "z" in steps else {}), units


def _check_last(path: Path, file: Any) -> None:
    """Raises `ValueError` if more pages follow: tifffile leaves out what lies beyond the file's end."""
    format, handle = file.tiff, file.filehandle
    handle.seek(file.pages[-1].aspage().offset)
    (tags,) = struct.unpack(format.tagnoformat, handle.read(format.tagnosize))
    handle.seek(tags * format.tagsize, 1)
    following = handle.read(format.offsetsize)
    if len(following) < format.offsetsize or any(following):
        raise ValueError(f"path: {path} is cut short: after {len(file.pages)} images, the next is not there.")


def slice_files(folder: Path) -> list[Path]:
    """The images in a folder, of the ending that most have, with numbers in their names in numeric order."""
    images = [
        file for file in folder.iterdir() if file.suffix.lower() in ENDINGS + PICTURES and file.is_file()
    ]
    kinds = [
        [file for file in images if file.suffix.lower() in kind]
        for kind in (ENDINGS, *((e,) for e in PICTURES))
    ]
    return sorted(max(kinds, key=len), key=_words)


def _words(file: Path) -> list[Any]:
    words: list[Any] = re.split(r"([0-9]+)", file.stem.lower())
    words[1::2] = map(int, words[1::2])
    return words


def read_slices(folder: Path) -> ImageRecord:
    """Reader for a folder of files of one image each, in the order of the numbers in their names; where two of
    these count, one is that of channels or times. Raises `ValueError` naming the files for images of
    different sizes or types, for a number that is missing, and for names that count in another way."""
    files = slice_files(folder)
    axes, counts, order = _counted(folder, files)
    slices: list[np.ndarray] = []
    for file in (files[k] for k in order):
        image = read_tiff(file) if file.suffix.lower() in ENDINGS else _picture(file)
        plane = np.asarray(image.data)
        same = not slices or (plane.shape, plane.dtype) == (slices[0].shape, slices[0].dtype)
        if (
            len(plane) != 1
            or image.axes not in ("ZYX", "ZYXS")
            or not same
            or len(files) * plane.size > MOST_VOXELS
        ):
            first, last = (f"{each.shape[1:]} of {each.dtype}" for each in ([*slices, plane][0], plane))
            raise ValueError(
                f"path: each file in {folder} must hold one image of the same size and type, fewer than "
                f"2**31 voxels in all; {files[0].name} has {first}, and {file.name} {len(plane)} of {last}."
            )
        slices.append(plane)
    data = np.concatenate(slices).reshape(*counts, *slices[0].shape[1:])
    return ImageRecord(data, axes + ["y", "x", "s"][: data.ndim - len(axes)], what=f"path: {folder}")


def _picture(path: Path) -> ImageRecord:
    """One PNG or JPEG, by Pillow."""
    from PIL import Image

    file_size(path)
    try:
        with Image.open(path) as image:
            if image.width * image.height > min(MOST_VOXELS, path.stat().st_size * MOST_COMPRESSED):
                raise ValueError(f"its header says {image.size}, more than its bytes can hold")
            data = np.asarray(
                image
                if image.mode not in ("1", "P", "CMYK", "LA")
                else image.convert("RGB" if image.mode == "CMYK" else "L")
            )
    except Exception as fault:  # of many kinds
        raise ValueError(f"path: {path} cannot be read: {reason(fault)}.") from fault
    return ImageRecord(data[None], "ZYX" + "S" * (data.ndim > 2))


def _counted(folder: Path, files: Sequence[Path]) -> tuple[list[str], list[int], list[int]]:
    """Axes that the names of files count, sizes along them, and the files in their order."""
    words = [_words(file) for file in files]
    patterns: dict[tuple[Any, ...], int] = {}
    for each in words:
        key = tuple(each[::2])
        patterns[key] = patterns.get(key, 0) + 1
    if len(patterns) > 1 and min(patterns.values()) > 1:
        told = ", ".join(f"{count} named {'#'.join(key)}" for key, count in list(patterns.items())[:4])
        raise ValueError(
            f"path: {folder} holds {len(patterns)} series of images: {told}. Put each into a folder of its own."
        )
    if len(patterns) > 1:
        return ["z"], [len(files)], [*range(len(files))]
    numbers = np.array([each[1::2] for each in words], object).reshape(len(files), -1)
    varied = [k for k in range(numbers.shape[1]) if len({*numbers[:, k]}) > 1]
    unique = [k for k in varied if len({*numbers[:, k]}) == len(files)]
    if len(varied) > 1 and not unique:
        sizes = [len({*numbers[:, k]}) for k in varied]
        names = [re.findall(r"[a-z]*", words[0][2 * k])[-2:][0] for k in varied]
        letters = [AXES.get(name) if name != "w" else "c" for name in names]
        letters = ["z" if letter not in ("c", "t") else letter for letter in letters]
        if len({*letters}) < len(letters) or math.prod(sizes) != len(files):
            of = max(zip(sizes, varied, strict=True))[0]
            raise ValueError(
                f"path: {folder} holds {len(files) // of} series of {of} images: names such as {files[0].name} and "
                f"{files[-1].name} count by {len(varied)} numbers. Put each series into a folder of its own."
            )
        order = sorted(range(len(files)), key=lambda i: [numbers[i, k] for k in varied])
        return letters, sizes, order
    for k in unique[-1:]:
        steps = np.diff(numbers[:, k].astype(float)).tolist()
        if len({*steps}) > 1 and min(steps) > 0:
            i = int(np.argmax(steps))
            raise ValueError(
                f"path: slices are missing in {folder}: {files[i].name} is followed by {files[i + 1].name}."
            )
    return ["z"], [len(files)], [*range(len(files))]
