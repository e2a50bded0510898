"""Reads NIfTI and NRRD images with SimpleITK, and brings medical images along the axes of the world.

SimpleITK takes memory as headers say, and returns garbage for some files that are cut short. So the size of
the content is compared with the header before it reads any.
"""

import gzip
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import shortened
from ..._util.files import MOST_VOXELS, check_size, decoding, file_size


ALONG_AXES = 1e-5
"""Greatest entry by which directions may differ from the world's axes to count as these: it misplaces no
voxel of 1000 by more than a hundredth. NIfTI's own rounding is smaller."""

ROUNDED = 1e-3
"""Greatest cosine between the directions of two axes that counts as a right angle, and greatest difference of
a squared length from 1: files hold directions of a few decimal places."""


LONGEST = 900
"""Letters of a field in an NRRD header, at most: what ITK tells of longer ones is written beyond its buffer,
and ends the process. Comments and pairs (`key:=value`) may be longer."""


def simple_itk(path: Path) -> Any:
    """The module SimpleITK. Raises `ImportError` that says what to install for `path`."""
    try:
        import SimpleITK  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"{path} needs SimpleITK: pip install jaxvol[io]") from fault
    return SimpleITK


def read_nifti(path: Path) -> dict[str, Any]:
    """Reader for `.nii` and `.nii.gz`."""
    file_size(path)
    reader, packed = simple_itk(path).ImageFileReader(), path.name.lower().endswith(".gz")
    reader.SetImageIO("NiftiImageIO")
    with decoding(path), gzip.open(path) if packed else path.open("rb") as stream:
        begin = stream.read(4)  # of other files, ITK's library prints text of its own
        if not {int.from_bytes(begin, order) for order in ("little", "big")} & {348, 540}:
            raise ValueError(
                f"path: {path} cannot be read: a NIfTI file begins with the size of its header, 348 or 540; "
                f"this one with the bytes {begin.hex(' ')}. Fetch or write it again."
            )
        voxels = _read_header(path, reader)
        offset = int(float(reader.GetMetaData("vox_offset")))
        expected = offset + voxels * int(reader.GetMetaData("bitpix")) // 8
        # only decompressing tells the size; a header may hold any number
        held = stream.seek(min(expected, 2**62)) if packed else path.stat().st_size
        check_size(path, held, expected, more=True)
        return _volume(path, reader)


def read_nrrd(path: Path) -> dict[str, Any]:
    """Reader for `.nrrd` and `.nhdr`."""
    file_size(path)
    sitk = simple_itk(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO")
    encoding, begin, source = nrrd_header(path)
    wrong = (
        f"path: {path} must hold its voxels, or name one file of them, in the encoding raw or gzip; got "
        f"{shortened(encoding)} and {shortened(str(source))}."
    )
    if not source.is_file():  # ITK opens it, and waits for the other end of a pipe
        raise ValueError(wrong)
    with decoding(path):
        voxels = _read_header(path, reader)
        if encoding not in ("raw", "gzip", "gz"):
            raise ValueError(wrong)
        expected = voxels * sitk.Image([1, 1, 1], reader.GetPixelIDValue()).GetSizeOfPixelComponent()
        held = source.stat().st_size - begin
        if encoding != "raw":
            with source.open("rb") as stream:
                stream.seek(begin)
                held = gzip.GzipFile(fileobj=stream).seek(expected)
        check_size(path, held, expected, more=True)
        return _volume(path, reader)


def _read_header(path: Path, reader: Any) -> int:
    """Read the header of an image, which must be one of a volume. Returns the number of its voxels."""
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    size, channels = reader.GetSize(), reader.GetNumberOfComponents()
    check_volume(path, size, channels)
    return math.prod(size)


def check_volume(path: Path, size: Any, channels: Any) -> None:
    """Raises `ValueError` for an image that is no volume of one value per voxel."""
    if len(size) != 3 or channels != 1 or min(size) < 1 or math.prod(size) > MOST_VOXELS:
        raise ValueError(
            f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; got size "
            f"{size} and {channels} values per voxel."
        )


def _volume(path: Path, reader: Any) -> dict[str, Any]:
    image = reader.Execute()
    data = simple_itk(path).GetArrayFromImage(image).T
    return toward_axes(data, image.GetSpacing(), image.GetOrigin(), image.GetDirection())


def nrrd_header(path: Path) -> tuple[str, int, Path]:
    """The encoding of an NRRD file; where its voxels begin, and in which file, which may be missing."""
    found, end = text_header(path, ":", longest=LONGEST)
    fields = {key.lower().replace(" ", ""): value for key, value in found.items()}
    named, encoding = fields.get("datafile"), fields.get("encoding", "").lower()
    return (encoding, end, path) if named is None else (encoding, 0, path.parent / named)


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


def orthonormal(what: str, direction: Any) -> np.ndarray:
    """The orthonormal directions (columns) nearest to those of a file, which are rounded there. Raises
    `ValueError`, which begins with `what`, if they are farther from that than by rounding."""
    columns = np.reshape(np.asarray(direction, float), (3, 3))
    if not np.allclose(columns.T @ columns, np.eye(3), rtol=0, atol=ROUNDED):
        raise ValueError(
            f"{what} must be orthogonal directions of length 1; got {np.round(columns.T, 4).tolist()}."
        )
    left, _, right = np.linalg.svd(columns)
    return left @ right


def toward_axes(data: np.ndarray, spacing: Any, origin: Any, direction: Any) -> dict[str, Any]:
    """Arguments of `Volume` for `data[i, j, k]` whose axes point along the columns of `direction`.

    Axes are exchanged and reversed so that x, y and z of the result increase along the world's as nearly as
    they can; what is left is its `direction`, which is missing if it is none. No voxel is interpolated.
    """
    matrix = np.reshape(np.asarray(direction, float), (3, 3))
    # the axis of the data that is nearest to each axis of the world, all three at once
    order = max(map(list, itertools.permutations(range(3))), key=lambda p: np.abs(matrix[range(3), p]).sum())
    matrix, steps = matrix[:, order], np.asarray(spacing, float)[order]
    signs = np.where(np.diag(matrix) >= 0, 1, -1)
    turned = np.transpose(data, order)
    last = np.where(signs < 0, np.array(turned.shape) - 1, 0)
    arguments: dict[str, Any] = {
        "data": np.ascontiguousarray(turned[tuple(slice(None, None, sign) for sign in signs)]),
        "spacing": steps,
        "origin": np.asarray(origin, float) + matrix @ (steps * last),
    }
    if not np.allclose(matrix * signs, np.eye(3), rtol=0, atol=ALONG_AXES):
        arguments["direction"] = matrix * signs
    return arguments
