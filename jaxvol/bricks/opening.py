"""Opens arrays, files and folders as sources, and chooses the level of detail for a view."""

import math
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from .._util.checks import Arrayable
from .._util.files import check_size, file_size
from .._util.named_axes import along_xyz, is_named
from ..io.formats.raw import raw_header
from ..scene.camera import Camera, axes_of
from ..scene.volume import Volume
from .sources import VoxelSource
from .zarr import METADATA, zarr_levels


Openable: TypeAlias = VoxelSource | Volume | os.PathLike[str] | str | Any
"""A source, a volume, the path of a file or folder, or an array."""


def source_of(thing: Openable, **options: Any) -> VoxelSource:
    """The finest level of what `levels_of` opens.

    **Arguments:**

    - `thing`: as for `levels_of`.
    - `**options`: as for `levels_of`.

    **Returns:** the source.

    **Raises:** `ValueError` as `levels_of`. `ImportError` for Zarr without tensorstore and yaozarrs.
    """
    return levels_of(thing, **options)[0]


def levels_of(
    thing: Openable, *, spacing: Arrayable | None = None, origin: Arrayable | None = None, **options: Any
) -> tuple[VoxelSource, ...]:
    """The levels of detail of a volume, finest first; only that of an OME-Zarr image may have several.

    | `thing` | read |
    |---|---|
    | anything with `shape`, `dtype` and `[box]`: NumPy, zarr, h5py, dask, tensorstore | see `VoxelSource` |
    | an xarray `DataArray` | whole, its axes and coordinates as in `Volume`; of a lazy one pass `.data` |
    | path of a `.raw` file, x fastest; header as for `jv.load` | by `np.memmap` |
    | path of a `.npy` file, data[x, y, z] | by `np.lib.format.open_memmap` |
    | path of a Zarr array, version 2 or 3, or an OME-Zarr image | by tensorstore: `jaxvol[bricks]` |
    | a `Volume` without labels and field, or a `VoxelSource` | as it is |

    **Arguments:**

    - `thing`: what holds the voxels.
    - `spacing`: as in `Volume`, of the finest level; by default what the source says.
    - `origin`: as in `Volume`, of the finest level; by default what the source says.
    - `**options`: `shape` and `dtype` of a raw file, as in `jv.load`. `axes` and `index`: see `VoxelSource`;
      of Zarr, `axes` are by default its own (`dimension_names`, or xarray's `_ARRAY_DIMENSIONS` in version
      2). `missing`: what it means if a chunk of a path's Zarr array is not there: `"error"`, the default,
      that the data are incomplete; `"fill"` that all its voxels have the fill value, as where programs leave
      out such chunks.

    **Returns:** a source for each level.

    **Raises:** `ValueError` for anything else, for a file that is missing, damaged or cut short, and for
    shapes and types that no volume has. `TypeError` for options that do not belong to it. `ImportError` for
    Zarr without tensorstore and yaozarrs.
    """
    place = {"spacing": spacing, "origin": origin}
    place = {name: value for name, value in place.items() if value is not None}
    if isinstance(thing, VoxelSource):
        if place or options:
            raise ValueError(
                f"{', '.join(place | options)}: a VoxelSource takes no options; make another one."
            )
        return (thing,)
    if isinstance(thing, Volume):
        if thing.labels is not None or thing.field is not None:
            raise ValueError("source must be a Volume without labels and field. Use jv.render.")
        own = {"spacing": thing.spacing, "origin": thing.origin, "direction": thing.direction}
        return (VoxelSource(thing.data, **(own | place), **options, name="volume"),)
    if is_named(thing):
        thing, own = along_xyz(thing)
        return (VoxelSource(thing, **(own | place), **options),)
    if not isinstance(thing, str | os.PathLike):
        return (VoxelSource(thing, **place, **options),)
    path = Path(thing)
    if not path.exists():
        raise ValueError(f"path: there is no file {path} (working directory {Path.cwd()}).")
    if any((path / name).is_file() for name in METADATA):
        return zarr_levels(path, place, **options)
    if path.suffix.lower() == ".raw":
        size, stored, own = raw_header(path, options.pop("shape", None), options.pop("dtype", None), 48)
        check_size(path, file_size(path), math.prod(size) * stored.itemsize)
        mapped = np.memmap(path, stored, "r", shape=size, order="F")
        return (VoxelSource(mapped, **(own | place), **options, name=str(path)),)
    if path.suffix.lower() == ".npy":
        try:
            mapped = np.lib.format.open_memmap(path, "r")
        except Exception as fault:  # NumPy raises different errors for different faults
            raise ValueError(f"path: {path} cannot be opened as .npy ({fault}).") from fault
        return (VoxelSource(mapped, **place, **options, name=str(path)),)
    raise ValueError(
        f"path: {path} is not of a kind that is read box by box: .raw (uncompressed: gunzip -k), .npy, or the "
        "folder of a Zarr array or an OME-Zarr image. Pass what fits into memory, such as a DICOM series, as "
        "jv.load(path) or jv.load_ultrasound(path), and of HDF5 the array h5py.File(path)[name]."
    )


def level_for(levels: Sequence[VoxelSource], camera: Camera) -> int:
    """The coarsest level whose voxels are no larger than a pixel at the volume's corner nearest to the image
    plane. An axis along which a level is as fine as the finest does not count against it.

    **Arguments:**

    - `levels`: of the same volume, finest first (`levels_of`).
    - `camera`: the view.

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
