"""Reads NRRD images with SimpleITK, and brings medical images along the axes of the world.

SimpleITK takes memory as headers say, and returns garbage for some files that are cut short. So the size of
the content is compared with the header before it reads any.
"""

import gzip
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.affine import place_of
from ..._util.checks import shortened
from ..._util.files import MOST_VOXELS, check_size, decoding, file_size


ALONG_AXES = 1e-5
"""Greatest entry by which directions may differ from the world's axes to count as these: it misplaces no
voxel of 1000 by more than a hundredth. NIfTI's own rounding is smaller."""


LONGEST = 900
"""Letters of a field in an NRRD header, at most: what ITK tells of longer ones is written beyond its buffer,
and ends the process. Comments and pairs (`key:=value`) may be longer."""


def simple_itk(path: Path) -> Any:
    """The module SimpleITK. Raises `ImportError` that says what to install for `path`."""
    try:
        import SimpleITK  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"{path} needs SimpleITK: pip install 'jaxvol[io]'") from fault
    return SimpleITK


def read_nrrd(path: Path) -> dict[str, Any]:
    """Reader for `.nrrd` and `.nhdr`."""
    file_size(path)
    sitk = simple_itk(path)
    fields, begin, source = nrrd_header(path)
    encoding, spacings = fields.get("encoding", "").lower(), fields.get("spacings", "1 1 1")
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO")
    wrong = (
        f"path: {path} must hold its voxels, or name one file of them, in the encoding raw or gzip; got "
        f"{shortened(encoding)} and {shortened(str(source))}."
    )
    if not source.is_file():  # ITK opens it, and waits for the other end of a pipe
        raise ValueError(wrong)
    reader.SetFileName(str(path))
    with decoding(path):
        reader.ReadImageInformation()
        size, channels = reader.GetSize(), reader.GetNumberOfComponents()
        check_volume(path, size, channels)
        # axes of no space have NaN; SimpleITK takes 1 for what is wrong
        lengths = [float(word) for word in spacings.split() if word.lower() != "nan"]
        if len(lengths) < 3 or not all(0 < each < math.inf for each in lengths):
            raise ValueError(
                f"path: {path}: spacings must be positive, for 3 axes; got {shortened(spacings)}."
            )
        component = sitk.Image([1, 1, 1], reader.GetPixelIDValue()).GetSizeOfPixelComponent()
        expected = math.prod(size) * channels * component
        if encoding not in ("raw", "gzip", "gz"):
            raise ValueError(wrong)
        held = source.stat().st_size - begin
        if encoding != "raw":
            with source.open("rb") as stream:
                stream.seek(begin)
                held = gzip.GzipFile(fileobj=stream).seek(expected)
        check_size(path, held, expected, more=True)
        image = reader.Execute()
    n = len(size)
    data = np.moveaxis(sitk.GetArrayFromImage(image).reshape(*size[::-1], channels), range(n), range(n)[::-1])
    turn = np.reshape(image.GetDirection(), (n, n))[:3, :3]
    affine = np.column_stack([turn * image.GetSpacing()[:3], image.GetOrigin()[:3]])
    return placed(f"path: {path}: its place", data, affine) | {"axes": "xyztc"[:n] + "s"}


def check_volume(path: Path, size: Any, channels: Any) -> None:
    """Raises `ValueError` for an image that is no volume, or several of them along further axes."""
    if not 3 <= len(size) <= 5 or channels < 1 or min(size) < 1 or math.prod(size) * channels > MOST_VOXELS:
        raise ValueError(
            f"path: {path} must be a 3-D image, or several along further axes, of fewer than 2**31 voxels; "
            f"got size {tuple(size)} and {channels} values per voxel."
        )


def nrrd_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of an NRRD file, in small letters without blanks; where its voxels begin, and in which file,
    which may be missing."""
    found, end = text_header(path, ":", longest=LONGEST)
    fields = {key.lower().replace(" ", ""): value for key, value in found.items()}
    named = fields.get("datafile")
    return (fields, end, path) if named is None else (fields, 0, path.parent / named)


def text_header(
    path: Path, separator: str, last: str = "", longest: int = 2**20
) -> tuple[dict[str, str], int]:
    """The fields of a header in text, and where in the file it ends: at an empty line, or behind the field
    `last`. Raises `ValueError` for more than 1024 fields, and fields of more than so many letters."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while last not in fields:
            line = stream.readline(2**20).decode("latin-1").strip()
            if not line:
                break
            key, _, value = line.partition(separator)
            long = len(line) > longest and not (key.startswith("#") or value.startswith("="))
            if long or len(fields) == 2**10:
                told = f"the field {shortened(line)}" if long else "more than 1024 fields"
                raise ValueError(f"path: {path} cannot be read: its header has {told}.")
            fields[key.strip()] = value.strip()
        return fields, stream.tell()


def placed(what: str, data: np.ndarray, affine: np.ndarray) -> dict[str, Any]:
    """Arguments of `Volume` for `data[i, j, k]` at `affine @ (i, j, k, 1)`; see `place_of`."""
    return toward_axes(data, *place_of(what, affine).values())


def toward_axes(data: np.ndarray, spacing: Any, origin: Any, direction: Any) -> dict[str, Any]:
    """Arguments of `Volume` for `data[i, j, k, ...]` whose axes point along the columns of `direction`.

    Axes are exchanged and reversed so that x, y and z of the result increase along the world's as nearly as
    they can; what is left is its `direction`, which is missing if it is none. No voxel is interpolated.
    """
    matrix = np.reshape(np.asarray(direction, float), (3, 3))
    # the axis of the data that is nearest to each axis of the world, all three at once
    order = max(map(list, itertools.permutations(range(3))), key=lambda p: np.abs(matrix[range(3), p]).sum())
    matrix, steps = matrix[:, order], np.asarray(spacing, float)[order]
    signs = np.where(np.diag(matrix) >= 0, 1, -1)
    turned = np.transpose(data, (*order, *range(3, data.ndim)))
    last = np.where(signs < 0, np.array(turned.shape[:3]) - 1, 0)
    arguments: dict[str, Any] = {
        "data": np.ascontiguousarray(turned[tuple(slice(None, None, sign) for sign in signs)]),
        "spacing": steps,
        "origin": np.asarray(origin, float) + matrix @ (steps * last),
    }
    if not np.allclose(matrix * signs, np.eye(3), rtol=0, atol=ALONG_AXES):
        arguments["direction"] = matrix * signs
    return arguments
