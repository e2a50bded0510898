"""Reads arrays with named axes and coordinates, as xarray has them."""

from typing import Any

import numpy as np


UNEVEN = 1e-3
"""How far a coordinate may be from evenly spaced ones, in steps: coordinates in files are often rounded."""


def is_named(value: Any) -> bool:
    """Whether a value is an array with named axes, like xarray's `DataArray`; xarray is not imported."""
    return all(hasattr(value, name) for name in ("dims", "coords", "transpose", "to_numpy"))


def along_xyz(value: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The values as data[x, y, z], and `spacing` and `origin` where coordinates tell them.

    Axes named x, y and z, in any order, are put in this one; others are taken as they come. Coordinates that
    fall are reversed, with the data. Axes without coordinates have spacing 1 from 0 on.

    **Raises:** `ValueError` for coordinates that are not evenly spaced numbers.
    """
    names = [str(name).lower() for name in value.dims]
    if sorted(names) == ["x", "y", "z"]:
        value = value.transpose(*(value.dims[names.index(name)] for name in "xyz"))
    data, spacing, origin = value.to_numpy(), np.ones(3), np.zeros(3)
    if data.ndim != 3 or not any(name in value.coords for name in value.dims):
        return data, {}
    for axis, name in enumerate(value.dims):
        if name not in value.coords:
            continue
        at = np.asarray(value.coords[name])
        if at.dtype.kind not in "iuf" or at.size < 2:
            raise ValueError(
                f"data has coordinates {name!r} that are not numbers; got {at.dtype}. Drop them."
            )
        at = at.astype(np.float64)
        step = (at[-1] - at[0]) / (at.size - 1)
        away = np.abs(at - np.linspace(at[0], at[-1], at.size)).max()
        if not (abs(step) > 0 and away <= UNEVEN * abs(step)):  # NaN, too
            raise ValueError(
                f"data must have evenly spaced coordinates; got {name!r} from {at[0]:g} to {at[-1]:g}, up to "
                f"{away:.3g} away from even ones. Interpolate to even ones first (DataArray.interp)."
            )
        if step < 0:
            data, at = np.flip(data, axis), at[::-1]
        spacing[axis], origin[axis] = abs(step), at[0]
    return data, {"spacing": spacing, "origin": origin}
