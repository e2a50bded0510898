"""Reads images that say where they lie: of xarray, nibabel, SimpleITK and VTK, none of which is imported."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from .affine import place_of


def is_named(value: Any) -> bool:
    """Whether a value is an image of one of these libraries."""
    return _reader(value) is not None


def along_xyz(value: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The values as data[x, y, z] or data[x, y, z, channel], and `spacing`, `origin` and `direction` where
    the image tells them. Raises `ValueError` for one without three axes, or with uneven coordinates."""
    read = _reader(value)
    assert read is not None
    return read(value)


def _reader(value: Any) -> Callable[[Any], tuple[np.ndarray, dict[str, np.ndarray]]] | None:
    kind, placed = type(value), ("GetSpacing", "GetOrigin")
    marks = {
        _xarray: ("dims", "coords", "transpose", "to_numpy"),
        _nibabel: ("dataobj", "affine", "header"),
        _simple_itk: (*placed, "GetDirection", "GetNumberOfComponentsPerPixel"),
        _vtk: (*placed, "GetDirectionMatrix", "GetPointData"),
    }
    return next((read for read, names in marks.items() if all(hasattr(kind, name) for name in names)), None)


def _nibabel(image: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Its world is right, front, head; ours left, back, head."""
    return np.asanyarray(image.dataobj), place_of("data.affine", np.diag([-1.0, -1, 1, 1]) @ image.affine)


def _simple_itk(image: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    if image.GetDimension() != 3:
        raise ValueError(f"data must be a 3-D image; got one of size {image.GetSize()}. Extract one volume.")
    data = sys.modules["SimpleITK"].GetArrayFromImage(image)
    turn = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    return np.swapaxes(data, 0, 2), place_of("data", np.column_stack([turn, image.GetOrigin()]))


def _vtk(image: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    scalars, matrix = image.GetPointData().GetScalars(), image.GetDirectionMatrix()
    if scalars is None:
        raise ValueError("data must be an image with scalars at its points; got a vtkImageData without.")
    shape = (scalars.GetNumberOfComponents(), *image.GetDimensions())
    data = np.moveaxis(np.ravel(memoryview(scalars)).reshape(shape, order="F"), 0, -1)
    entries = [matrix.GetElement(i, j) for i in range(3) for j in range(3)]
    turn = np.reshape(entries, (3, 3)) * image.GetSpacing()
    origin = image.GetOrigin() + turn @ image.GetExtent()[::2]
    place = place_of("data", np.column_stack([turn, origin]))
    return data[..., 0] if shape[0] == 1 else data, place


def _xarray(value: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Axes named x, y and z are put in this order. Coordinates that fall are reversed, with the data. Axes
    without coordinates have spacing 1 from 0 on."""
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
            raise ValueError(f"data must have evenly spaced numbers as coordinates; got others: {name!r}.")
        if step < 0:
            data, at = np.flip(data, axis), at[::-1]
        spacing[axis], origin[axis] = abs(step), at[0]
    return data, {"spacing": spacing, "origin": origin}
