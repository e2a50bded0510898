"""Reads arrays of HDF5 and NetCDF files with xarray: `file.h5::/path`, `file.nc::name`."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import shortened
from ..._util.files import MOST_COMPRESSED, check_size, file_size, library, refusing
from ..._util.image_record import ImageRecord
from ..._util.named_axes import record_of


ENDINGS = (".h5", ".hdf5", ".hdf", ".he5", ".nc", ".nc4", ".cdf")
LARGE, BEYOND = 2**26, 8  # bytes that a chunk may always have, and how many times those of its array


def read_hdf5(path: Path, name: str | None = None) -> ImageRecord:
    """Reader for an array, or the only one of three axes or more, as xarray describes it. Axes without names
    are z, y, x. The attribute `element_size_um` (z, y, x) holds distances."""
    size, xarray = file_size(path), library("xarray", path)
    with path.open("rb") as stream:
        classic = stream.read(3) == b"CDF"
    how: dict[str, Any] = {"mask_and_scale": False, "decode_times": False, "cache": False}
    with refusing(path):
        if classic:
            groups = {"/": xarray.open_dataset(io.BytesIO(path.read_bytes()), engine="scipy", **how)}
        else:
            library("h5netcdf", path)
            library("h5py", path).File(path, "r").close()  # of others, h5netcdf leaves a traceback
            groups = xarray.open_groups(path, engine="h5netcdf", phony_dims="access", **how)
        arrays = {
            f"{g.rstrip('/')}/{key}": each for g, group in groups.items() for key, each in group.items()
        }
        found = [key for key, each in arrays.items() if each.ndim > 2 and name in (None, key, key[1:])]
        if len(found) != 1:
            told = shortened(", ".join(arrays)) if arrays else "none"
            raise ValueError(f"path: {path} holds the arrays {told}: name one, as in {path.name}::/name.")
        array = arrays[found[0]]
        check_size(path, size * MOST_COMPRESSED, array.nbytes, more=True)
        chunk = math.prod(array.encoding.get("chunksizes") or (1,)) * array.dtype.itemsize
        if chunk > max(LARGE, BEYOND * array.nbytes) or array.dtype.kind not in "biuf":
            raise ValueError(
                f"path: {path}: {found[0]} must be numbers in chunks; got {array.dtype}, {chunk} bytes."
            )
        labels = [str(label) for label in array.attrs.get("DIMENSION_LABELS", ())]
        if all(labels) and len({*labels}) == array.ndim:
            array = array.rename(dict(zip(array.dims, labels, strict=True)))
        if unnamed := [n for n in array.dims if str(n).startswith("phony_dim")]:
            array = array.rename(dict(zip(unnamed, "tczyx"[-len(unnamed) :], strict=True)))
        record = record_of(array)
        assert record is not None
        sizes = np.ravel(array.attrs.get("element_size_um", ()))
        if sizes.size == 3 and not record.steps:
            record.steps, record.units = dict(zip("zyx", map(float, sizes), strict=True)), "um"
        record.what = f"path: {path}"
        return record
