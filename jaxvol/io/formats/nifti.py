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
    refusing,
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
    with refusing(path):
        with nibabel.imageglobals.ErrorLevel(31):  # what it would mend
            image: Any = nibabel.load(path)
        proxy, header, stored, shape = image.dataobj, image.header, image.get_data_dtype(), image.shape
        holder, raw = image.file_map.get("header", image.file_map["image"]).filename, header
        if "pixdim" in header:  # as it is in the file
            with nibabel.openers.ImageOpener(holder) as stream:
                raw = type(header).from_fileobj(stream, check=False)
    body, in_sform = (
        Path(image.file_map["image"].filename),
        "sform_code" in header and header["sform_code"] > 0,
    )
    pixdim = np.ones(3) if in_sform or "pixdim" not in header else raw["pixdim"][1:4]
    offset = raw["vox_offset"] if "vox_offset" in header else 0
    whole = "header" in image.file_map or "magic" not in header or raw["magic"].tolist()[:2] == b"n+"
    for name, holds, expected in (
        ("pixdim", np.all(pixdim > 0) and np.all(np.isfinite(pixdim)), "positive lengths"),
        ("vox_offset", 0 <= offset < 2**31, "the byte at which voxels begin"),
        ("magic", whole, "n+1 or n+2, of voxels in the same file"),
        ("datatype", stored.kind in "iuf" or stored.names, "that of integers, floats, RGB or RGBA"),
    ):
        if not holds:  # also of NaN
            raise ValueError(f"path: {path}: {name} must be {expected}; got {raw[name].tolist()!r}.")
    while len(shape) > 5 and shape[-1] == 1:
        shape = shape[:-1]
    check_volume(path, shape, len(stored.names or "1"))
    expected, packed = math.prod(shape) * stored.itemsize, body.name.lower().endswith((".gz", ".mgz"))
    if not hasattr(proxy, "offset"):  # MINC, in chunks
        check_size(path, file_size(body) * MOST_COMPRESSED, expected, more=True)
        with refusing(path):
            return nibabel_record(image, np.asanyarray(proxy), f"path: {path}")
    if not packed:
        check_size(path, max(file_size(body) - proxy.offset, 0), expected, more=True)
    with decoding(body), gzip.open(body) if packed else body.open("rb") as stream:
        stream.seek(proxy.offset)
        content = read_all(path, stream, expected, more=True)
    return nibabel_record(image, as_array(content, shape[::-1], stored, "C").T, f"path: {path}")


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
