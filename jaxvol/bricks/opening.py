"""Opens arrays, files and folders as sources (Zarr by tensorstore), and chooses the level of detail. yaozarrs
validates OME-Zarr 0.4 and 0.5 (https://ngff.openmicroscopy.org/0.5/), whose positions are those of voxel
centres; `orientation` (RFC 4) is read as ngff-zarr writes it."""

import json
import math
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from .._util.checks import Arrayable, described, shortened
from .._util.files import MOST_VOXELS
from .._util.image_record import DecodedArray, ImageRecord, choose
from .._util.memory import memory_of_device, require_room
from .._util.named_axes import cf_scale, even_step, record_of
from .._util.texts import warn_caller
from .._util.units import axis_letters
from .._util.voxels import check_shape
from ..io.formats import FOLDERS, read_record
from ..io.formats.library_formats import HDF5, MRC
from ..scene.camera import Camera, axes_of
from ..scene.volume import Volume, check_one_channel
from .sources import SPACE, VoxelSource, voxel_type


Openable: TypeAlias = Any
"""A `VoxelSource`, a `Volume`, a path, or an array or image: see `levels_of`."""

METADATA = ("zarr.json", ".zarray", ".zgroup", ".zattrs")  # a Zarr array or group has at least one of them
LARGE, BEYOND = 2**26, 8  # a chunk has at most LARGE bytes, or BEYOND times the bytes of its array
READ_IN_BOXES = (".raw", ".npy", *MRC, *HDF5)
CACHE = 2**24  # bytes of decoded chunks and shard indices in memory, for boxes that share them


def source_of(thing: Openable, **options: Any) -> VoxelSource:
    """Opens the finest level of a volume.

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
    """Opens the levels of detail of a volume, finest first; only an OME-Zarr image has several.

    | `thing` | read |
    |---|---|
    | anything with `shape`, `dtype` and `[box]`: NumPy, zarr, h5py, dask, tensorstore | as data[x, y, z] |
    | an xarray `DataArray`; an image of nibabel, SimpleITK, itk, VTK | as by `Volume`; lazy: pass `.data` |
    | path of a raw file, `.npy`, MRC, HDF5 (`file.h5::/name`); as for `jv.load` | mapped, or by h5py |
    | path of a Zarr array, version 2 or 3, or an OME-Zarr image | by tensorstore: `jaxvol[bricks]` |
    | a `Volume` without labels and field, or a `VoxelSource` | as it is |

    Args:
        thing: the object or path that holds the voxels.
        spacing: as in `Volume`; by default that of the source. Not for an OME-Zarr image or a `VoxelSource`.
        origin: as in `Volume`; by default that of the source. Not for an OME-Zarr image or a `VoxelSource`.
        **options: `nan`, see `VoxelSource`; `time` and `channel` of an array with named axes; and `shape`,
            `dtype` and `offset` of a raw file, as in `jv.load`. Zarr names its axes by `dimension_names`, or
            xarray's `_ARRAY_DIMENSIONS` in version 2; a missing chunk has the fill value.

    Returns:
        A source for each level.

    Raises:
        ValueError: for anything else, for a file that is missing, damaged or truncated, and for shapes and
            types that no volume has.
        TypeError: for options that do not apply to `thing`.
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
        stored = {"spacing": thing.spacing, "origin": thing.origin, "direction": thing.direction}
        return (VoxelSource(thing.data, **(stored | place), **options, name="volume"),)
    if (record := record_of(thing)) is not None:
        return (_source(record, place, **options),)
    if not isinstance(thing, str | os.PathLike):
        return (VoxelSource(thing, **place, **options),)
    path = Path(thing)
    if is_zarr(path):
        is_image = not _is_zarr_array(path)
        if is_image and place:
            raise TypeError(f"{', '.join(place)}: the OME-Zarr image {path} has its own. Leave them out.")
        records = _ome_records(path) if is_image else [_zarr_record(path)]
        return tuple(_source(record, place, **options) for record in records)
    name = path.name.lower()
    if path.exists() and (name.endswith(".gz") or not (name.endswith(READ_IN_BOXES) or "shape" in options)):
        raise ValueError(
            f"path: {path} is not of a kind that is read box by box: .raw (uncompressed: gunzip -k), .npy, "
            "MRC, HDF5, or the folder of a Zarr array or OME-Zarr image. For a volume that fits into memory, "
            "such as DICOM slices, pass jv.load(path) or jv.load_ultrasound(path)."
        )
    header = {key: options.pop(key) for key in ("shape", "dtype", "offset") if key in options}
    record = read_record(path, **header)
    return (_source(record, record.also | place, **options),)


def _source(
    record: ImageRecord,
    place: dict[str, Any],
    time: int | None = None,
    channel: int | None = None,
    nan: float | None = None,
) -> VoxelSource:
    """Source of a record: axes along the world's, lengths in mm. `place`: the caller's arguments."""
    name, array = record.what.removeprefix("path: "), record.data
    if not record.axes:
        raise ValueError(
            f"{name} has {len(array.shape)} axes without names. Pass an xarray.DataArray, or the three axes "
            "as data[x, y, z], such as dask.array.from_zarr(path)[0].T."
        )
    index, letters = choose(record, time, channel)
    if "s" in letters:
        at = record.letters.index("s")
        raise ValueError(f"channel must be given, from 0 to {array.shape[at] - 1}, for {name}.")
    shape = [n for n, part in zip(array.shape, index, strict=True) if isinstance(part, slice)]
    if not {*SPACE} <= {*letters}:
        check_shape(tuple(shape[:2]))
    order, signs, stored = record.oriented([shape[letters.index(letter)] for letter in SPACE])
    for text in record.assumed:
        warn_caller(f"{name}: {text}")
    at = [record.letters.index("xyz"[axis]) for axis in order]
    reverse = [axis for axis, sign in zip(at, signs, strict=True) if sign < 0]
    if reverse or record.missing or record.unsigned or record.is_scaled:
        array = DecodedArray(record, reverse, nan)
    return VoxelSource(array, **(stored | place), space=at, index=index, nan=nan, name=name)


def is_zarr(path: Path) -> bool:
    """Tests whether a folder is a Zarr array or group."""
    return any((path / name).is_file() for name in METADATA)


def read_zarr(path: Path) -> ImageRecord:
    """Record of the finest level that takes at most a quarter of the memory; the reader of `jv.load`."""
    records = [_zarr_record(path)] if _is_zarr_array(path) else _ome_records(path)
    room, sizes = memory_of_device() // 4, []
    for record in records:
        shape = dict(zip(record.letters if record.axes else "xyz", record.data.shape, strict=False))
        sizes = [n for letter, n in shape.items() if letter in "xyzs"]
        voxels, stored = math.prod(sizes), record.data.dtype.numpy_dtype
        if voxels <= MOST_VOXELS and voxels * voxel_type(stored).itemsize <= room:
            return record
    raise ValueError(
        f"path: {path} must fit into {room / 2**30:.3g} GiB, a quarter of the memory; got {tuple(sizes)} "
        "voxels. Read it in bricks: jv.render_bricks."
    )


FOLDERS.append((is_zarr, read_zarr))


def _is_zarr_array(path: Path) -> bool:
    if (path / "zarr.json").is_file():
        return _read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def _zarr_record(path: Path) -> ImageRecord:
    """Record of an array, with xarray's metadata. Unnamed axes are x, y, z of three; else `axes` is empty."""
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(f'{path} is read by tensorstore: pip install "jaxvol[bricks]".') from fault
    version_2 = (path / ".zarray").is_file()
    spec = {
        "driver": "zarr" if version_2 else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path.resolve()}{os.sep}"},
        "context": {"cache_pool": {"total_bytes_limit": CACHE}},
    }
    try:
        store: Any = tensorstore.open(spec, open=True, read=True).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault
    # a chunk is decoded completely, even beyond the array
    chunk = [c or n for c, n in zip(store.chunk_layout.read_chunk.shape, store.shape, strict=True)]
    chunk_bytes, total = (math.prod(n) * store.dtype.numpy_dtype.itemsize for n in (chunk, store.shape))
    if chunk_bytes > max(LARGE, BEYOND * total):
        raise ValueError(
            f"path: {path} must have chunks that are not much larger than it; got chunks of {tuple(chunk)} "
            f"voxels, {chunk_bytes} bytes, for an array of {tuple(store.shape)}. Its metadata may be damaged."
        )
    require_room(chunk_bytes, f"path: {path}: a chunk of {tuple(chunk)} voxels")  # tensorstore would abort
    attributes = _attributes(path)
    names: Any = list(store.domain.labels)  # Zarr 3
    if not any(names):  # xarray's in Zarr 2
        names = attributes.get("_ARRAY_DIMENSIONS") or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"path: {path}: _ARRAY_DIMENSIONS must be names; got {shortened(names)}.")
    names = names if any(names) else ["x", "y", "z"] * (len(store.shape) == 3)
    record = ImageRecord(store, names, what=f"path: {path}")
    try:
        for name, value in cf_scale(attributes).items():
            setattr(record, name, value)
        units, steps, origin = dict[str, Any](), dict[str, float](), np.zeros(3)
        for letter, name in zip(record.letters if names else "", names, strict=True):
            coordinate = path.parent / name  # of xarray
            known = letter in "xyz" and Path(name).name == name and coordinate != path
            if known and is_zarr(coordinate) and _is_zarr_array(coordinate):
                at, units[letter] = _zarr_record(coordinate).data, _attributes(coordinate).get("units")
                if len(at.shape) != 1 or at.shape[0] > 2**20:
                    raise ValueError(f"the coordinate {name} must have one axis; got shape {at.shape}.")
                steps[letter], origin["xyz".index(letter)] = even_step(np.asarray(at), name)
        record.steps, record.units, record.origin = steps, units, origin
    except (TypeError, ValueError) as fault:
        raise ValueError(f"path: {path}: {fault}") from fault
    return record


def _attributes(path: Path) -> dict[str, Any]:
    """The attributes of a Zarr array."""
    if (path / ".zarray").is_file():
        return _read_json(path / ".zattrs") if (path / ".zattrs").is_file() else {}
    return _read_json(path / "zarr.json").get("attributes") or {}


def _ome_records(path: Path) -> list[ImageRecord]:
    """The levels of the first image in an OME-Zarr group, finest first."""
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
        version, reason = "0.5" if zarr3 else "0.4", " ".join(str(fault).split())
        raise ValueError(
            f"path: {path} does not follow OME-Zarr {version} ({reason}). Pass the path of an image, or of "
            "an array in it, such as its folder 0."
        ) from fault
    names = [axis.name for axis in image.axes]
    unknown: list[str] = []
    letters = axis_letters(f"path: {path}", names, unknown.append)
    if unknown or not {*SPACE} <= {*letters}:
        raise ValueError(f"path: {path} must have axes x, y and z; got {names}.")
    units = {letter: getattr(axis, "unit", None) for letter, axis in zip(letters, image.axes, strict=True)}
    orientations = [axis.get("orientation") for axis in content["multiscales"][0]["axes"]]
    sides = [str(entry.get("value")) if isinstance(entry, dict) else "" for entry in orientations]
    ends = [side.partition("-to-")[2][:1].upper() for side in sides]
    at = [letters.index(letter) for letter in SPACE if letter in letters]
    turn = np.array(
        [[(ends[k] == end) - (ends[k] == start) for k in at] for end, start in ("LR", "PA", "SI")]
    )
    placed, records = np.abs(turn).sum() == len(at) == 3, []
    for dataset in image.datasets:
        scale, offset = np.ones(len(names)), np.zeros(len(names))
        for owner in (dataset, image):  # transformations of all levels come last
            for transformation in owner.coordinateTransformations or ():
                if transformation.type == "scale":
                    scale, offset = scale * transformation.scale, offset * transformation.scale
                else:
                    offset = offset + transformation.translation
        if not _is_zarr_array(path / dataset.path):
            raise ValueError(f"path: {path}: {dataset.path} is no Zarr array within the group.")
        record = _zarr_record(path / dataset.path)
        record.axes, record.units, record.format = names, units, "OME-Zarr"
        record.steps, record.origin = dict(zip(SPACE, scale[at].tolist(), strict=False)), offset[at]
        if placed:
            record.direction, record.convention = turn.astype(float), "LPS"
        elif any(sides):
            record.note(f"orientation {', '.join(side for side in sides if side)}: not read")
        records.append(record)
    return records


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
    """Finds the coarsest level whose voxels are no larger than a pixel at the volume's corner nearest to the
    image plane. Axes along which a level is as fine as the finest are ignored.

    Args:
        levels: levels of one volume, finest first (`levels_of`).
        camera: the view.

    Returns:
        The level's index; 0, the finest, where the camera is within the volume.
    """
    finest = levels[0]
    width, height = camera.size
    window = np.asarray(camera.window, float)
    pixel = min(abs(window[1] - window[0]) / width, (window[3] - window[2]) / height)  # may be mirrored
    if camera.parallel_scale is not None:
        pixel *= float(camera.parallel_scale)
    else:
        forward, position = (np.asarray(v, float) for v in (axes_of(camera, np)[2], camera.position))
        size = np.array(finest.spacing) * (np.array(finest.shape) - 1)
        corners = np.array(finest.origin) + np.array(list(product((0, 1), repeat=3))) * size
        nearest = max(float(np.min((corners - position) @ forward)), 0.0)
        pixel *= np.tan(np.deg2rad(float(camera.view_angle)) / 2) * nearest
    allowed = np.maximum(pixel, finest.spacing) * (1 + 1e-6)  # spacings of equal length may be rounded
    return max(k for k, level in enumerate(levels) if k == 0 or np.all(np.array(level.spacing) <= allowed))
