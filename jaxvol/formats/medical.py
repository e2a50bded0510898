"""Reads medical images with SimpleITK, as volumes along the axes of the patient, or askew to them.

Uncompressed MetaImage and NRRD files are left to SimpleITK, which trusts their headers.
"""

import gzip
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .._util.files import MOST_VOXELS, Header, as_array, check_size, chunks, decoding, file_size
from .orientation import toward_axes


def simple_itk(path: Path) -> Any:
    """The module SimpleITK. **Raises** `ImportError` that says what to install for reading `path`."""
    try:
        import SimpleITK  # pyright: ignore[reportMissingImports]
    except ImportError as fault:
        raise ImportError(f"reading {path} needs SimpleITK: pip install jaxvol[io]") from fault
    return SimpleITK


def read_medical(path: Path, header: Header) -> dict[str, Any]:
    """Reader for `.nii`, `.nii.gz`, `.mha`, `.mhd` and `.nrrd`."""
    header.refuse(path)
    n_bytes = file_size(path)
    sitk = simple_itk(path)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    with decoding(path):
        reader.ReadImageInformation()
        size, parts = reader.GetSize(), reader.GetNumberOfComponents()
        if len(size) != 3 or parts != 1 or not 0 < math.prod(size) <= MOST_VOXELS:
            raise ValueError(
                f"path: {path} must be a 3-D image of one value per voxel and fewer than 2**31 voxels; "
                f"got size {size} and {parts} values per voxel."
            )
        # for truncated NIfTI and for MetaImage that fails to inflate, ITK returns garbage without an error
        if path.name.lower().endswith((".nii", ".nii.gz")):
            _check_nifti(path, reader, n_bytes)
        image = _inflated_metaimage(path, reader) or reader.Execute()
    # copied by this, since the view is invalid once the image is freed
    data = np.array(sitk.GetArrayViewFromImage(image).T)
    if data.dtype == np.float64:
        data = data.astype(np.float32)
    return toward_axes(data, image.GetSpacing(), image.GetOrigin(), image.GetDirection())


def _check_nifti(path: Path, reader: Any, n_bytes: int) -> None:
    voxels = math.prod(reader.GetSize()) * int(reader.GetMetaData("bitpix")) // 8
    expected = int(float(reader.GetMetaData("vox_offset"))) + voxels
    if path.name.lower().endswith(".gz"):
        with gzip.open(path) as stream:
            n_bytes = sum(map(len, chunks(stream, expected + 1)))
    check_size(path, min(n_bytes, expected), expected)  # other data may follow the voxels


def _inflated_metaimage(path: Path, reader: Any) -> Any | None:
    """The image in a compressed MetaImage; None for any other file.

    The header may state the number of compressed bytes. If that is too small, ITK still trusts it and leaves
    the rest of the volume unset; here the end is that of the compressed stream itself.
    """
    import SimpleITK as sitk  # pyright: ignore[reportMissingImports]

    fields: dict[str, str] = {}
    if not path.name.lower().endswith((".mha", ".mhd")):
        return None
    with path.open("rb") as stream:
        for line in stream:
            key, _, value = line.decode("latin-1").partition("=")
            fields[key.strip()] = value.strip()
            if "ElementDataFile" in fields:
                break
        if not fields.get("CompressedData", "").lower().startswith(("t", "1")):
            return None
        local = fields["ElementDataFile"].upper() == "LOCAL"
        packed = stream.read() if local else (path.parent / fields["ElementDataFile"]).read_bytes()
    msb = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "")).lower().startswith("t")
    voxel = sitk.GetArrayViewFromImage(sitk.Image([1, 1, 1], reader.GetPixelIDValue())).dtype
    expected = math.prod(reader.GetSize()) * voxel.itemsize
    content = zlib.decompressobj(wbits=47).decompress(packed, expected + 1)  # 47: a zlib or gzip header
    check_size(path, len(content), expected)
    array = as_array(content, reader.GetSize()[::-1], voxel.newbyteorder(">" if msb else "<"), "C")
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(reader.GetSpacing())
    image.SetOrigin(reader.GetOrigin())
    image.SetDirection(reader.GetDirection())
    return image
