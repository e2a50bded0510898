"""Opens arrays, files and folders as sources, and chooses the level of detail for a view.

tensorstore reads Zarr arrays. yaozarrs checks the `multiscales` of OME-Zarr 0.4 (Zarr 2, in .zattrs) and 0.5
(Zarr 3, in zarr.json), which say where levels of detail lie in the world: https://ngff.openmicroscopy.org/0.5/.
A voxel's position is that of its centre.
"""

import json
import math
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from .._util.checks import Arrayable, described, shortened
from .._util.files import MOST_VOXELS, check_size, file_size
from .._util.memory import memory_of_device, require_room
from .._util.named_axes import along_xyz, is_named
from ..io.formats import FOLDERS
from ..io.formats.raw import raw_header
from ..scene.camera import Camera, axes_of
from ..scene.volume import Volume, check_one_channel
from .sources import SPACE, VoxelSource


Openable: TypeAlias = VoxelSource | Volume | os.PathLike[str] | str | Any

METADATA = ("zarr.json", ".zarray", ".zgroup", ".zattrs")  # a Zarr array or group has at least one of them
LARGE, BEYOND = 2**26, 8  # bytes that a chunk may always have, and how many times those of its array
CACHE = 2**24  # bytes of decoded chunks and indices of shards that are kept, for boxes that share them


def source_of(thing: Openable, **options: Any) -> VoxelSource:
    """The finest level of what `levels_of` opens.

    Args:
        thing: as for `levels_of`.
        **options: as for `levels_of`.

    Returns:
        The source.

    Raises:
        ValueError: as `levels_of`.
        ImportError: for Zarr without tensorstore and yaozarrs.
    """
    return levels_of(thing, **options)[0]


def levels_of(
    thing: Openable, *, spacing: Arrayable | None = None, origin: Arrayable | None = None, **options: Any
) -> tuple[VoxelSource, ...]:
    """The levels of detail of a volume, finest first; only that of an OME-Zarr image may have several.

    | `thing` | read |
    |---|---|
    | anything with `shape`, `dtype` and `[box]`: NumPy, zarr, h5py, dask, tensorstore | see `VoxelSource` |
    | an xarray `DataArray`; an image of nibabel, SimpleITK, VTK | as by `Volume`; lazy: pass `.data` |
    | path of a `.raw` file, x fastest; header as for `jv.load` | by `np.memmap` |
    | path of a `.npy` file, data[x, y, z] | by `np.lib.format.open_memmap` |
    | path of a Zarr array, version 2 or 3, or an OME-Zarr image | by tensorstore: `jaxvol[bricks]` |
    | a `Volume` without labels and field, or a `VoxelSource` | as it is |

    Args:
        thing: what holds the voxels.
        spacing: as in `Volume`; by default what the source says. Not of an OME-Zarr image or a `VoxelSource`.
        origin: as in `Volume`; by default what the source says. Not of an OME-Zarr image or a `VoxelSource`.
        **options: `shape` and `dtype` of a raw file, as in `jv.load`. `axes`, `index` and `nan`: see
            `VoxelSource`; the axes of Zarr are by default its own (`dimension_names`, or xarray's
            `_ARRAY_DIMENSIONS` in version 2). `missing`: what it means if a chunk of a path's Zarr array is
            not there: `"error"`, the default, that the data are incomplete; `"fill"`, that all its voxels
            have the fill value, as where programs leave out such chunks.

    Returns:
        A source for each level.

    Raises:
        ValueError: for anything else, for a file that is missing, damaged or cut short, and for shapes and
            types that no volume has.
        TypeError: for options that do not belong to it.
        ImportError: for Zarr without tensorstore and yaozarrs.
    """
    place = {"spacing": spacing, "origin": origin}
    place = {name: value for name, value in place.items() if value is not None}
    if isinstance(thing, VoxelSource):
        if place or options:
            raise TypeError(
                f"{', '.join(place | options)}: a VoxelSource takes no options; make another one."
            )
        return (thing,)
    if isinstance(thing, Volume):
        if thing.labels is not None or thing.field is not None:
            raise ValueError("source must be a Volume without labels and field. Use jv.render.")
        check_one_channel(thing, "bricks")
        own = {"spacing": thing.spacing, "origin": thing.origin, "direction": thing.direction}
        return (VoxelSource(thing.data, **(own | place), axes="xyz", **options, name="volume"),)
    if is_named(thing):
        thing, own = along_xyz(thing)
        return (VoxelSource(thing, **(own | place), axes="xyz", **options),)
    if not isinstance(thing, str | os.PathLike):
        return (VoxelSource(thing, **place, **options),)
    path = Path(thing)
    if not path.exists():
        raise ValueError(f"path: there is no file {path} (working directory {Path.cwd()}).")
    if _is_zarr_array(path):
        return (_zarr_array(path, **place, **options),)
    if is_zarr(path):
        return _ome_zarr_levels(path, **place, **options)
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
        f"path: {path} is not of a kind that is read box by box: .raw (uncompressed: gunzip -k), .npy, or "
        "the folder of a Zarr array or OME-Zarr image. Pass what fits into memory, such as DICOM slices, as "
        "jv.load(path) or jv.load_ultrasound(path), and of HDF5 the array h5py.File(path)[name]."
    )


def is_zarr(path: Path) -> bool:
    """Whether a folder is a Zarr array or group."""
    return any((path / name).is_file() for name in METADATA)


def read_zarr(
    path: Path, *, time: int | None = None, channel: int | None = None, nan: float | None = None
) -> dict[str, Any]:
    """Reader of `jv.load`, for the finest level that takes at most a quarter of the memory."""
    index = {axis: at for axis, at in (("t", time), ("c", channel)) if at is not None}
    try:
        levels = levels_of(path, index=index, nan=nan)
    except ValueError as fault:
        hint = f"path: {path}: time= or channel= is needed: " if "index['" in str(fault) else ""
        raise ValueError(f"{hint}{fault}") from fault
    room = memory_of_device() // 4
    for level in levels:
        voxels = math.prod(level.shape)
        if voxels <= MOST_VOXELS and voxels * level.dtype.itemsize <= room:
            place = {} if _is_zarr_array(path) else {"spacing": level.spacing, "origin": level.origin}
            return {"data": level.read((0, 0, 0), level.shape)} | place
    raise ValueError(
        f"path: {path} must fit into {room / 2**30:.3g} GiB, a quarter of the memory; got {levels[-1].shape} "
        f"voxels of {levels[-1].dtype}. Read it in bricks: jv.render_bricks, --memory."
    )


FOLDERS.append((is_zarr, read_zarr))


def _is_zarr_array(path: Path) -> bool:
    if (path / "zarr.json").is_file():
        return _read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def _zarr_array(path: Path, *, axes: Any = None, missing: Any = "error", **how: Any) -> VoxelSource:
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(f'{path} is read by tensorstore: pip install "jaxvol[bricks]".') from fault
    if missing not in ("error", "fill"):
        raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
    spec = {
        "driver": "zarr" if (path / ".zarray").is_file() else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path.resolve()}{os.sep}"},
        "fill_missing_data_reads": missing == "fill",
        "context": {"cache_pool": {"total_bytes_limit": CACHE}},
    }
    try:
        store: Any = tensorstore.open(spec, open=True, read=True).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault
    # a chunk is decoded as a whole, even beyond the array
    chunk = [c or n for c, n in zip(store.chunk_layout.read_chunk.shape, store.shape, strict=True)]
    of_chunk, whole = (math.prod(shape) * store.dtype.numpy_dtype.itemsize for shape in (chunk, store.shape))
    if of_chunk > max(LARGE, BEYOND * whole):
        raise ValueError(
            f"path: {path} must have chunks that are not much larger than it; got chunks of {tuple(chunk)} "
            f"voxels, {of_chunk} bytes, for an array of {tuple(store.shape)}. Its metadata may be damaged."
        )
    require_room(of_chunk, f"path: {path}: a chunk of {tuple(chunk)} voxels")  # tensorstore ends the process
    names: Any = list(store.domain.labels)  # Zarr 3
    if (path / ".zattrs").is_file():  # xarray's in Zarr 2
        names = _read_json(path / ".zattrs").get("_ARRAY_DIMENSIONS") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"path: {path}: _ARRAY_DIMENSIONS must be names; got {shortened(names)}.")
    names = [str(name).lower() for name in names]
    if axes is None and {*SPACE} <= {*names}:
        axes = names
    return VoxelSource(store, axes=axes, name=str(path), **how)


def _ome_zarr_levels(path: Path, **options: Any) -> tuple[VoxelSource, ...]:
    """The levels of the first image in an OME-Zarr group, finest first, in the unit of the file."""
    if own := [name for name in ("spacing", "origin", "axes") if name in options]:
        raise TypeError(f"{', '.join(own)}: the OME-Zarr image {path} has its own.")
    try:
        from yaozarrs import v04, v05
    except ImportError as fault:
        raise ImportError(f'{path} is read by yaozarrs: pip install "jaxvol[bricks]".') from fault
    zarr3 = (path / "zarr.json").is_file()
    file = path / ("zarr.json" if zarr3 else ".zattrs")
    metadata = _read_json(file) if file.is_file() else {}
    try:
        model, content = (v05.Image, metadata["attributes"]["ome"]) if zarr3 else (v04.Image, metadata)
        image: Any = model.model_validate(content).multiscales[0]
    except (KeyError, TypeError, ValueError) as fault:
        version, said = "0.5" if zarr3 else "0.4", " ".join(str(fault).split())
        raise ValueError(
            f"path: {path} does not follow OME-Zarr {version} ({said}). Give the path of an image, or of an "
            "array in it, such as its folder 0."
        ) from fault
    names = [axis.name for axis in image.axes]
    units = {axis.name: getattr(axis, "unit", None) for axis in image.axes if axis.name in SPACE}
    if len(units) < 3 or len({*units.values()}) > 1:
        raise ValueError(f"path: {path} must have axes x, y and z of the same unit; got {names}, {units}.")
    at, levels = [names.index(axis) for axis in SPACE], []
    for dataset in image.datasets:
        scale, offset = np.ones(len(names)), np.zeros(len(names))
        for described_by in (dataset, image):  # those of all levels come last
            for each in described_by.coordinateTransformations or ():
                if each.type == "scale":
                    scale, offset = scale * each.scale, offset * each.scale
                else:
                    offset = offset + each.translation
        if not _is_zarr_array(path / dataset.path):
            raise ValueError(f"path: {path}: {dataset.path} is no Zarr array within the group.")
        place = {"spacing": scale[at], "origin": offset[at]}
        levels.append(_zarr_array(path / dataset.path, axes=names, **place, **options))
    return tuple(levels)


def _read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise ValueError(f"path: {path} cannot be read as JSON ({fault}).") from fault
    if not isinstance(content, dict):
        raise ValueError(f"path: {path} must hold a JSON object; got {described(content)}.")
    return content


def level_for(levels: Sequence[VoxelSource], camera: Camera) -> int:
    """The coarsest level whose voxels are no larger than a pixel at the volume's corner nearest to the image
    plane. An axis along which a level is as fine as the finest does not count against it.

    Args:
        levels: of the same volume, finest first (`levels_of`).
        camera: the view.

    Returns:
        Its index, 0 for the finest; also where the camera is within the volume.
    """
    finest = levels[0]
    width, height = camera.size
    left, right, low, high = np.asarray(camera.window, float)
    pixel = min(abs(right - left) / width, (high - low) / height)  # mirrored if `right` is the lesser
    if camera.parallel_scale is not None:
        pixel *= float(camera.parallel_scale)
    else:
        forward, position = (np.asarray(each, float) for each in (axes_of(camera, np)[2], camera.position))
        size = np.array(finest.spacing) * (np.array(finest.shape) - 1)
        corners = np.array(finest.origin) + np.array(list(product((0, 1), repeat=3))) * size
        nearest = max(float(np.min((corners - position) @ forward)), 0.0)
        pixel *= np.tan(np.deg2rad(float(camera.view_angle)) / 2) * nearest
    allowed = np.maximum(pixel, finest.spacing) * (1 + 1e-6)  # spacings of equal length may be rounded
    return max(k for k, level in enumerate(levels) if k == 0 or np.all(np.array(level.spacing) <= allowed))
