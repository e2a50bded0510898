"""Reads data sets of HDF5 files with h5py, and NetCDF with xarray: `file.h5::/path`, `file.nc::name`."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import shortened
from ..._util.files import MOST_COMPRESSED, check_size, file_size, library, reason
from ..._util.image_record import ImageRecord
from ..._util.named_axes import cf_scale, record_of


ENDINGS = (".h5", ".hdf5", ".hdf", ".he5", ".ims")
NETCDF = (".nc", ".nc4", ".cdf", ".netcdf")


def read_hdf5(path: Path, name: str | None = None) -> ImageRecord:
    """Reader for a data set, or the only one of three axes or more. Names of axes are those of its dimensions
    (scales or labels); a scale's numbers, or the attribute `element_size_um` (z, y, x), are the distances."""
    h5py = library("h5py", path)
    file_size(path)
    try:
        file = h5py.File(path, "r")
        found: dict[str, Any] = {}
        if name is None:
            file.visititems(
                lambda key, item: found.update({key: item} if getattr(item, "ndim", 0) > 2 else {})
            )
        else:
            found = {name: file[name]}
        data = found[_only(path, list(found), name)]
        attributes = {key: data.attrs[key] for key in (*CF, "element_size_um") if key in data.attrs}
        scales = [dimension[0] if len(dimension) else None for dimension in data.dims]
        names = [
            (scale.name or "").rpartition("/")[2] if scale is not None else dimension.label
            for dimension, scale in zip(data.dims, scales, strict=True)
        ]
        shape, stored = data.shape, data.dtype
        if (
            data.external
            or getattr(data, "is_virtual", False)
            or stored.kind not in "biuf"
            or not 2 < len(shape) < 6
        ):
            raise ValueError(
                f"{data.name} must be numbers of 3 to 5 axes in the same file; got {stored} {shape}"
            )
        check_size(path, path.stat().st_size * MOST_COMPRESSED, math.prod(shape) * stored.itemsize, more=True)
        if data.chunks and math.prod(data.chunks) * stored.itemsize > max(
            2**26, 8 * data.size * stored.itemsize
        ):
            raise ValueError(f"{data.name} has chunks of {data.chunks} for an array of {shape}")
        names = names if all(names) else ["t", "c", "z", "y", "x"][-len(shape) :]
        record = ImageRecord(data, names, what=f"path: {path}", **cf_scale(attributes))
        for letter, scale in zip(record.letters(), scales, strict=True):
            if scale is not None and letter in "xyz" and scale.ndim == 1 and 1 < scale.size < 2**20:
                at = np.asarray(scale[:], float)
                if np.abs(at - np.linspace(at[0], at[-1], at.size)).max() > 1e-3 * abs(at[1] - at[0]):
                    raise ValueError(f"{scale.name} must be evenly spaced")
                record.steps = {**record.steps, letter: float(at[1] - at[0])}
                record.origin = np.where(np.array([*"xyz"]) == letter, at[0], record.origin)
                unit = scale.attrs.get("units")
                record.units = {
                    **(record.units or {}),
                    letter: unit.decode() if isinstance(unit, bytes) else unit,
                }
        sizes = np.ravel(attributes.get("element_size_um", ()))
        if sizes.size == 3 and not record.steps:
            record.steps, record.units = dict(zip("zyx", map(float, sizes), strict=True)), "um"
        return record
    except Exception as fault:  # of many kinds
        told = (
            str(fault) if str(fault).startswith("path:") else f"path: {path} cannot be read: {reason(fault)}."
        )
        raise ValueError(told) from fault


CF = "scale_factor", "add_offset", "_FillValue", "missing_value"


def read_netcdf(path: Path, name: str | None = None) -> ImageRecord:
    """Reader for a variable, or the only one of three axes or more, as xarray describes it."""
    xarray = library("xarray", path)
    size = file_size(path)
    with path.open("rb") as stream:
        engine: Any = "scipy" if stream.read(3) == b"CDF" else "h5netcdf"
    try:
        with xarray.open_dataset(path, engine=engine, mask_and_scale=False, decode_times=False) as opened:
            found = [str(key) for key, variable in opened.data_vars.items() if variable.ndim > 2]
            variable = opened[_only(path, found if name is None else [name.strip("/")], name)]
            check_size(path, size * MOST_COMPRESSED, variable.nbytes, more=True)
            record = record_of(variable.load())
    except Exception as fault:  # of many kinds
        if isinstance(fault, ImportError):
            raise ImportError(f"{path} needs h5netcdf: pip install 'jaxvol[io]' ({fault})") from fault
        told = (
            str(fault) if str(fault).startswith("path:") else f"path: {path} cannot be read: {reason(fault)}."
        )
        raise ValueError(told) from fault
    assert record is not None
    record.what = f"path: {path}"
    return record


def _only(path: Path, names: list[str], name: str | None) -> str:
    """The name of the data set, where there is one."""
    if len(names) != 1:
        told = f"holds {shortened(', '.join(names))}" if names else "holds no array of three axes or more"
        raise ValueError(f"path: {path} {told}: name one, as in {path.name}::/name.")
    return names[0]
