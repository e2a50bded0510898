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
from .._util.voxels import check_shape
from ..io.formats.raw import raw_header
from ..scene.camera import Camera, axes_of
from ..scene.volume import Volume
from .sources import VoxelSource
from .zarr import METADATA, is_zarr_array, ome_zarr_levels, zarr_array


Openable: TypeAlias = VoxelSource | Volume | os.PathLike[str] | str | Any
"""A source, a volume, the path of a file or folder, or an array."""

OF_RAW, OF_ARRAY, OF_ZARR = ("shape", "dtype"), ("axes", "index"), ("axes", "index", "missing")
OPTIONS = *OF_RAW, *OF_ZARR


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
      | a `Volume` without labels and field | in place |
      | a `VoxelSource` | as it says |

    - `spacing`, `origin`: as in `Volume`, of the finest level; by default what the source says.
    - `shape`, `dtype`: of a raw file, as in `jv.load`.
    - `axes`, `index`: of arrays, .npy files and Zarr; see `VoxelSource`. By default Zarr's own
      (`dimension_names`, or xarray's `_ARRAY_DIMENSIONS`).
    - `missing`: what it means if a chunk of a path's Zarr array is not there. `"error"`: that the data are
      incomplete. `"fill"`: that all its voxels have the fill value, which is why many programs leave out such
      chunks (zarr and tensorstore among them, unless they are told otherwise).

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
    if isinstance(thing, VoxelSource | Volume):
        _refuse(described(thing), options, ())
        source = VoxelSource.of_volume(thing) if isinstance(thing, Volume) else thing
        if any(value is not None for value in place.values()):
            raise ValueError(
                f"spacing and origin are those of {described(thing)}; got {place} as well. Leave them out."
            )
        return (source,)
    if is_named(thing):
        _refuse(described(thing), options, ())
        thing, own = along_xyz(thing)
        return (VoxelSource(thing, **_with_own(place, own)),)
    _refuse(described(thing), options, OF_ARRAY)
    return (VoxelSource(thing, **options, **place),)


def _of_path(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not path.exists():
        raise ValueError(
            f"path: there is no file {path} (working directory {Path.cwd()}). Check the spelling."
        )
    if path.is_dir():
        return _of_folder(path, options, place)
    name = path.name.lower()
    if name.endswith(".raw"):
        _refuse(str(path), options, OF_RAW)
        return (_raw(path, options.get("shape"), options.get("dtype"), place),)
    if name.endswith(".npy"):
        _refuse(str(path), options, OF_ARRAY)
        return (_npy(path, **options, **place),)
    if name.endswith(".raw.gz"):
        raise ValueError(
            f"path: {path} is compressed, so that no part of it can be read alone. Decompress it: "
            f"gunzip -k {path}."
        )
    raise ValueError(
        f"path: {path} is not of a kind that is read in parts: .raw, .npy, or the folder of a Zarr array or "
        "an OME-Zarr image. If it fits into memory, pass jv.load(path), or for ultrasound the volume and "
        "the map that jv.load_ultrasound(path) returns; of HDF5, the array h5py.File(path)[name]."
    )


def _raw(path: Path, shape: Any, dtype: Any, place: dict[str, Any]) -> VoxelSource:
    size, stored, own = raw_header(path, shape, dtype, 48)
    check_size(path, file_size(path), math.prod(size) * stored.itemsize)
    check_shape(size)
    mapped = np.memmap(path, stored, "r", shape=size, order="F")
    return VoxelSource(mapped, **_with_own(place, own), name=str(path))


def _npy(path: Path, **options: Any) -> VoxelSource:
    size = file_size(path)
    with decoding(path), path.open("rb") as stream:
        shape, _, stored = npy_header(path, stream)
        start = stream.tell()
    check_size(path, size - start, math.prod(shape) * stored.itemsize)
    return VoxelSource(np.load(path, mmap_mode="r"), name=str(path), **options)


def _of_folder(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not any((path / name).is_file() for name in METADATA):
        raise ValueError(
            f"path: {path} is a folder without Zarr in it: it has none of {', '.join(METADATA)}. Give the "
            "folder of an array or of an OME-Zarr image; for a DICOM series, pass jv.load(path)."
        )
    _refuse(str(path), options, OF_ZARR)
    if is_zarr_array(path):
        return (zarr_array(path, **options, **place),)
    if "axes" in options:
        raise ValueError(f"axes: the metadata of the OME-Zarr image {path} name its axes. Leave it out.")
    return ome_zarr_levels(path, **options, **place)


def _with_own(place: dict[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Spacing and origin as given, or else as the data say."""
    return {name: own.get(name) if given is None else given for name, given in place.items()}


def _refuse(what: str, options: dict[str, Any], allowed: tuple[str, ...]) -> None:
    if unused := [name for name in options if name not in allowed]:
        raise ValueError(
            f"{', '.join(unused)}: {what} takes no such option; {', '.join(OF_RAW)} belong to raw files, "
            f"{', '.join(OF_ARRAY)} to arrays and .npy files, {', '.join(OF_ZARR)} to paths of Zarr arrays."
        )


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
