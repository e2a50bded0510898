"""How is a box of voxels read from a Zarr array, version 2 or 3?

By tensorstore, which reads and decodes the chunks that a box touches, several at a time.
"""

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from .._util.axes import XYZ, Axes, inverse
from .._util.checks import described, integer
from .._util.voxels import check_shape
from .dtypes import voxel_type
from .sources import VoxelSource, cuts, empty_box


Triple: TypeAlias = tuple[float, float, float]

SPACE = ("x", "y", "z")

AT_ONCE = 2**22
"""Bytes of decoded chunks that are read at a time, if a layer of single chunks has no more."""

LARGE, BEYOND = 2**26, 8
"""Bytes of a chunk that are always taken, and of those of the array, how many times as many."""

DECODERS = min(os.cpu_count() or 1, 8)
"""Threads that read files, and threads that decode them."""


class ZarrSource(VoxelSource):
    """Voxels of a Zarr array in a folder.

    **Arguments:**

    - `path`: the array's folder.
    - `axes`: the name of each of its axes, such as "tczyx" or ["z", "y", "x"]; x, y and z among them. By
      default what the array says (`dimension_names`, or xarray's `_ARRAY_DIMENSIONS`); if it says nothing, an
      array of three axes is data[x, y, z], as in `Volume`.
    - `index`: which entry to take along each other axis, such as {"c": 1, "t": 0}. An axis of one entry needs
      none.
    - `missing`: what it means if a chunk is not there. `"error"`: that the data are incomplete. `"fill"`:
      that all its voxels have the array's fill value, which is why many programs leave out such chunks (zarr
      and tensorstore among them, unless they are told otherwise).
    - `cache`: bytes of decoded chunks that are kept, for boxes that share them.
    - `beside`: see `VoxelSource`; by default the array's folder.

    Chunks that change after the array was opened are read as they are then, or as `cache` has them. Images
    by bricks notice values outside of the ranges that were found before.

    **Raises:** `ValueError` for a folder without a Zarr array, and an array of a shape or type that no volume
    has; `ImportError` without tensorstore.
    """

    def __init__(
        self,
        path: Path,
        *,
        axes: str | Sequence[str] | Any | None = None,
        index: Mapping[str, int] | None = None,
        missing: Literal["error", "fill"] | Any = "error",
        spacing: Triple | None = None,
        origin: Triple | None = None,
        cache: int = 2**24,
        beside: Path | None = None,
    ):
        if missing not in ("error", "fill"):
            raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
        self.name, self.path = str(path), path.resolve()
        self.beside = self.path if beside is None else beside
        self._complete = missing == "error"
        version, metadata = array_metadata(path)
        store = _opened(self.path, version, fill=missing == "fill", cache=cache)
        _check_chunks(path, store)
        names = _axes(path, axes, metadata, store.rank)
        fixed = _fixed(path, names, store.shape, index or {})
        self._index = {names[axis]: at for axis, at in fixed.items()}
        store = store[tuple(fixed.get(axis, slice(None)) for axis in range(store.rank))]
        spatial = [name for name in names if name in SPACE]
        self._store = store.transpose([spatial.index(name) for name in SPACE])
        check_shape(self._store.shape)
        self.shape = nx, ny, nz = self._store.shape
        self.stored_type = np.dtype(self._store.dtype.numpy_dtype)
        self.dtype = voxel_type(self.stored_type)
        x, y, z = (
            min(c or n, n)
            for c, n in zip(self._store.chunk_layout.read_chunk.shape, (nx, ny, nz), strict=True)
        )
        self.chunks = (x, y, z)
        i, j, k = self._store.chunk_layout.inner_order or XYZ
        self.order = i, j, k
        self.spacing, self.origin = spacing, origin

    def fingerprint(self) -> dict[str, Any] | None:
        """Path of the array, and a checksum over the name, size and times of each file in it: no voxel is
        read, but a folder of many chunks takes a while (some 100 000 files a second)."""
        digest, count = hashlib.blake2b(digest_size=16), 0
        for name, status in _files(self.path):
            entry = [name, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
            digest.update(json.dumps(entry).encode())
            count += 1
        return {
            "path": str(self.path),
            "files": count,
            "state": digest.hexdigest(),
            "index": self._index,
            "axes": list(self._store.domain.labels),
            "complete": self._complete,
        }

    def _stored(self, low: tuple[int, int, int], high: tuple[int, int, int], axes: Axes) -> np.ndarray:
        import tensorstore

        # layer by layer: tensorstore holds all chunks of what it is asked for at once
        axis, ends = self._layers(low, high)
        voxels = empty_box(low, high, axes, np.dtype(self._store.dtype.numpy_dtype))
        ordered = voxels.transpose(inverse(axes))
        try:
            for begin, end in pairwise(ends):
                layer = [slice(a, b) for a, b in zip(low, high, strict=True)]
                layer[axis] = slice(begin, end)
                part = ordered[_along(axis, begin - low[axis], end - low[axis])]
                # from the decoded chunks to their place, without another copy
                there = tensorstore.array(part, copy=False, write=True)
                there.write(self._store[tuple(layer)].translate_to[0, 0, 0]).result()
            return voxels
        except ValueError as fault:  # what tensorstore raises for all faults of files
            cure = (
                'Fetch it again; or pass missing="fill", if chunks were left out because all their voxels '
                "have the fill value."
                if self._complete and "missing" in str(fault)
                else "Fetch it again."
            )
            raise ValueError(
                f"{self.name}: the voxels from {low} to {high} cannot be read: a chunk is missing or "
                f"damaged. {cure} (tensorstore: {fault})"
            ) from fault

    def _layers(self, low: tuple[int, int, int], high: tuple[int, int, int]) -> tuple[int, list[int]]:
        """The axis along which a box touches the most chunks, and where it is cut along it: between chunks,
        so that each is read once; into parts of no more than AT_ONCE bytes, if they are thicker than one."""
        counts = [(b - 1) // c - a // c + 1 for a, b, c in zip(low, high, self.chunks, strict=True)]
        axis = int(np.argmax(counts))
        chunk = self.chunks[axis]
        of_chunk = math.prod(self.chunks) * self._store.dtype.numpy_dtype.itemsize
        layer = math.prod(counts) // counts[axis] * of_chunk
        return axis, cuts(low[axis], high[axis], chunk, layer, AT_ONCE)


def _along(axis: int, begin: int, end: int) -> tuple[slice, ...]:
    return tuple(slice(begin, end) if a == axis else slice(None) for a in range(3))


def array_metadata(path: Path) -> tuple[Literal[2, 3], dict[str, Any]]:
    """The version of a Zarr array, and its metadata; of version 2, with its `attributes`.

    **Raises:** `ValueError` if there is no Zarr array."""
    if (path / "zarr.json").is_file():
        metadata = read_json(path / "zarr.json")
        if metadata.get("node_type") == "array":
            return 3, metadata
    elif (path / ".zarray").is_file():
        attributes = read_json(path / ".zattrs") if (path / ".zattrs").is_file() else {}
        return 2, read_json(path / ".zarray") | {"attributes": attributes}
    raise ValueError(
        f"path: {path} is no Zarr array: neither .zarray nor a zarr.json of an array is in it. Give the "
        "folder of the array."
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


def _opened(path: Path, version: Literal[2, 3], *, fill: bool, cache: int) -> Any:
    """The array as a tensorstore."""
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(
            f'{path} is a Zarr array, which tensorstore reads; it is missing: pip install "jaxvol[bricks]".'
        ) from fault
    spec = {
        "driver": "zarr" if version == 2 else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path}{os.sep}"},
        "fill_missing_data_reads": fill,
    }
    # each thread that decodes keeps what it freed, up to tens of MiB, out of the reach of `give_back`
    context = tensorstore.Context(
        {
            "cache_pool": {"total_bytes_limit": cache},
            "data_copy_concurrency": {"limit": DECODERS},
            "file_io_concurrency": {"limit": DECODERS},
        }
    )
    try:
        return tensorstore.open(spec, open=True, read=True, context=context).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault


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


def _axes(path: Path, axes: Any, metadata: dict[str, Any], rank: int) -> list[str]:
    """A name for each axis of an array, x, y and z among them."""
    attributes = metadata.get("attributes") or {}
    told = metadata.get("dimension_names") or attributes.get("_ARRAY_DIMENSIONS")
    if axes is None and told is not None and {*SPACE} <= {*told}:
        axes = told
    if axes is None and rank == 3:
        axes = SPACE
    names = list(axes) if isinstance(axes, Sequence) else None
    if names is None or len(names) != rank or len({*names}) != rank or not {*SPACE} <= {*names}:
        raise ValueError(
            f"axes must name each of the {rank} axes of {path} once, x, y and z among them, such as "
            f'"{"tczyx"[-rank:] if 3 <= rank <= 5 else "zyx"}"; got {axes!r}.'
        )
    return names


def _fixed(path: Path, names: list[str], shape: Sequence[int], index: Mapping[str, int]) -> dict[int, int]:
    """The entry to take along each axis that is not one of space."""
    if unknown := {*index} - {*names} | {*index} & {*SPACE}:
        raise ValueError(
            f"index must name axes of {path} other than x, y, z; got {sorted(unknown)} of {names}."
        )
    fixed = {}
    for axis, (name, count) in enumerate(zip(names, shape, strict=True)):
        if name in SPACE:
            continue
        if name not in index and count > 1:
            raise ValueError(
                f"index must choose one of the {count} entries of {path} along {name!r}; got none. Pass "
                f'index={{"{name}": 0}}.'
            )
        fixed[axis] = integer(f"index[{name!r}]", index.get(name, 0), 0, count - 1)
    return fixed


def _files(folder: Path, name: str = "") -> Iterator[tuple[str, os.stat_result]]:
    """Each file in a folder and those within, with its name relative to it, in the order of names."""
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError as fault:
        raise ValueError(f"{folder} cannot be read any more ({fault.strerror}).") from fault
    for entry in entries:
        if entry.is_dir():
            yield from _files(folder / entry.name, f"{name}{entry.name}/")
        else:
            yield name + entry.name, entry.stat()
