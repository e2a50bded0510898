"""Which source, and which levels of detail, does a user mean, and which level is fine enough for a view?"""

import math
import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from .._util.checks import Arrayable, described
from .._util.files import check_size, decoding, file_size
from .._util.named_axes import along_xyz, is_named
from .._util.npy import npy_header
from ..io.formats.raw import raw_header
from ..scene.camera import Camera, axes_of
from ..scene.volume import Volume
from .sources import VoxelSource, check_is_array
from .zarr import METADATA, is_zarr_array, ome_zarr_levels, zarr_array


Openable: TypeAlias = VoxelSource | Volume | os.PathLike[str] | str | Any
"""A source, a volume, the path of a file or folder, or an array."""

OF_RAW, OF_ARRAY, OF_ZARR = ("shape", "dtype"), ("axes", "index"), ("axes", "index", "missing")


def source_of(thing: Openable, **options: Any) -> VoxelSource:
    """The finest level of what `levels_of` opens.

    **Arguments:** `thing`, `options`: as for `levels_of`.

    **Returns:** the source.

    **Raises:** as `levels_of`.
    """
    return levels_of(thing, **options)[0]


def levels_of(
    thing: Openable,
    *,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    shape: Sequence[int] | None = None,
    dtype: str | Any | None = None,
    axes: str | Sequence[str] | Any | None = None,
    index: Mapping[str, int] | None = None,
    missing: Literal["error", "fill"] | Any | None = None,
) -> tuple[VoxelSource, ...]:
    """The levels of detail of a volume, finest first; only that of an OME-Zarr image may have several.

    **Arguments:**

    - `thing`: what holds the voxels.

      | | read |
      |---|---|
      | anything with `shape`, `dtype` and `[box]`: NumPy, zarr, h5py, dask, tensorstore | see `VoxelSource` |
      | an xarray `DataArray` | whole, its axes and coordinates as in `Volume`; of a lazy one pass `.data` |
      | path of a `.raw` file, x fastest; header as for `jv.load` | by `np.memmap` |
      | path of a `.npy` file, data[x, y, z] | by `np.load(mmap_mode="r")` |
      | path of a Zarr array, version 2 or 3, or an OME-Zarr image | by tensorstore: `jaxvol[bricks]` |
      | a `Volume` without labels and field, or a `VoxelSource` | as it is |

    - `spacing`, `origin`: as in `Volume`, of the finest level; by default what the source says.
    - `shape`, `dtype`: of a raw file, as in `jv.load`.
    - `axes`, `index`: of arrays, .npy files and Zarr; see `VoxelSource`. By default Zarr's own
      (`dimension_names`, or xarray's `_ARRAY_DIMENSIONS` in version 2).
    - `missing`: what it means if a chunk of a path's Zarr array is not there. `"error"`: that the data are
      incomplete. `"fill"`: that all its voxels have the fill value, as where programs leave out such chunks.

    **Returns:** a source for each level.

    **Raises:** `ValueError` for anything else, for options that do not belong to it, for a file that is
    missing, damaged, or larger or smaller than it says, and for shapes and types that no volume has;
    `ImportError` for Zarr without tensorstore.
    """
    options = {"shape": shape, "dtype": dtype, "axes": axes, "index": index, "missing": missing}
    options = {name: value for name, value in options.items() if value is not None}
    place: dict[str, Any] = {"spacing": spacing, "origin": origin}
    if isinstance(thing, str | os.PathLike) and str(thing):
        return _of_path(Path(thing), options, place)
    if is_named(thing):
        _refuse(described(thing), options, ())
        thing, own = along_xyz(thing)
        return (VoxelSource(thing, **_with_own(place, own)),)
    if not isinstance(thing, VoxelSource | Volume):
        _refuse(described(thing), options, OF_ARRAY)
        return (VoxelSource(thing, **options, **place),)
    _refuse(described(thing), options | {k: v for k, v in place.items() if v is not None}, ())
    return (thing if isinstance(thing, VoxelSource) else _of_volume(thing),)


def _of_volume(volume: Volume) -> VoxelSource:
    check_is_array(volume)
    for part in ("labels", "field"):
        if getattr(volume, part) is not None:
            raise ValueError(f"source must hold voxels alone; got a Volume with {part}. Use jv.render.")
    return VoxelSource(volume.data, volume.spacing, volume.origin, direction=volume.direction, name="volume")


def _of_path(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not path.exists():
        raise ValueError(f"path: there is no file {path} (working directory {Path.cwd()}).")
    if path.is_dir():
        return _of_folder(path, options, place)
    if path.suffix.lower() == ".raw":
        _refuse(str(path), options, OF_RAW)
        size, stored, own = raw_header(path, options.get("shape"), options.get("dtype"), 48)
        check_size(path, file_size(path), math.prod(size) * stored.itemsize)
        mapped = np.memmap(path, stored, "r", shape=size, order="F")
        return (VoxelSource(mapped, **_with_own(place, own), name=str(path)),)
    if path.suffix.lower() == ".npy":
        _refuse(str(path), options, OF_ARRAY)
        whole = file_size(path)
        with decoding(path), path.open("rb") as stream:
            size, _, stored = npy_header(path, stream)
            check_size(path, whole - stream.tell(), math.prod(size) * stored.itemsize)
        return (VoxelSource(np.load(path, mmap_mode="r"), **options, **place, name=str(path)),)
    raise ValueError(
        f"path: {path} is not of a kind that is read in parts: .raw (uncompressed: gunzip -k), .npy, or the "
        "folder of a Zarr array or an OME-Zarr image. Pass what fits into memory as jv.load(path) or "
        "jv.load_ultrasound(path), and of HDF5 the array h5py.File(path)[name]."
    )


def _of_folder(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not any((path / name).is_file() for name in METADATA):
        raise ValueError(
            f"path: {path} is a folder without Zarr in it: it has none of {', '.join(METADATA)}. For a DICOM "
            "series, pass jv.load(path)."
        )
    if is_zarr_array(path):
        _refuse(str(path), options, OF_ZARR)
        return (zarr_array(path, **options, **place),)
    _refuse(f"the OME-Zarr image {path}, whose metadata name its axes,", options, OF_ZARR[1:])
    return ome_zarr_levels(path, **options, **place)


def _with_own(place: dict[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Spacing and origin as given, or else as the data say."""
    return {name: own.get(name) if given is None else given for name, given in place.items()}


def _refuse(what: str, options: dict[str, Any], allowed: tuple[str, ...]) -> None:
    if unused := [name for name in options if name not in allowed]:
        expected = f"only {', '.join(allowed)}" if allowed else "none"
        raise ValueError(f"{', '.join(unused)}: {what} takes no such option; expected {expected}.")


def level_for(levels: Sequence[VoxelSource], camera: Camera) -> int:
    """The coarsest level whose voxels are no larger than a pixel at the volume's corner nearest to the image
    plane. An axis along which a level is as fine as the finest does not count against it.

    **Arguments:** `levels`: of the same volume, finest first (`levels_of`). `camera`: the view.

    **Returns:** its index, 0 for the finest; also where the camera is within the volume.
    """
    finest = levels[0]
    width, height = camera.size
    left, right, low, high = np.asarray(camera.window, float)
    pixel = min((right - left) / width, (high - low) / height)
    if camera.parallel_scale is not None:
        pixel *= float(camera.parallel_scale)
    else:
        forward, position = (np.asarray(each, float) for each in (axes_of(camera)[2], camera.position))
        size = np.array(finest.spacing) * (np.array(finest.shape) - 1)
        corners = np.array(finest.origin) + np.array(list(product((0, 1), repeat=3))) * size
        nearest = max(float(np.min((corners - position) @ forward)), 0.0)
        pixel *= np.tan(np.deg2rad(float(camera.view_angle)) / 2) * nearest
    allowed = np.maximum(pixel, finest.spacing) * (1 + 1e-6)  # spacings of equal length may be rounded
    return max(k for k, level in enumerate(levels) if k == 0 or np.all(np.array(level.spacing) <= allowed))
