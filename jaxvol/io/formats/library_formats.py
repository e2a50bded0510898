"""Readers by nibabel (NIfTI, Analyze, MGH, MINC), mrcfile (MRC, CCP4) and xarray (HDF5, NetCDF)."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import shortened
from ..._util.files import MOST_COMPRESSED, Refused, check, check_size, file_size, library
from ..._util.image_record import ImageRecord
from ..._util.named_axes import fields_of, nibabel_record, record_of
from .arrays import check_volume, read_voxels


NIFTI = (".nii", ".nii.gz", ".hdr", ".img", ".mgh", ".mgz", ".mnc")
MRC = (".mrc", ".map", ".ccp4", ".rec")
HDF5 = (".h5", ".hdf5", ".hdf", ".he5", ".nc", ".nc4", ".cdf")

LARGE, BEYOND = 2**26, 8  # maximum size of a chunk: in bytes, or if larger, relative to its array


def read_nifti(path: Path) -> ImageRecord:
    """Reader by nibabel: placed by a NIfTI's sform, if its code is positive, else its qform, else `pixdim`
    along the file's axes. Voxels are read here, since nibabel allocates memory by unchecked headers."""
    nibabel = library("nibabel", path)
    with nibabel.imageglobals.ErrorLevel(31):  # no error for faults that nibabel repairs
        image: Any = nibabel.load(path)
    proxy, header, stored = image.dataobj, image.header, image.get_data_dtype()
    shape = tuple(map(int, image.shape))
    files, raw, fields = image.file_map, header, fields_of(header)
    if "pixdim" in fields:  # without nibabel's repairs
        with nibabel.openers.ImageOpener(files.get("header", files["image"]).filename) as stream:
            raw = type(header).from_fileobj(stream, check=False)
    in_sform = "sform_code" in fields and header["sform_code"] > 0
    pixdim = np.ones(3) if in_sform or "pixdim" not in fields else raw["pixdim"][1:4]
    offset = raw["vox_offset"] if "vox_offset" in fields else 0
    is_one_file = "header" in files or "magic" not in fields or raw["magic"].tolist()[:2] == b"n+"
    for name, holds, expected in (
        ("pixdim", np.all(pixdim > 0) and np.all(np.isfinite(pixdim)), "positive lengths"),
        ("vox_offset", 0 <= offset < 2**31, "the byte at which voxels begin"),
        ("magic", is_one_file, "n+1 or n+2, of voxels in the same file"),
        ("datatype", stored.kind in "iuf" or stored.names, "that of integers, floats, RGB or RGBA"),
    ):
        if not holds:  # also for NaN
            raise Refused(f": {name} must be {expected}; got {raw[name].tolist()!r}.")
    while len(shape) > 5 and shape[-1] == 1:
        shape = shape[:-1]
    check_volume(shape, len(stored.names or "1"))
    body = Path(files["image"].filename)
    if not hasattr(proxy, "offset"):  # MINC, in chunks
        check_size(file_size(body) * MOST_COMPRESSED, math.prod(shape) * stored.itemsize, more=True)
        return nibabel_record(image, np.asanyarray(proxy))
    packed = "gzip" if body.name.lower().endswith((".gz", ".mgz")) else ""
    return nibabel_record(image, read_voxels(body, shape[::-1], stored, proxy.offset, packed).T)


def read_mrc(path: Path) -> ImageRecord:
    """Reader of MRC and CCP4, in ångström; placed by `origin`, or by the first column, row and section."""
    with path.open("rb") as stream:
        size, extended = file_size(path), stream.read(96)[92:]
    longest = min(int.from_bytes(extended, order) for order in ("little", "big"))
    check(longest <= size, "is cut short before the end of its header.")  # mrcfile would allocate it
    file: Any = library("mrcfile", path).mmap(path, permissive=True)
    header, data = file.header, np.asanyarray(file.data)
    if data.ndim not in (3, 4) or data.dtype.kind not in "iuf":
        raise ValueError("cut short, or no 3-D image of numbers")
    order = [int(header[name]) for name in ("maps", "mapr", "mapc")]
    order = order if sorted(order) == [1, 2, 3] else [3, 2, 1]
    axes = "t" * (data.ndim - 3) + "".join("xyz"[number - 1] for number in order)
    sizes = {a: (float(header.cella[a]), int(header[f"m{a}"])) for a in "xyz"}
    steps = {a: length / n for a, (length, n) in sizes.items() if length > 0 and n > 0}
    origin = np.array([float(header.origin[a]) for a in "xyz"])
    if not np.any(origin):
        starts = dict(zip(axes[-3:], (int(header[f"n{a}start"]) for a in "zyx"), strict=True))
        origin = np.array([starts[a] * steps.get(a, 1.0) for a in "xyz"])
    return ImageRecord(data, axes, steps, "angstrom" if steps else None, origin)


def read_hdf5(path: Path, name: str | None = None) -> ImageRecord:
    """Reader of an array, by default of the only one with three axes or more. Axes without names are z, y, x.
    The attribute `element_size_um` (z, y, x) holds distances."""
    xarray = library("xarray", path)
    options: dict[str, Any] = {"mask_and_scale": False, "decode_times": False, "cache": False}
    with path.open("rb") as stream:
        is_classic = stream.read(3) == b"CDF"
    if is_classic:
        groups = {"/": xarray.open_dataset(io.BytesIO(path.read_bytes()), engine="scipy", **options)}
    else:
        library("h5netcdf", path)
        library("h5py", path).File(path, "r").close()  # for other files, h5netcdf prints a traceback
        groups = xarray.open_groups(path, engine="h5netcdf", phony_dims="access", **options)
    arrays = {f"{g.rstrip('/')}/{key}": array for g, group in groups.items() for key, array in group.items()}
    matches = [key for key, array in arrays.items() if array.ndim > 2 and name in (None, key, key[1:])]
    names = shortened(", ".join(arrays)) if arrays else "none"
    check(len(matches) == 1, f"holds the arrays {names}: name one, as in {path.name}::/name.")
    array = arrays[matches[0]]
    check_size(file_size(path) * MOST_COMPRESSED, array.nbytes, more=True)
    chunk = math.prod(array.encoding.get("chunksizes") or (1,)) * array.dtype.itemsize
    is_read = chunk <= max(LARGE, BEYOND * array.nbytes) and array.dtype.kind in "biuf"
    check(is_read, f": {matches[0]} must be numbers in chunks; got {array.dtype}, {chunk} bytes.")
    labels = [str(label) for label in array.attrs.get("DIMENSION_LABELS", ())]
    if all(labels) and len({*labels}) == array.ndim:
        array = array.rename(dict(zip(array.dims, labels, strict=True)))
    if unnamed := [n for n in array.dims if str(n).startswith("phony_dim")]:
        array = array.rename(dict(zip(unnamed, "tczyx"[-len(unnamed) :], strict=True)))
    record: Any = record_of(array)
    sizes = np.ravel(array.attrs.get("element_size_um", ()))
    if sizes.size == 3 and not record.steps:
        record.steps, record.units = dict(zip("zyx", map(float, sizes), strict=True)), "um"
    return record
