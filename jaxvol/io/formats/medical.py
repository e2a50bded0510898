"""Reads NIfTI and NRRD images with SimpleITK.

SimpleITK takes memory as headers say, and returns garbage for some files that are cut short. So the size of
the content is compared with the header before it reads any.
"""

import gzip
import math
from pathlib import Path
from typing import Any

from ..._util.files import MOST_VOXELS, check_size, decoding, file_size
from .orientation import toward_axes


NIFTI_HEADERS = {348, 540}
"""Bytes of a header, of NIfTI-1 and NIfTI-2."""

LONGEST_LINE, MOST_FIELDS = 2**16, 2**10
"""Of a header in text. A file that has more is corrupt."""


def simple_itk(path: Path) -> Any:
    """The module SimpleITK. **Raises** `ImportError` that says what to install for `path`."""
    try:
        import SimpleITK  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"{path} needs SimpleITK: pip install jaxvol[io]") from fault
    return SimpleITK


def read_nifti(path: Path) -> dict[str, Any]:
    """Reader for `.nii` and `.nii.gz`."""
    file_size(path)
    sitk = simple_itk(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NiftiImageIO")
    packed = path.name.lower().endswith(".gz")
    with decoding(path), gzip.open(path) if packed else path.open("rb") as stream:
        begin = stream.read(4)  # of other files, ITK's library prints text of its own
        if not {int.from_bytes(begin, order) for order in ("little", "big")} & NIFTI_HEADERS:
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
        return _volume(sitk, reader)


def read_nrrd(path: Path) -> dict[str, Any]:
    """Reader for `.nrrd` and `.nhdr`."""
    file_size(path)
    sitk = simple_itk(path)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("NrrdImageIO")
    with decoding(path):
        voxels = _read_header(path, reader)
        itemsize = sitk.Image([1, 1, 1], reader.GetPixelIDValue()).GetSizeOfPixelComponent()
        fields, begin, source = _nrrd_header(path)
        encoding, expected = fields.get("encoding", "").lower(), voxels * itemsize
        if encoding not in ("raw", "gzip", "gz") or not source.is_file():
            raise ValueError(
                f"path: {path} must hold its voxels, or name one file of them, in the encoding raw or gzip; "
                f"got {encoding!r} and {fields.get('datafile')!r}."
            )
        with source.open("rb") as stream:
            stream.seek(begin)
            packed = encoding != "raw"
            held = gzip.GzipFile(fileobj=stream).seek(expected) if packed else source.stat().st_size - begin
        check_size(path, held, expected, more=True)
        return _volume(sitk, reader)


def _read_header(path: Path, reader: Any) -> int:
    """Read the header of an image, which must be one of a volume. **Returns** the number of its voxels."""
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    size, channels = reader.GetSize(), reader.GetNumberOfComponents()
    if len(size) != 3 or channels != 1 or not 0 < math.prod(size) <= MOST_VOXELS:
        raise ValueError(
            f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; got size "
            f"{size} and {channels} values per voxel."
        )
    return math.prod(size)


def _volume(sitk: Any, reader: Any) -> dict[str, Any]:
    image = reader.Execute()
    data = sitk.GetArrayFromImage(image).T
    return toward_axes(data, image.GetSpacing(), image.GetOrigin(), image.GetDirection())


def nrrd_data(path: Path) -> Path:
    """The file that holds the voxels of an NRRD file: itself, or another, which may be missing."""
    return _nrrd_header(path)[2]


def _nrrd_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of an NRRD header; where the voxels begin, and in which file."""
    found, end = text_header(path, ":")
    fields = {key.lower().replace(" ", ""): value for key, value in found.items()}
    named = fields.get("datafile")
    return (fields, end, path) if named is None else (fields, 0, path.parent / named)


def text_header(path: Path, separator: str, last: str = "") -> tuple[dict[str, str], int]:
    """The fields of a header in text, and where in the file it ends: at an empty line, or behind the field
    `last`."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while last not in fields and len(fields) < MOST_FIELDS:
            line = stream.readline(LONGEST_LINE).decode("latin-1").strip()
            if not line:
                break
            key, _, value = line.partition(separator)
            fields[key.strip()] = value.strip()
        return fields, stream.tell()
