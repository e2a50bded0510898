"""Reads arrays with named axes and coordinates, as xarray has them."""

from typing import Any

import numpy as np


def is_named(value: Any) -> bool:
    """Whether a value is an array with named axes, like xarray's `DataArray`; xarray is not imported."""
    return all(hasattr(value, name) for name in ("dims", "coords", "transpose", "to_numpy"))


def along_xyz(value: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The values as data[x, y, z], and `spacing` and `origin` where coordinates tell them.

    Axes named x, y and z, in any order, are put in this one; others are taken as they come. Coordinates that
    fall are reversed, with the data. Axes without coordinates have spacing 1 from 0 on.

    **Raises:** `ValueError` for coordinates that are not evenly spaced numbers.
    """
    if sorted(map(str, value.dims)) == ["x", "y", "z"]:
        value = value.transpose("x", "y", "z")
    data, spacing, origin = value.to_numpy(), np.ones(3), np.zeros(3)
    named = [(axis, name) for axis, name in enumerate(value.dims) if name in value.coords]
    if data.ndim != 3 or not named:
        return data, {}
    for axis, name in named:
        at = np.asarray(value.coords[name])
        even = np.linspace(at[0], at[-1], at.size) if at.dtype.kind in "iuf" else np.zeros(2)
        step = even[1] - even[0] if at.size > 1 else 0.0
        if not (step and np.abs(at - even).max() <= 1e-3 * abs(step)):  # NaN, too
            raise ValueError(
                f"data must have evenly spaced numbers as coordinates; got others along {name!r}. "
                "Interpolate to even ones first (DataArray.interp), or drop them."
            )
        if step < 0:
            data, at = np.flip(data, axis), at[::-1]
        spacing[axis], origin[axis] = abs(step), at[0]
    return data, {"spacing": spacing, "origin": origin}
