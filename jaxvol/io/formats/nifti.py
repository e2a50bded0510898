"""Reads NIfTI, Analyze, MGH and MINC images with nibabel, as it places them. Writes NIfTI-1, in whose sform
shears are kept, which SimpleITK removes."""

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.affine import SHEARED
from ..._util.files import (
    MOST_COMPRESSED,
    as_array,
    check_size,
    decoding,
    file_size,
    library,
    read_all,
    reason,
)
from ..._util.image_record import ImageRecord
from ..._util.named_axes import nibabel_record
from .text_headers import check_volume


ENDINGS = (".nii", ".nii.gz", ".hdr", ".img", ".mgh", ".mgz", ".mnc")

TO_LPS = np.array([[-1.0], [-1.0], [1.0]])
"""NIfTI's world is right, front, head; ours left, back, head."""


def read_nifti(path: Path) -> ImageRecord:
    """Reader by nibabel. The sform of a NIfTI places voxels if its code is positive, with its scales and
    shears; else the qform, if its is; else `pixdim` is their spacing, along axes as in the file. Voxels are
    read here: nibabel takes memory as headers say."""
    file_size(path)
    nibabel = library("nibabel", path)
    try:
        with nibabel.imageglobals.ErrorLevel(31):  # what it would mend
            image: Any = nibabel.load(path)
        proxy, header, shape = image.dataobj, image.header, image.shape
        raw, holder = header, image.file_map.get("header", image.file_map["image"]).filename
        if "pixdim" in header:  # as it is in the file
            with nibabel.openers.ImageOpener(holder) as stream:
                raw = type(header).from_fileobj(stream, check=False)
    except Exception as fault:  # of many kinds
        told = "a NIfTI file begins with a header of 348 or 540 bytes, and these with that number"
        raise ValueError(f"path: {path} cannot be read: {reason(fault)} ({told}). Is it whole?") from fault

    def check(name: str, holds: Any, expected: str) -> None:
        if not holds:  # also of NaN
            raise ValueError(f"path: {path}: {name} must be {expected}; got {header[name].tolist()!r}.")

    pixdim = header["pixdim"][1:4].astype(float) if "pixdim" in header else np.ones(3)
    if "sform_code" not in header or header["sform_code"] <= 0:
        check("pixdim", np.all(pixdim > 0) and np.all(np.isfinite(pixdim)), "positive lengths")
    while len(shape) > 5 and shape[-1] == 1:
        shape = shape[:-1]
    body, stored = Path(image.file_map["image"].filename), header.get_data_dtype()
    channels = len(stored.names or "1")
    if stored.kind not in "iuf" and channels == 1:
        check("datatype", False, "one of integers, floats of up to 64 bits, RGB and RGBA")
    check_volume(path, shape, channels)
    expected, packed = math.prod(shape) * stored.itemsize, body.name.lower().endswith((".gz", ".mgz"))
    if not hasattr(proxy, "offset"):  # MINC, in chunks
        check_size(path, file_size(body) * MOST_COMPRESSED, expected, more=True)
        with decoding(path):
            data = np.asanyarray(proxy)
        return nibabel_record(image, data, f"path: {path}")
    if "vox_offset" in header:
        check(
            "vox_offset",
            0 <= header["vox_offset"] < 2**31,
            "the byte behind the header at which voxels begin",
        )
    with decoding(body), gzip.open(body) if packed else body.open("rb") as stream:
        if not packed:
            check_size(path, max(file_size(body) - proxy.offset, 0), expected, more=True)
        stream.seek(proxy.offset)
        content = read_all(path, stream, expected, more=True)
    data = as_array(content, shape[::-1], stored, "C").T
    return nibabel_record(image, data, f"path: {path}")


def write_nifti(path: Path, arrays: dict[str, np.ndarray], *, packed: bool) -> None:
    """Write a volume's arrays with an sform, and the same as a qform unless it is sheared, as no qform is."""
    data, spacing = arrays["data"], arrays["spacing"]
    if max(data.shape) >= 2**15:
        raise ValueError(f"path: NIfTI-1 holds fewer than 32768 voxels along an axis; got {data.shape}.")
    turn, affine = arrays.get("direction", np.eye(3)).astype(float), np.eye(4)
    affine[:3] = TO_LPS * np.column_stack([turn * spacing, arrays["origin"]])
    image = library("nibabel", path).Nifti1Image(data, affine)
    image.set_sform(affine, 1)
    if np.abs(turn.T @ turn - np.eye(3)).max() <= SHEARED:
        image.set_qform(affine, 1)
    image.header.set_xyzt_units("mm")
    content = image.to_bytes()
    path.write_bytes(gzip.compress(content, 6) if packed else content)
