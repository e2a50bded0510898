"""Which source, and which levels of detail, does a user mean?"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from .._util.checks import Arrayable, described, finite_array
from .._util.files import Header, check_size, decoding, file_size
from .._util.named_axes import along_xyz, is_named
from .._util.npy import npy_header
from .._util.voxels import check_shape
from ..formats.raw import raw_header
from ..volume import Volume
from .sources import Triple, VoxelSource


Openable: TypeAlias = VoxelSource | Volume | os.PathLike[str] | str | Any
"""A source, a volume, the path of a file or folder, or an array."""

METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs"
"""Files, of which a Zarr array or group has at least one."""

OF_RAW, OF_ARRAY, OF_ZARR = ("shape", "dtype"), ("axes", "index"), ("axes", "index", "missing")

LARGE, BEYOND = 2**26, 8
"""Bytes of a chunk that are always taken, and of those of the array, how many times as many."""

DECODED = 2**24
"""Bytes of decoded chunks that are kept, for boxes that share them."""

DECODERS = min(os.cpu_count() or 1, 8)
"""Threads that read files, and threads that decode them."""


def source_of(thing: Openable, **options: Any) -> VoxelSource:
    """The finest level of what `levels_of` opens, with its arguments and errors."""
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
      | an xarray `DataArray` | its axes and coordinates as in `Volume` |
      | path of a `.raw` file, x fastest; header as for `jv.load` | by `np.memmap` |
      | path of a `.npy` file, data[x, y, z] | by `np.load(mmap_mode="r")` |
      | path of a Zarr array, version 2 or 3, or an OME-Zarr image | by tensorstore: `jaxvol[bricks]` |
      | a `Volume` without labels and field | in place |
      | a `VoxelSource` | as it says |

    - `spacing`, `origin`: as in `Volume`, of the finest level; by default what the source says.
    - `shape`, `dtype`: of a raw file, as in `jv.load`.
    - `axes`, `index`: of arrays and of Zarr; see `VoxelSource`. By default Zarr's own (`dimension_names`, or
      xarray's `_ARRAY_DIMENSIONS`).
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
    place: dict[str, Any] = {"spacing": triple("spacing", spacing), "origin": triple("origin", origin)}
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
    _refuse(described(thing), options, OF_ARRAY)
    if is_named(thing):
        thing, told = along_xyz(thing)
        place = {name: triple(name, told.get(name)) if at is None else at for name, at in place.items()}
    return (VoxelSource(thing, **options, **place),)


def _of_path(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not path.exists():
        raise ValueError(
            f"path: there is no file {path} (working directory {Path.cwd()}). Check the spelling."
        )
    if path.is_dir():
        return _of_folder(path, options, place)
    name = path.name.lower()
    if name.endswith((".raw", ".raw.gz")):
        _refuse(str(path), options, OF_RAW)
        return (_raw(path, **options, **place),)
    _refuse(str(path), options, ())
    if name.endswith(".npy"):
        return (_npy(path, **place),)
    raise ValueError(
        f"path: {path} is not of a kind that is read in parts: .raw, .npy, or the folder of a Zarr array or "
        "an OME-Zarr image. If it fits into memory, pass jv.load(path), or for ultrasound the volume and "
        "the map that jv.load_ultrasound(path) returns; of others, an array that reads boxes."
    )


def _raw(
    path: Path, shape: Any = None, dtype: Any = None, spacing: Triple | None = None, origin: Any = None
) -> VoxelSource:
    if path.name.lower().endswith(".gz"):
        raise ValueError(
            f"path: {path} is compressed, so that no part of it can be read alone. Decompress it: "
            f"gunzip -k {path}."
        )
    size, stored, fields = raw_header(path, Header(shape, dtype), 48)
    check_size(path, file_size(path), math.prod(size) * stored.itemsize)
    check_shape(size)
    mapped = np.memmap(path, stored, "r", shape=size, order="F")
    spacing, origin = (
        triple(name, fields.get(name)) if given is None else given
        for name, given in (("spacing", spacing), ("origin", origin))
    )
    return VoxelSource(mapped, spacing, origin, name=str(path))


def _npy(path: Path, spacing: Triple | None, origin: Triple | None) -> VoxelSource:
    size = file_size(path)
    with decoding(path), path.open("rb") as stream:
        shape, _, stored = npy_header(path, stream)
        start = stream.tell()
    check_size(path, size - start, math.prod(shape) * stored.itemsize)
    return VoxelSource(np.load(path, mmap_mode="r"), spacing, origin, name=str(path))


def _of_folder(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not any((path / name).is_file() for name in METADATA):
        raise ValueError(
            f"path: {path} is a folder without Zarr in it: it has none of {', '.join(METADATA)}. Give the "
            "folder of an array or of an OME-Zarr image; for a DICOM series, pass jv.load(path)."
        )
    _refuse(str(path), options, OF_ZARR)
    if is_zarr_array(path):
        return (zarr_array(path, **options, **place),)
    from .ome_zarr import levels_in

    _refuse(str(path), options, ("index", "missing"))
    return levels_in(path, **options, **place)


def is_zarr_array(path: Path) -> bool:
    """Whether a folder is that of a Zarr array, not of a group or anything else."""
    if (path / "zarr.json").is_file():
        return read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def zarr_array(
    path: Path,
    *,
    axes: Any = None,
    index: Mapping[str, int] | None = None,
    missing: Literal["error", "fill"] | Any = "error",
    spacing: Triple | None = None,
    origin: Triple | None = None,
) -> VoxelSource:
    """The array in a folder, opened by tensorstore. Arguments and errors as for `levels_of`."""
    if missing not in ("error", "fill"):
        raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(
            f'{path} is a Zarr array, which tensorstore reads; it is missing: pip install "jaxvol[bricks]".'
        ) from fault
    second = (path / ".zarray").is_file()
    spec = {
        "driver": "zarr" if second else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path.resolve()}{os.sep}"},
        "fill_missing_data_reads": missing == "fill",
    }
    context = {
        "cache_pool": {"total_bytes_limit": DECODED},
        "data_copy_concurrency": {"limit": DECODERS},
        "file_io_concurrency": {"limit": DECODERS},
    }
    try:
        store = tensorstore.open(spec, open=True, read=True, context=tensorstore.Context(context)).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault
    _check_chunks(path, store)
    if axes is None:
        axes = _told_axes(path, second=second)
    return VoxelSource(store, spacing, origin, axes=axes, index=index, name=str(path), hint=_hint)


def _hint(fault: str) -> str:
    if "missing" in fault:
        return (
            'A chunk is missing. Fetch it again; or pass missing="fill", if chunks were left out because '
            "all their voxels have the fill value."
        )
    return "A chunk is damaged. Fetch it again."


def _told_axes(path: Path, *, second: bool) -> list[str] | None:
    """The names of the axes that the array's metadata tell, if x, y and z are among them."""
    told: Any = None
    if second and (path / ".zattrs").is_file():
        told = read_json(path / ".zattrs").get("_ARRAY_DIMENSIONS")
    elif not second:
        metadata = read_json(path / "zarr.json")
        attributes = metadata.get("attributes") or {}
        told = metadata.get("dimension_names") or attributes.get("_ARRAY_DIMENSIONS")
    return told if told is not None and {"x", "y", "z"} <= {*told} else None


def _check_chunks(path: Path, store: Any) -> None:
    """Raises for chunks for which no memory should be taken: a chunk is decoded as a whole, even if it
    reaches beyond the array."""
    chunk = [c or n for c, n in zip(store.chunk_layout.read_chunk.shape, store.shape, strict=True)]
    of_chunk, whole = (math.prod(shape) * store.dtype.numpy_dtype.itemsize for shape in (chunk, store.shape))
    if of_chunk > max(LARGE, BEYOND * whole):
        raise ValueError(
            f"path: {path} must have chunks that are not much larger than it; got chunks of {tuple(chunk)} "
            f"voxels, {of_chunk} bytes, for an array of {tuple(store.shape)}. Its metadata may be damaged."
        )


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. **Raises** `ValueError` if it holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise ValueError(f"path: {path} cannot be read as JSON ({fault}).") from fault
    if not isinstance(content, dict):
        raise ValueError(f"path: {path} must hold a JSON object; got {described(content)}.")
    return content


def triple(name: str, value: Any) -> Triple | None:
    """`value` as three finite numbers; None stays None."""
    if value is None:
        return None
    finite_array(name, value, (3,))
    x, y, z = np.asarray(value, float).tolist()
    if name == "spacing" and min(x, y, z) <= 0:
        raise ValueError(f"spacing must be positive along every axis; got {value!r}.")
    return x, y, z


def _refuse(what: str, options: dict[str, Any], allowed: tuple[str, ...]) -> None:
    if unused := [name for name in options if name not in allowed]:
        raise ValueError(
            f"{', '.join(unused)}: {what} takes no such option; {', '.join(OF_RAW)} belong to raw files, "
            f"{', '.join(OF_ARRAY)} to arrays, {', '.join(OF_ZARR)} to Zarr arrays."
        )
