"""Reads NIfTI and NRRD images with SimpleITK, as volumes along the axes of the patient, or askew to them.

SimpleITK takes memory as headers say, and returns garbage for some files that are cut short. So the size of
the content is compared with the header before it reads any.
"""

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.files import MOST_VOXELS, Header, check_size, chunks, decoding, file_size
from .orientation import toward_axes


SIZES = {348, 540}
"""Bytes of a header, of NIfTI-1 and NIfTI-2."""

LONGEST_LINE, MOST_FIELDS = 2**16, 2**10
"""Of a header in text. It is at most one of corrupt files that has more."""


def simple_itk(path: Path) -> Any:
    """The module SimpleITK. **Raises** `ImportError` that says what to install for reading `path`."""
    try:
        import SimpleITK  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"reading {path} needs SimpleITK: pip install jaxvol[io]") from fault
    return SimpleITK


def read_medical(path: Path, header: Header) -> dict[str, Any]:
    """Reader for `.nii`, `.nii.gz`, `.nrrd` and `.nhdr`."""
    header.refuse(path)
    n_bytes = file_size(path)
    sitk = simple_itk(path)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    name = path.name.lower()
    kind = "Nifti" if name.endswith((".nii", ".nii.gz")) else "Nrrd"
    reader.SetImageIO(f"{kind}ImageIO")
    with decoding(path):
        if kind == "Nifti":
            _check_header(path)
        reader.ReadImageInformation()
        size, parts = reader.GetSize(), reader.GetNumberOfComponents()
        if len(size) != 3 or parts != 1 or not 0 < math.prod(size) <= MOST_VOXELS:
            raise ValueError(
                f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; "
                f"got size {size} and {parts} values per voxel."
            )
        if kind == "Nifti":
            _check_nifti(path, reader, n_bytes)
        else:
            _check_nrrd(path, math.prod(size), _voxel_type(reader).itemsize)
        image = reader.Execute()
    # copied by this, since the view is invalid once the image is freed
    data = np.array(sitk.GetArrayViewFromImage(image).T)
    if data.dtype == np.float64:
        data = data.astype(np.float32)
    return toward_axes(data, image.GetSpacing(), image.GetOrigin(), image.GetDirection())


def _check_header(path: Path) -> None:
    """**Raises** `ValueError` for what has no NIfTI header. Of that, ITK's library prints text of its own."""
    with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as stream:
        begin = stream.read(4)
    if not {int.from_bytes(begin, order) for order in ("little", "big")} & SIZES:
        raise ValueError(
            f"path: {path} cannot be read: a NIfTI file begins with the size of its header, 348 or 540; this "
            f"one with the bytes {begin.hex(' ')}. Fetch or write it again."
        )


def _check_nifti(path: Path, reader: Any, n_bytes: int) -> None:
    voxels = math.prod(reader.GetSize()) * int(reader.GetMetaData("bitpix")) // 8
    expected = int(float(reader.GetMetaData("vox_offset"))) + voxels
    if path.name.lower().endswith(".gz"):
        with gzip.open(path) as stream:
            n_bytes = sum(map(len, chunks(stream, expected + 1)))
    check_size(path, min(n_bytes, expected), expected)  # other data may follow the voxels


def _check_nrrd(path: Path, voxels: int, itemsize: int) -> None:
    """**Raises** `ValueError` if less follows the header of an NRRD file than it says."""
    fields, begin, source = _nrrd_header(path)
    if not source.is_file():
        raise ValueError(
            f"path: {path} must hold its voxels, or name one file of them; got {fields['datafile']!r}."
        )
    expected, encoding = voxels * itemsize, fields.get("encoding", "").lower()
    with source.open("rb") as stream:
        stream.seek(begin)
        if encoding in ("gzip", "gz"):
            with gzip.GzipFile(fileobj=stream) as inflated:
                held = sum(map(len, chunks(inflated, expected)))
        elif encoding == "raw":
            held = source.stat().st_size - begin
        elif encoding in ("ascii", "text", "txt"):  # at least a digit and a space for each
            held = (source.stat().st_size - begin + 1) // 2 * itemsize
        else:
            raise ValueError(
                f"path: {path} must have the encoding raw, gzip or ascii; got {encoding!r}. Save it "
                "as one of these."
            )
    check_size(path, min(held, expected), expected)


def nrrd_data(path: Path) -> Path:
    """The file that holds the voxels of an NRRD file: itself, or another, which may be missing."""
    return _nrrd_header(path)[2]


def _nrrd_header(path: Path) -> tuple[dict[str, str], int, Path]:
    """The fields of an NRRD header; where the voxels begin, and in which file."""
    fields: dict[str, str] = {}
    with path.open("rb") as stream:
        while (line := stream.readline(LONGEST_LINE).strip()) and len(fields) < MOST_FIELDS:
            key, _, value = line.decode("latin-1").partition(":")
            fields[key.strip().lower().replace(" ", "")] = value.strip()
        named = fields.get("datafile")
        return (fields, stream.tell(), path) if named is None else (fields, 0, path.parent / named)


def _voxel_type(reader: Any) -> np.dtype:
    sitk = simple_itk(Path(reader.GetFileName()))
    return sitk.GetArrayViewFromImage(sitk.Image([1, 1, 1], reader.GetPixelIDValue())).dtype
