"""Records of images of xarray, nibabel, SimpleITK, itk, VTK and Zarr, none of which is imported here."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .files import ensure
from .image_record import ImageRecord, volume_arguments


EVEN = 1e-3  # tolerance of coordinates from evenly spaced ones, in steps


def record_of(value: object) -> ImageRecord | None:
    """Record of an image of a known library; None for anything else."""
    placed = ("GetSpacing", "GetOrigin")
    marks: dict[Callable[[Any], ImageRecord | None], tuple[str, ...]] = {
        _xarray: ("dims", "coords", "transpose", "to_numpy"),
        nibabel_record: ("dataobj", "affine", "header"),
        _itk: (*placed, "GetDirection", "GetNumberOfComponentsPerPixel"),
        _vtk: (*placed, "GetDirectionMatrix", "GetPointData"),
        _zarr: ("metadata", "attrs", "store", "chunks"),
    }
    readers = (read for read, names in marks.items() if all(hasattr(type(value), name) for name in names))
    return next(readers, lambda _: None)(value)


def object_arguments(value: object) -> dict[str, Any] | None:
    """Arguments of `Volume` for an image of a known library, channels included; None for anything else."""
    if (record := record_of(value)) is None:
        return None
    if "s" not in (letters := record.letters):
        record.axes = letters.replace("c", "s")
    return volume_arguments(record, turned=False)


def grid_of(affine: np.ndarray) -> dict[str, Any]:
    """Fields `steps`, `origin`, `direction` of a record with voxel (i, j, k) at `affine @ (i, j, k, 1)`."""
    columns, origin = np.split(np.asarray(affine, float)[:3], [3], axis=1)
    steps = np.linalg.norm(columns, axis=0)
    with np.errstate(invalid="ignore"):
        turn = columns / np.where(steps > 0, steps, 1)
    steps = dict(zip("xyz", steps.tolist(), strict=True))
    return {"steps": steps, "origin": origin[:, 0], "direction": turn}


def fields_of(header: Any) -> Any:
    """Names of the fields in a nibabel header; none for MINC."""
    return header.keys() if hasattr(header, "keys") else ()


def nibabel_record(image: Any, stored: np.ndarray | None = None) -> ImageRecord:
    """Record of a nibabel image, whose world is RAS. A NIfTI without sform and qform keeps the file's axes,
    with origin 0, as in SimpleITK. `stored`: voxels read before; without them, a fourth axis is channels."""
    header, proxy = image.header, image.dataobj
    data = proxy.get_unscaled() if stored is None and hasattr(proxy, "get_unscaled") else stored
    data = np.asanyarray(proxy if data is None else data)
    codes = [int(header[name]) for name in ("sform_code", "qform_code") if name in fields_of(header)]
    place: dict[str, Any] = {"convention": "RAS"} | grid_of(image.affine)
    if codes and not any(codes):
        place = {"steps": dict(zip("xyz", map(float, header["pixdim"][1:4]), strict=True))}
    unit = header.get_xyzt_units()[0] if hasattr(header, "get_xyzt_units") else "mm"
    axes = "xyzsc" if stored is None else "xyztc"
    while data.ndim > 5 and data.shape[-1] == 1:
        data = data[..., 0]
    if names := data.dtype.names:  # the channels of a colour
        axes, data = "xyztc"[: data.ndim] + "s", np.stack([data[name] for name in names], axis=-1)
    else:
        place |= {"slope": getattr(proxy, "slope", 1.0), "intercept": getattr(proxy, "inter", 0.0)}
    return ImageRecord(data, axes[: data.ndim], units=None if unit == "unknown" else unit, **place)


def _itk(image: Any) -> ImageRecord:
    """Record of an image of SimpleITK or of the package `itk`."""
    simple = hasattr(image, "GetDimension")
    library = sys.modules.get("SimpleITK" if simple else "itk")
    if library is None:  # another class with the same methods
        raise ValueError(f"data must be an image of SimpleITK or itk; got {type(image).__name__}.")
    n = image.GetDimension() if simple else image.GetImageDimension()
    ensure(n == 3, f"data must be a 3-D image; got one of {n} axes. Extract one volume.")
    data = (library.GetArrayFromImage if simple else library.array_from_image)(image)
    turn = np.asarray(image.GetDirection() if simple else library.array_from_matrix(image.GetDirection()))
    steps, axes = dict(zip("xyz", map(float, image.GetSpacing()), strict=True)), "zyxs"[: data.ndim]
    return ImageRecord(data, axes, steps, "mm", list(image.GetOrigin()), np.reshape(turn, (3, 3)), "LPS")


def _vtk(image: Any) -> ImageRecord:
    scalars = image.GetPointData().GetScalars()
    of_cells = scalars is None
    scalars = image.GetCellData().GetScalars() if of_cells else scalars
    ensure(scalars is not None, "data must be an image with scalars at its points or cells; got one without.")
    data = np.ravel(memoryview(scalars)).reshape(-1, scalars.GetNumberOfComponents())
    place = image.GetSpacing(), image.GetOrigin(), image.GetDirectionMatrix().GetData()
    return vtk_record(data, image.GetExtent(), of_cells, place)


def vtk_sizes(extent: Sequence[Any], of_cells: bool) -> list[int]:
    """Numbers of points, or of cells, of a VTK extent along x, y, z."""
    first, last = np.array(extent, int).reshape(3, 2).T
    return np.maximum(last - first + (not of_cells), 1).tolist()


def vtk_record(data: np.ndarray, extent: Sequence[Any], of_cells: bool, place: Sequence[Any]) -> ImageRecord:
    """Record of values [voxel, component], x fastest, on an extent; `place`: spacing, origin, direction."""
    spacing, origin, turn = (np.array(numbers, float) for numbers in place)
    columns, first = turn.reshape(3, 3) * spacing, np.array(extent, int)[::2] + 0.5 * of_cells
    grid = grid_of(np.column_stack([columns, origin + columns @ first]))
    data = data.reshape(*vtk_sizes(extent, of_cells)[::-1], data.shape[1])
    several = data.shape[3] > 1
    return ImageRecord(data if several else data[..., 0], "zyx" + "s" * several, **grid)


def cf_scale(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Fields `slope`, `intercept`, `missing` and `unsigned` of a record, from CF attributes."""
    slope, intercept = float(attributes.get("scale_factor", 1)), float(attributes.get("add_offset", 0))
    fills = [attributes.get(name) for name in ("_FillValue", "missing_value")]
    numbers = [float(n) for fill in fills if not isinstance(fill, str | None) for n in np.ravel(fill)]
    unsigned = str(attributes.get("_Unsigned")).lower() == "true"
    missing = tuple(n for n in numbers if n == n)
    return {"slope": slope, "intercept": intercept, "missing": missing, "unsigned": unsigned}


def _zarr(value: Any) -> ImageRecord | None:
    """Record of a Zarr array with names of axes, its own or xarray's; None without names."""
    attributes = dict(value.attrs)
    names = getattr(value.metadata, "dimension_names", None) or attributes.get("_ARRAY_DIMENSIONS") or []
    return ImageRecord(value, list(names), **cf_scale(attributes)) if len(names) > 2 and all(names) else None


def _xarray(value: Any) -> ImageRecord:
    """Record of a `DataArray`: axes by name or CF attribute `axis`, positions by even coordinates."""
    by_dim = {name: value.coords[name] for name in value.dims if name in value.coords}
    names = [str(getattr(by_dim.get(name), "attrs", {}).get("axis", name)) for name in value.dims]
    record = ImageRecord(value.variable, names, **cf_scale(value.attrs))  # read later, maybe from a file
    dims = {letter: dim for letter, dim in zip(record.letters, value.dims, strict=True) if letter in "xyz"}
    coords = {letter: value.coords[letter] for letter in "xyz" if letter in value.coords}
    is_3d = len(dims) == len(coords) == 3 and any(coord.ndim > 1 for coord in coords.values())  # per voxel
    if not is_3d:
        coords = {letter: coord for letter, coord in coords.items() if coord.dims == (dims.get(letter),)}
        coords = {letter: by_dim[dim] for letter, dim in dims.items() if dim in by_dim} | coords
    record.units = {letter: coord.attrs.get("units") for letter, coord in coords.items()}
    if is_3d:
        first = value.isel({dim: 0 for dim in value.dims if dim not in dims.values()})
        order = [dims[letter] for letter in "xyz"]
        world = [coords[letter].broadcast_like(first).transpose(*order).to_numpy() for letter in "xyz"]
        vars(record).update(grid_of(_affine(np.stack(world))))
        return record
    ends = {letter: even_step(coord.to_numpy(), coord.name) for letter, coord in coords.items()}
    record.steps = {letter: ends.get(letter, (1.0, 0.0))[0] for letter in "xyz"} if coords else {}
    record.origin = [ends.get(letter, (1.0, 0.0))[1] for letter in "xyz"]
    if (turn := value.attrs.get("direction")) is not None and len(dims) == 3:
        rank = [list(dims).index(letter) for letter in "xyz"]
        record.direction = np.reshape(np.asarray(turn, float), (3, 3))[np.ix_(rank, rank)]
        record.convention = "LPS"
    return record


def even_step(at: np.ndarray, name: object) -> tuple[float, float]:
    """Distance between evenly spaced numbers, and the first number. Raises `ValueError` for uneven ones."""
    even = np.linspace(at[0], at[-1], at.size) if at.dtype.kind in "iuf" and at.size else np.zeros(2)
    step = float(even[1] - even[0]) if at.size > 1 else 0.0
    is_even = step and np.abs(at - even).max() <= EVEN * abs(step)  # false for NaN
    ensure(is_even, f"data must have evenly spaced numbers as coordinates; got others: {name!r}.")
    return step, float(at[0])


def _affine(world: np.ndarray) -> np.ndarray:
    """Affine map of positions [3, x, y, z]. Raises `ValueError` for a curved grid."""
    first, last = world[:, 0, 0, 0], np.maximum(np.array(world.shape[1:]) - 1, 1)
    ends = world[:, -1, 0, 0], world[:, 0, -1, 0], world[:, 0, 0, -1]
    columns = (np.stack(ends, axis=1) - first[:, None]) / last
    exact = first[:, None, None, None] + np.tensordot(columns, np.indices(world.shape[1:]), 1)
    is_affine = np.abs(world - exact).max() <= EVEN * np.linalg.norm(columns, axis=0).min()  # false for NaN
    ensure(is_affine, "data must have evenly spaced numbers as coordinates; got those of a curved grid.")
    return np.column_stack([columns, first])
