"""Reads NIfTI and NRRD images with SimpleITK.

SimpleITK takes memory as headers say, and returns garbage for some files that are cut short. So the size of
the content is compared with the header before it reads any.
"""

import gzip
import math
from pathlib import Path
from typing import Any

from ..._util.files import MOST_VOXELS, Header, check_size, chunks, decoding, file_size
from .orientation import toward_axes


NIFTI = (".nii", ".nii.gz")

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


def read_medical(path: Path, header: Header) -> dict[str, Any]:
    """Reader for `.nii`, `.nii.gz`, `.nrrd` and `.nhdr`."""
    header.refuse(path)
    file_size(path)
    sitk = simple_itk(path)
    nifti = path.name.lower().endswith(NIFTI)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("NiftiImageIO" if nifti else "NrrdImageIO")
    with decoding(path):
        if nifti:
            _check_begin(path)
        reader.ReadImageInformation()
        size, channels = reader.GetSize(), reader.GetNumberOfComponents()
        if len(size) != 3 or channels != 1 or not 0 < math.prod(size) <= MOST_VOXELS:
            raise ValueError(
                f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; "
                f"got size {size} and {channels} values per voxel."
            )
        if nifti:
            _check_nifti(path, reader)
        else:
            itemsize = sitk.Image([1, 1, 1], reader.GetPixelIDValue()).GetSizeOfPixelComponent()
            _check_nrrd(path, math.prod(size), itemsize)
        image = reader.Execute()
    data = sitk.GetArrayFromImage(image).T
    return toward_axes(data, image.GetSpacing(), image.GetOrigin(), image.GetDirection())


def _check_begin(path: Path) -> None:
    """**Raises** `ValueError` for what has no NIfTI header, about which ITK's library prints its own text."""
    with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as stream:
        begin = stream.read(4)
    if not {int.from_bytes(begin, order) for order in ("little", "big")} & NIFTI_HEADERS:
        raise ValueError(
            f"path: {path} cannot be read: a NIfTI file begins with the size of its header, 348 or 540; this "
            f"one with the bytes {begin.hex(' ')}. Fetch or write it again."
        )


def _check_nifti(path: Path, reader: Any) -> None:
    voxels = math.prod(reader.GetSize()) * int(reader.GetMetaData("bitpix")) // 8
    expected = int(float(reader.GetMetaData("vox_offset"))) + voxels
    if path.name.lower().endswith(".gz"):
        with gzip.open(path) as stream:
            held = sum(map(len, chunks(stream, expected)))
    else:
        held = path.stat().st_size
    check_size(path, min(held, expected), expected)  # other data may follow the voxels


def _check_nrrd(path: Path, voxels: int, itemsize: int) -> None:
    fields, begin, source = _nrrd_header(path)
    if not source.is_file():
        raise ValueError(
            f"path: {path} must hold its voxels, or name one file of them; got {fields['datafile']!r}."
        )
    expected, encoding = voxels * itemsize, fields.get("encoding", "").lower()
    held = source.stat().st_size - begin
    if encoding in ("ascii", "text", "txt"):  # at least a digit and a space for each
        held = (held + 1) // 2 * itemsize
    elif encoding in ("gzip", "gz"):
        with source.open("rb") as stream:
            stream.seek(begin)
            held = sum(map(len, chunks(gzip.GzipFile(fileobj=stream), expected)))
    elif encoding != "raw":
        raise ValueError(
            f"path: {path} must have the encoding raw, gzip or ascii; got {encoding!r}. Save it as one of "
            "these."
        )
    check_size(path, min(held, expected), expected)


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
