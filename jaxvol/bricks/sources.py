"""Where do the voxels of a brick come from? From anything with `shape`, `dtype` and `array[box]`."""

import math
import mmap
import operator
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, product
from typing import Any, TypeAlias

import jax
import numpy as np

from .._util.axes import XYZ, Axes, inverse, permuted
from .._util.checks import Arrayable, described, finite_array, integer
from .._util.voxels import check_shape
from ..scene.volume import Volume
from ..xla.platform import is_traced
from .conversion import Box, converted, voxel_type


Corner: TypeAlias = Sequence[int] | np.ndarray | Any
"""Three voxel indices along x, y, z, checked at run time."""

SPACE = ("x", "y", "z")

AT_ONCE = 2**23
"""Bytes of storage that are read at a time: a larger box is read in parts."""

ALIGNED = 64
"""JAX uses an array of NumPy in place if its address is a multiple of so many bytes."""

READERS = ThreadPoolExecutor(max_workers=4, thread_name_prefix="jaxvol-read")
"""Threads that read bricks and chunks while others are computed."""


class VoxelSource:
    """A volume of which boxes are read, so that it need not be in memory.

    **Arguments:**

    - `array`: anything with `shape`, `dtype` and `array[box]`, where `box` has a slice or an integer for each
      axis, such as an array of NumPy, zarr, h5py, dask or tensorstore. Several threads read it at once.
    - `spacing`, `origin`, `direction`: as in `Volume`.
    - `axes`: the name of each axis, such as "tczyx" or ["z", "y", "x"]; by default "xyz".
    - `index`: the entry of each axis other than x, y and z, such as {"c": 1, "t": 0}; by default the only
      one.
    - `name`: what it is called in errors. `hint`: what errors say to do where reading fails.

    **Attributes:** all have their axes in the order x, y, z.

    - `shape`: number of voxels. `spacing`, `origin`, `direction`: as given.
    - `dtype`: of the voxels that `read` returns. `stored_type`: of those of the array.
    - `chunks`: voxels of the chunks in which it is stored, or of a row if it has none.
    - `order`: axes in the order of storage, the slowest first, 0 for x.
    - `is_constant`: whether its `Summary` is kept: unlike an array of NumPy or a memory map that is open for
      writing, nobody is expected to write to it.

    **Raises:** `ValueError` for a shape or type that no volume has, for axes or an index that the array does
    not have, and for a traced array.
    """

    def __init__(
        self,
        array: Any,
        spacing: Arrayable | None = None,
        origin: Arrayable | None = None,
        *,
        direction: Any = None,
        axes: str | Sequence[str] | Any | None = None,
        index: Mapping[str, int] | None = None,
        name: str = "array",
        hint: str = "Check what it is stored in.",
    ):
        check_is_array(array)
        immutable = isinstance(array, jax.Array)
        if immutable:
            array = np.asarray(array)  # JAX would compile a program for each box
        elif hasattr(array, "translate_to"):
            array = array.translate_to[0]  # views of tensorstore count from where they begin in the whole
        self.array, self.name, self.hint, self.direction = array, name, hint, direction
        self.spacing = _triple("spacing", (1.0, 1.0, 1.0) if spacing is None else spacing)
        self.origin = _triple("origin", (0.0, 0.0, 0.0) if origin is None else origin)
        shape = tuple(map(int, array.shape))
        if len(shape) < 3:
            check_shape(shape)
        names = _axis_names(name, axes, len(shape))
        place = tuple(names.index(each) for each in SPACE)
        self.shape: tuple[int, int, int] = permuted([shape[axis] for axis in place], XYZ)
        check_shape(self.shape)
        self.stored_type = _dtype_of(array)
        self.dtype = voxel_type(self.stored_type)
        chunks, order = _layout_of(array, shape)
        slow, middle, fast = (place.index(axis) for axis in order if axis in place)
        self.order: Axes = slow, middle, fast
        if chunks is None:
            chunks = [n if axis == place[fast] else 1 for axis, n in enumerate(shape)]
        x, y, z = (min(chunks[axis], n) for axis, n in zip(place, self.shape, strict=True))
        self.chunks: tuple[int, int, int] = x, y, z
        self._place, self._index = place, _index(name, names, shape, index or {})
        self._map = _map_under(array)
        self._file = self._file_state()
        self._in_memory = isinstance(array, np.ndarray) and self._map is None
        writable = self._in_memory if self._map is None else self._map.mode != "r"
        self.is_constant = immutable or not writable
        self._summary: Any = None  # found by `summary.summary_of`

    @property
    def nbytes(self) -> int:
        """Bytes of all voxels, as they are read."""
        return math.prod(self.shape) * self.dtype.itemsize

    def _file_state(self) -> tuple[int, int] | None:
        """Size and time of the file under a memory map; None if there is none, or only the map has it."""
        if self._map is None or self._map.filename is None:
            return None
        try:
            found = os.stat(self._map.filename)
        except OSError:
            return None
        return found.st_size, found.st_mtime_ns if self._map.mode == "r" else 0

    def check_unchanged(self) -> None:
        """**Raises:** `ValueError` if the file under a memory map was written to since the source was made.
        To read one that became shorter would end the process."""
        now = self._file_state()
        if now is not None and now != self._file:
            raise ValueError(f"{self.name} changed after it was opened as a source. Open it again.")

    def read(self, low: Corner, high: Corner, axes: Axes = XYZ) -> np.ndarray:
        """Voxels data[x, y, z] with `low` <= (x, y, z) < `high`.

        **Arguments:** `low`, `high`: corners of the box. `axes`: of what is returned, data[z, y, x] for
        (2, 1, 0); in the `order` of storage, voxels are read fastest.

        **Returns:** a C-contiguous array of type `dtype` in native byte order, which may be a view of the
        source: do not write to it.

        **Raises:** `ValueError` for a box that is empty or exceeds the volume; for voxels that are NaN,
        infinite, or not exact in `dtype`; where the array raises anything; and if the file under a memory map
        was written to since the source was made.
        """
        box = self._box(low, high)
        if self._in_memory:
            return converted(self._stored(box, axes), box, axes, self.name)
        self.check_unchanged()
        voxels = empty_array(permuted([b - a for a, b in zip(*box, strict=True)], axes), self.dtype)
        for part in self.parts(box, AT_ONCE):
            place = [slice(a - x, b - x) for a, b, x in zip(*part, box[0], strict=True)]
            voxels[permuted(place, axes)] = converted(self._stored(part, axes), part, axes, self.name)
        if self._map is not None and self._map.mode == "r" and hasattr(mmap, "MADV_DONTNEED"):
            mapped: Any = self._map.base
            mapped.madvise(mmap.MADV_DONTNEED)  # or what was read would count as the process's memory
        return voxels

    def subsampled(self, stride: int) -> Volume:
        """Every `stride`-th voxel."""
        found = np.empty([-(-n // stride) for n in self.shape], self.dtype)
        for low, high in self.parts(((0, 0, 0), self.shape), AT_ONCE):
            place = tuple(slice(-(-a // stride), -(-b // stride)) for a, b in zip(low, high, strict=True))
            found[place] = self.read(low, high)[tuple(slice(-a % stride, None, stride) for a in low)]
        return Volume(found, [stride * s for s in self.spacing], self.origin)

    def _stored(self, box: Box, axes: Axes) -> np.ndarray:
        """The voxels of a box as they are stored, with their axes in the order `axes`."""
        index: list[Any] = list(self._index)
        for a, b, axis in zip(*box, self._place, strict=True):
            index[axis] = slice(a, b)
        try:
            given = self.array[tuple(index)]
            found = np.asarray(given)
        except Exception as fault:  # of whatever library
            raise ValueError(
                f"{self.name}: the voxels from {box[0]} to {box[1]} cannot be read ({fault}). {self.hint}"
            ) from fault
        if isinstance(given, np.ma.MaskedArray) and np.any(given.mask):
            raise ValueError(f"{self.name}: voxels from {box[0]} to {box[1]} are masked. Fill them first.")
        rank = [sorted(self._place).index(axis) for axis in self._place]
        moved = found.transpose(permuted(rank, axes)) if found.ndim == 3 else found
        size = permuted([b - a for a, b in zip(*box, strict=True)], axes)
        if moved.shape != size:
            raise ValueError(
                f"{self.name}: a box at {box[0]} must have the shape {size}; its array returns {moved.shape}."
            )
        return moved

    def parts(self, box: Box, most: int) -> Iterator[Box]:
        """A box, cut between chunks into parts that are stored in at most so many bytes, or in one chunk, in
        the order of storage."""
        extent, item = list(self.chunks), max(self.stored_type.itemsize, self.dtype.itemsize)
        for axis in reversed(self.order):  # rows first
            while extent[axis] < self.shape[axis] and 2 * math.prod(extent) * item <= most:
                extent[axis] = min(2 * extent[axis], self.shape[axis])
        pieces = []
        for low, high, chunk, size in zip(*box, self.chunks, extent, strict=True):
            begin = low - low % min(chunk, size)
            pieces.append(list(pairwise([low, *range(begin + size, high, size), high])))
        for piece in product(*permuted(pieces, self.order)):
            x, y, z = permuted(piece, inverse(self.order))
            yield (x[0], y[0], z[0]), (x[1], y[1], z[1])

    def _box(self, low: Corner, high: Corner) -> Box:
        try:
            x0, y0, z0 = (operator.index(i) for i in low)
            x1, y1, z1 = (operator.index(i) for i in high)
            nx, ny, nz = self.shape
            if 0 <= x0 < x1 <= nx and 0 <= y0 < y1 <= ny and 0 <= z0 < z1 <= nz:
                return (x0, y0, z0), (x1, y1, z1)
        except (TypeError, ValueError):
            pass
        raise ValueError(
            "low and high must be the corners of a box of at least one voxel, three integers each within "
            f"{self.shape}, `high` exclusive; got {low!r} and {high!r}."
        )


def _map_under(array: Any) -> np.memmap | None:
    """The memory map that an array is a part of."""
    while isinstance(array, np.ndarray) and not isinstance(array.base, mmap.mmap):
        array = array.base
    return array if isinstance(array, np.memmap) else None


def _dtype_of(array: Any) -> np.dtype:
    try:
        return np.dtype(getattr(array.dtype, "numpy_dtype", array.dtype))  # tensorstore has types of its own
    except TypeError as fault:
        raise ValueError(f"source must have a dtype that NumPy knows; got {array.dtype!r}.") from fault


def _layout_of(array: Any, shape: tuple[int, ...]) -> tuple[list[int] | None, list[int]]:
    """Voxels of a chunk along each axis, None where there are no chunks; and the axes in the order of
    storage, the slowest first."""
    axes = list(range(len(shape)))
    layout = getattr(array, "chunk_layout", None)
    if layout is not None:  # tensorstore
        chunks = [c or n for c, n in zip(layout.read_chunk.shape, shape, strict=True)]
        return chunks, list(layout.inner_order or axes)
    if isinstance(array, np.ndarray):
        return None, sorted(axes, key=lambda axis: -abs(array.strides[axis]))
    chunks = getattr(array, "chunks", None)
    # of zarr and h5py a number for each axis, of dask all numbers
    return None if chunks is None else [int(np.max(c)) for c in chunks], axes


def _axis_names(name: str, axes: Any, rank: int) -> list[str]:
    axes = SPACE if axes is None and rank == 3 else axes
    names = list(axes) if isinstance(axes, Sequence) else []
    if len(names) != rank or len({*names}) != rank or not {*SPACE} <= {*names}:
        raise ValueError(
            f'axes must name each of the {rank} axes of {name} once, such as "zyx"; got {axes!r}.'
        )
    return names


def _index(name: str, names: list[str], shape: tuple[int, ...], index: Mapping[str, int]) -> list[int]:
    """The entry to take along each axis; those of x, y and z are replaced by slices."""
    if unknown := {*index} - ({*names} - {*SPACE}):
        raise ValueError(f"index must name axes other than x, y, z of {names}; got {sorted(unknown)}.")
    fixed = []
    for axis, count in zip(names, shape, strict=True):
        only = 0 if count == 1 or axis in SPACE else None
        fixed.append(integer(f"index[{axis!r}]", index.get(axis, only), 0, max(count - 1, 0)))
    return fixed


def empty_array(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An uninitialized array, aligned so that `jax.device_put` uses it in place where the device is the
    CPU."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + ALIGNED, np.uint8)
    start = -memory.ctypes.data % ALIGNED
    return memory[start : start + size].view(dtype).reshape(shape)


def _triple(name: str, value: Any) -> tuple[float, float, float]:
    finite_array(name, value, (3,))
    x, y, z = np.asarray(value, float).tolist()
    if name == "spacing" and min(x, y, z) <= 0:
        raise ValueError(f"spacing must be positive along every axis; got {value!r}.")
    return x, y, z


def check_is_array(thing: Any) -> None:
    """**Raises** `ValueError` for what is traced, and for what is neither an array nor a `Volume`."""
    if is_traced(thing):
        raise ValueError(
            "source must not be traced: bricks have no gradients to voxels (jv.render has), and are not read "
            "inside jax.jit and jax.vmap. Pass traced spacing and origin to render_bricks, beside an array."
        )
    try:
        has_boxes = all(hasattr(thing, name) for name in ("shape", "dtype", "__getitem__"))
    except Exception as fault:  # of whatever library, such as h5py where the file is closed
        raise ValueError(
            f"source must be an array that can be read; got {described(thing)} ({fault}). Keep its file open."
        ) from fault
    if isinstance(thing, type) or not (isinstance(thing, Volume) or has_boxes):
        raise ValueError(
            f"source must be an array, a Volume, a VoxelSource, or the path of one; got {described(thing)}."
        )
