"""Which volume is in a medical image, along the axes of the patient? SimpleITK reads it.

MetaImage without compression and NRRD are left to SimpleITK, which takes what their header says.
"""

import gzip
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from .._util.files import MOST_VOXELS, Header, as_array, check_size, chunks, decoding, file_size


def read_medical(path: Path, header: Header) -> dict[str, Any]:
    """Reader of `.nii`, `.nii.gz`, `.mha`, `.mhd` and `.nrrd`."""
    header.refuse(path)
    held = file_size(path)
    try:
        import SimpleITK as sitk
    except ImportError as fault:
        raise ImportError(f"{path} needs SimpleITK to be read: pip install jaxvol[io]") from fault
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    with decoding(path):
        reader.ReadImageInformation()
        size, parts = reader.GetSize(), reader.GetNumberOfComponents()
        if len(size) != 3 or parts != 1 or not 0 < math.prod(size) <= MOST_VOXELS:
            raise ValueError(
                f"path: {path} must be a 3-D image of one value a voxel and fewer than 2**31 voxels; "
                f"got size {size} and {parts} values a voxel."
            )
        # ITK returns garbage, and no error, for NIfTI cut short and for MetaImage that fails to inflate
        if path.name.lower().endswith((".nii", ".nii.gz")):
            _check_nifti(path, reader, held)
        image = _inflated_metaimage(path, reader) or reader.Execute()
    image = sitk.DICOMOrient(image, "LPS")
    direction = np.reshape(image.GetDirection(), (3, 3))
    if not np.allclose(direction, np.eye(3), rtol=0, atol=1e-3):
        raise ValueError(
            f"path: {path} is oblique, which is not supported: its axes, turned as near to LPS as they go, "
            f"are {direction.round(3).tolist()}. Resample it on a grid along the patient's axes."
        )
    # a copy: the view dies with the image
    data = np.array(sitk.GetArrayViewFromImage(image).T, order="C")
    if data.dtype == np.float64:
        data = data.astype(np.float32)
    return {"data": data, "spacing": image.GetSpacing(), "origin": image.GetOrigin()}


def _check_nifti(path: Path, reader: Any, held: int) -> None:
    voxels = math.prod(reader.GetSize()) * int(reader.GetMetaData("bitpix")) // 8
    expected = int(float(reader.GetMetaData("vox_offset"))) + voxels
    if path.name.lower().endswith(".gz"):
        with gzip.open(path) as stream:
            held = sum(map(len, chunks(stream, expected + 1)))
    check_size(path, min(held, expected), expected)  # NIfTI may be followed by other data


def _inflated_metaimage(path: Path, reader: Any) -> Any | None:
    """The image of a compressed MetaImage; None for every other file.

    Its header may say how many compressed bytes there are. ITK believes that and leaves the rest of
    the volume unset where it is too few; here the compressed stream itself says where it ends.
    """
    import SimpleITK as sitk

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
    content = zlib.decompressobj(wbits=47).decompress(packed, expected + 1)  # 47: a zlib or a gzip header
    check_size(path, len(content), expected)
    array = as_array(content, reader.GetSize()[::-1], voxel.newbyteorder(">" if msb else "<"), "C")
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(reader.GetSpacing())
    image.SetOrigin(reader.GetOrigin())
    image.SetDirection(reader.GetDirection())
    return image
