"""Records of images that say where they lie: of xarray, nibabel, SimpleITK, itk and VTK, none of which is
imported unless an image of it comes."""

import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .files import ensure
from .image_record import ImageRecord, volume_arguments


EVEN = 1e-3  # part of a step by which a coordinate may be away from evenly spaced ones


def record_of(value: Any) -> ImageRecord | None:
    """The record of an image of one of these libraries; None for anything else."""
    placed = ("GetSpacing", "GetOrigin")
    marks: dict[Callable[[Any], ImageRecord | None], tuple[str, ...]] = {
        _xarray: ("dims", "coords", "transpose", "to_numpy"),
        nibabel_record: ("dataobj", "affine", "header"),
        _itk: (*placed, "GetDirection", "GetNumberOfComponentsPerPixel"),
        _vtk: (*placed, "GetDirectionMatrix", "GetPointData"),
        _zarr: ("metadata", "attrs", "store", "chunks"),
    }
    found = (read for read, names in marks.items() if all(hasattr(type(value), name) for name in names))
    return next(found, lambda _: None)(value)


def object_arguments(value: Any) -> dict[str, Any] | None:
    """Arguments of `Volume` for an image of these libraries, channels included; None for anything else."""
    if (record := record_of(value)) is None:
        return None
    if "s" not in (letters := record.letters):
        record.axes = letters.replace("c", "s")
    return volume_arguments(record, turned=False)


def grid_of(affine: Any) -> dict[str, Any]:
    """`steps`, `origin` and `direction` of a record whose voxel (i, j, k) lies at `affine @ (i, j, k, 1)`."""
    columns, origin = np.split(np.asarray(affine, float)[:3], [3], axis=1)
    steps = np.linalg.norm(columns, axis=0)
    with np.errstate(invalid="ignore"):
        turn = columns / np.where(steps > 0, steps, 1)
    steps = dict(zip("xyz", steps.tolist(), strict=True))
    return {"steps": steps, "origin": origin[:, 0], "direction": turn}


def fields_of(header: Any) -> Any:
    """The names in a header of nibabel; that of MINC tells none."""
    return header.keys() if hasattr(header, "keys") else ()


def nibabel_record(image: Any, stored: Any = None) -> ImageRecord:
    """Record of a nibabel image, whose world is RAS. A NIfTI without sform and qform keeps the file's axes
    from 0 on, as by SimpleITK. `stored`: numbers read before; without, a fourth axis is channels."""
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
    if names := data.dtype.names:  # of colours
        axes, data = "xyztc"[: data.ndim] + "s", np.stack([data[name] for name in names], axis=-1)
    else:
        place |= {"slope": getattr(proxy, "slope", 1.0), "intercept": getattr(proxy, "inter", 0.0)}
    return ImageRecord(data, axes[: data.ndim], units=None if unit == "unknown" else unit, **place)


def _itk(image: Any) -> ImageRecord:
    """The record of an image of SimpleITK, or of the package `itk`."""
    simple = hasattr(image, "GetDimension")
    library = sys.modules.get("SimpleITK" if simple else "itk")
    if library is None:  # a class that only looks like theirs
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


def vtk_sizes(extent: Any, of_cells: bool) -> list[int]:
    """Numbers of points of an extent of VTK along x, y, z, or of cells between them."""
    first, last = np.array(extent, int).reshape(3, 2).T
    return np.maximum(last - first + (not of_cells), 1).tolist()


def vtk_record(data: np.ndarray, extent: Any, of_cells: bool, place: Any) -> ImageRecord:
    """The record of values [voxel, component], x fastest, at points of an extent, or at the centres of cells.
    `place`: spacing, origin, direction."""
    spacing, origin, turn = (np.array(numbers, float) for numbers in place)
    columns, first = turn.reshape(3, 3) * spacing, np.array(extent, int)[::2] + 0.5 * of_cells
    grid = grid_of(np.column_stack([columns, origin + columns @ first]))
    data = data.reshape(*vtk_sizes(extent, of_cells)[::-1], data.shape[1])
    several = data.shape[3] > 1
    return ImageRecord(data if several else data[..., 0], "zyx" + "s" * several, **grid)


def cf_scale(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """`slope`, `intercept`, `missing` and `unsigned` of a record by attributes of the CF convention."""
    slope, intercept = float(attributes.get("scale_factor", 1)), float(attributes.get("add_offset", 0))
    fills = [attributes.get(name) for name in ("_FillValue", "missing_value")]
    numbers = [float(n) for fill in fills if not isinstance(fill, str | None) for n in np.ravel(fill)]
    unsigned = str(attributes.get("_Unsigned")).lower() == "true"
    missing = tuple(n for n in numbers if n == n)
    return {"slope": slope, "intercept": intercept, "missing": missing, "unsigned": unsigned}


def _zarr(value: Any) -> ImageRecord | None:
    """The record of an array with names of axes, its own or xarray's; without, it is like any other array."""
    attributes = dict(value.attrs)
    names = getattr(value.metadata, "dimension_names", None) or attributes.get("_ARRAY_DIMENSIONS") or []
    return ImageRecord(value, list(names), **cf_scale(attributes)) if len(names) > 2 and all(names) else None


def _xarray(value: Any) -> ImageRecord:
    """The record of a `DataArray`: axes by name, or by `axis` of the CF convention; places by their
    coordinates, evenly spaced, also of several axes; `direction` as `itk.xarray_from_image` keeps it."""
    own = {name: value.coords[name] for name in value.dims if name in value.coords}
    names = [str(getattr(own.get(name), "attrs", {}).get("axis", name)) for name in value.dims]
    record = ImageRecord(value.variable, names, **cf_scale(value.attrs))  # read later, maybe from a file
    dims = {letter: dim for letter, dim in zip(record.letters, value.dims, strict=True) if letter in "xyz"}
    named = {letter: value.coords[letter] for letter in "xyz" if letter in value.coords}
    if len(dims) == len(named) == 3 and any(each.ndim > 1 for each in named.values()):  # of each voxel
        first = value.isel({dim: 0 for dim in value.dims if dim not in dims.values()})
        order = [dims[letter] for letter in "xyz"]
        world = [named[letter].broadcast_like(first).transpose(*order).to_numpy() for letter in "xyz"]
        record.units = {letter: each.attrs.get("units") for letter, each in named.items()}
        vars(record).update(grid_of(_affine(np.stack(world))))
        return record
    along = {a: each for a, each in named.items() if each.dims == (dims.get(a),)}
    along = {a: own[dim] for a, dim in dims.items() if dim in own} | along
    ends = {letter: even_step(each.to_numpy(), each.name) for letter, each in along.items()}
    record.steps = {letter: ends.get(letter, (1.0, 0.0))[0] for letter in "xyz"} if along else {}
    record.origin = [ends.get(letter, (1.0, 0.0))[1] for letter in "xyz"]
    record.units = {letter: each.attrs.get("units") for letter, each in along.items()}
    if (turn := value.attrs.get("direction")) is not None and len(dims) == 3:
        rank = [list(dims).index(letter) for letter in "xyz"]
        record.direction = np.reshape(np.asarray(turn, float), (3, 3))[np.ix_(rank, rank)]
        record.convention = "LPS"
    return record


def even_step(at: np.ndarray, name: Any) -> tuple[float, float]:
    """The distance between evenly spaced numbers, and the first. Raises `ValueError` for others."""
    even = np.linspace(at[0], at[-1], at.size) if at.dtype.kind in "iuf" and at.size else np.zeros(2)
    step = float(even[1] - even[0]) if at.size > 1 else 0.0
    is_even = step and np.abs(at - even).max() <= EVEN * abs(step)  # not of NaN
    ensure(is_even, f"data must have evenly spaced numbers as coordinates; got others: {name!r}.")
    return step, float(at[0])


def _affine(world: np.ndarray) -> np.ndarray:
    """The affine map of positions [3, x, y, z]. Raises `ValueError` where they are none's."""
    first, last = world[:, 0, 0, 0], np.maximum(np.array(world.shape[1:]) - 1, 1)
    ends = world[:, -1, 0, 0], world[:, 0, -1, 0], world[:, 0, 0, -1]
    columns = (np.stack(ends, axis=1) - first[:, None]) / last
    exact = first[:, None, None, None] + np.tensordot(columns, np.indices(world.shape[1:]), 1)
    is_affine = np.abs(world - exact).max() <= EVEN * np.linalg.norm(columns, axis=0).min()  # not of NaN
    ensure(is_affine, "data must have evenly spaced numbers as coordinates; got those of a curved grid.")
    return np.column_stack([columns, first])
