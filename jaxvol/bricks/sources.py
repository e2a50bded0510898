"""Where do the voxels of a brick come from? From anything with `shape`, `dtype` and `array[box]`."""

import math
import mmap
import operator
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise, product
from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np

from .._util.axes import XYZ, Axes, inverse, permuted
from .._util.checks import Arrayable, described, finite_array, integer
from .._util.voxels import check_shape
from ..scene.volume import Volume
from ..xla.platform import is_traced
from .conversion import Box, converted, voxel_type


Result = TypeVar("Result")

Triple: TypeAlias = tuple[float, float, float]

Corner: TypeAlias = Sequence[int] | np.ndarray | Any
"""Three voxel indices along x, y, z, checked at run time."""

SPACE = ("x", "y", "z")

AT_ONCE = 2**23
"""Bytes of storage that are read at a time: a larger box is read in parts."""

PAGE = 2**12
"""Bytes of a memory map that are read beside a row's own if only a part of it is: the pages at its ends."""

ALIGNED = 64
"""JAX uses an array of NumPy in place if its address is a multiple of so many bytes."""

_READERS = ThreadPoolExecutor(max_workers=4, thread_name_prefix="jaxvol-read")


def in_background(function: Callable[..., Result], *arguments: Any) -> "Future[Result]":
    """Calls a function that reads in another thread."""
    return _READERS.submit(function, *arguments)


class VoxelSource:
    """A volume of which boxes are read, so that it need not be in memory.

    **Arguments:**

    - `array`: anything with `shape`, `dtype` and `array[box]`, where `box` has a slice or an integer for each
      axis: an array or a memory map of NumPy, an array of JAX, zarr, h5py, dask or tensorstore, or an object
      of your own. It is read from other threads, and possibly by several at once.
    - `spacing`, `origin`, `direction`: as in `Volume`.
    - `axes`: the name of each of its axes, such as "tczyx" or ["z", "y", "x"]; x, y and z among them. By
      default it is array[x, y, z], as in `Volume`.
    - `index`: which entry to take along each other axis, such as {"c": 1, "t": 0}. An axis of one entry needs
      none.
    - `name`: what it is called in errors. `hint`: what errors say to do where reading fails.

    **Attributes:** all have their axes in the order x, y, z.

    - `shape`: number of voxels. `spacing`, `origin`, `direction`: as given.
    - `dtype`: of the voxels that `read` returns (`voxel_type`). `stored_type`: of those of the array.
    - `chunks`: voxels of the parts in which it is stored, or of a plane where it is stored as a whole.
      `chunked`: whether it is stored in parts. What is read at a time is cut between them.
    - `order`: axes in the order of storage, 0 for x: along the first one, neighbours lie farthest apart.

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
        self._immutable = isinstance(array, jax.Array)
        if self._immutable:
            array = np.asarray(array)  # JAX would compile a program for each box
        self.array, self.name, self.hint = array, name, hint
        self.spacing = _triple("spacing", (1.0, 1.0, 1.0) if spacing is None else spacing)
        self.origin = _triple("origin", (0.0, 0.0, 0.0) if origin is None else origin)
        self.direction = direction
        shape = tuple(map(int, array.shape))
        if len(shape) < 3:
            check_shape(shape)
        names = _axis_names(name, axes, len(shape))
        place = tuple(names.index(each) for each in SPACE)
        check_shape(tuple(shape[axis] for axis in place))
        self.shape: tuple[int, int, int] = permuted([shape[axis] for axis in place], XYZ)
        self.stored_type = np.dtype(_dtype_of(array))
        self.dtype = voxel_type(self.stored_type)
        chunks, order = _layout_of(array, shape)
        slow, middle, fast = (place.index(axis) for axis in order if axis in place)
        self.order: Axes = slow, middle, fast
        self.chunked = chunks is not None
        if chunks is None:
            chunks = [1 if axis == place[slow] else n for axis, n in enumerate(shape)]
        x, y, z = (min(chunks[axis], n) for axis, n in zip(place, self.shape, strict=True))
        self.chunks: tuple[int, int, int] = x, y, z
        self._place = place
        self._fixed = _fixed(name, names, shape, index or {})
        begin = getattr(getattr(array, "domain", None), "origin", None)
        self._begin = tuple(begin) if begin is not None else (0,) * len(shape)
        self._map = _map_under(array)
        self._summary: Any = None  # found by `summary.summary_of`

    @classmethod
    def of_volume(cls, volume: Volume) -> "VoxelSource":
        """The voxels of a `Volume`.

        **Raises:** `ValueError` for one with labels or a field, which are not voxels, and a traced one."""
        check_is_array(volume)
        for part in ("labels", "field"):
            if getattr(volume, part) is not None:
                raise ValueError(
                    f"source must be a volume of voxels alone; got a Volume with {part}. Pass volume.data, "
                    "or render it with jv.render."
                )
        return cls(volume.data, volume.spacing, volume.origin, direction=volume.direction, name="volume")

    @property
    def nbytes(self) -> int:
        """Bytes of all voxels, as they are read."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def in_memory(self) -> bool:
        """Whether the voxels are an array of NumPy, not one that maps a file."""
        return isinstance(self.array, np.ndarray) and self._map is None

    @property
    def is_constant(self) -> bool:
        """Whether what was found out of it is taken to stay true: it is no array of NumPy, which anybody may
        write to, and no memory map that is open for writing."""
        return self._immutable or (not self.in_memory and (self._map is None or self._map.read_only))

    def check_unchanged(self) -> None:
        """**Raises** `ValueError` if the file under a memory map was written to since the source was made."""
        if self._map is not None:
            self._map.check_unchanged(self.name)

    def bytes_touched(self, size: tuple[int, int, int]) -> int:
        """About how many bytes of storage, uncompressed, are read for a box of so many voxels."""
        item = self.stored_type.itemsize
        if self.in_memory:
            return math.prod(size) * item
        if self._map is not None:
            planes, rows, row = permuted(size, self.order)
            whole = self.shape[self.order[2]] * item
            return planes * rows * min(whole, row * item + PAGE)
        chunks = (
            min(-(-(s - 1) // c) + 1, -(-n // c)) * c
            for s, c, n in zip(size, self.chunks, self.shape, strict=True)
        )
        return math.prod(chunks) * item

    def read(self, low: Corner, high: Corner, axes: Axes = XYZ) -> np.ndarray:
        """Voxels data[x, y, z] with `low` <= (x, y, z) < `high`.

        **Arguments:** `low`, `high`: corners of the box. `axes`: of what is returned: data[z, y, x] for
        (2, 1, 0). In the `order` of storage, voxels keep their order, and are read fastest.

        **Returns:** a C-contiguous array of type `dtype` in native byte order. It may be a view of the source
        where that is an array in memory: do not write to it.

        **Raises:** `ValueError` for a box that is empty or exceeds the volume; for voxels that are NaN,
        infinite, or not exact in `dtype`; where the array raises anything; and if the file under a memory map
        was written to since the source was made.
        """
        box = self._box(low, high)
        if self.in_memory:
            return converted(self._stored(box, axes), box, axes, self.name)
        self.check_unchanged()
        voxels = empty_array(permuted([b - a for a, b in zip(*box, strict=True)], axes), self.dtype)
        for part in self.parts(box, AT_ONCE):
            place = [slice(a - x, b - x) for a, b, x in zip(*part, box[0], strict=True)]
            voxels[permuted(place, axes)] = converted(self._stored(part, axes), part, axes, self.name)
        if self._map is not None:
            self._map.forget()
        return voxels

    def subsampled(self, stride: int) -> Volume:
        """Every `stride`-th voxel, read in slabs across the axis where these are thinnest."""
        axis = int(np.argmax([n / c for n, c in zip(self.shape, self.chunks, strict=True)]))
        thick = -(-max(self.chunks[axis], stride) // stride) * stride
        slabs = []
        for begin in range(0, self.shape[axis], thick):
            low, high = [0, 0, 0], list(self.shape)
            low[axis], high[axis] = begin, min(begin + thick, self.shape[axis])
            slabs.append(self.read(low, high)[::stride, ::stride, ::stride].copy())
        return Volume(np.concatenate(slabs, axis), [stride * s for s in self.spacing], self.origin)

    def _stored(self, box: Box, axes: Axes) -> np.ndarray:
        """The voxels of a box as they are stored, with their axes in the order `axes`."""
        index: list[Any] = list(self._fixed)
        for a, b, axis in zip(*box, self._place, strict=True):
            index[axis] = slice(a, b)
        # views of tensorstore count from where they begin in the whole
        index = [
            i + start if isinstance(i, int) else slice(i.start + start, i.stop + start)
            for i, start in zip(index, self._begin, strict=True)
        ]
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
                f"{self.name}: the box from {box[0]} to {box[1]} must have the shape {size}, along the axes "
                f"{''.join(SPACE[axis] for axis in axes)}; its array returns {moved.shape}."
            )
        return moved

    def parts(self, box: Box, most: int) -> Iterator[Box]:
        """A box, cut between chunks into parts that are stored in at most so many bytes, or in one chunk. Of
        what is not stored in chunks, planes with more are cut into rows. In the order of storage."""
        extent, item = list(self.chunks), max(self.stored_type.itemsize, self.dtype.itemsize)
        middle = self.order[1]
        while not self.chunked and extent[middle] > 1 and math.prod(extent) * item > most:
            extent[middle] = -(-extent[middle] // 2)
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
        except (TypeError, ValueError) as fault:
            raise ValueError(
                f"low and high must be three voxel indices each, along x, y, z; got {low!r} and {high!r}."
            ) from fault
        first, last = (x0, y0, z0), (x1, y1, z1)
        if not all(0 <= a < b <= n for a, b, n in zip(first, last, self.shape, strict=True)):
            raise ValueError(
                f"low and high must be the corners of a box of at least one voxel inside {self.shape}, "
                f"`high` exclusive; got {first} and {last}."
            )
        return first, last


class _Map:
    """The memory map of a file."""

    def __init__(self, mapped: np.memmap):
        self.pages: Any = mapped.base
        self.path, self.read_only = mapped.filename, mapped.mode == "r"
        self.state = self._state()

    def _state(self) -> tuple[int, ...] | None:
        """Inode, size and time of the file; None if it is gone, and stays there for the map alone."""
        try:
            found = os.stat(self.path)  # pyright: ignore[reportArgumentType]
        except (OSError, TypeError):
            return None
        return found.st_ino, found.st_size, found.st_mtime_ns if self.read_only else 0

    def check_unchanged(self, name: str) -> None:
        """**Raises** `ValueError` if the file was written to: a map of one that became shorter ends the
        process when it is read. One that was replaced has another inode, and the map its old voxels."""
        now = self._state()
        if now is not None and self.state is not None and now[0] == self.state[0] and now != self.state:
            raise ValueError(f"{name} changed after it was opened as a source. Open it again.")

    def forget(self) -> None:
        """Unmap what was read: it would count as memory of the process. The system still has it."""
        if self.read_only and hasattr(mmap, "MADV_DONTNEED"):
            self.pages.madvise(mmap.MADV_DONTNEED)


def _map_under(array: Any) -> _Map | None:
    """The map that an array is a part of."""
    root = array
    while isinstance(root, np.ndarray) and not isinstance(root.base, mmap.mmap):
        root = root.base
    return _Map(root) if isinstance(root, np.memmap) else None


def _dtype_of(array: Any) -> np.dtype:
    found = array.dtype
    try:
        return np.dtype(getattr(found, "numpy_dtype", found))  # tensorstore has types of its own
    except TypeError as fault:
        raise ValueError(f"source must have a dtype that NumPy knows; got {found!r}.") from fault


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
    if axes is None and rank == 3:
        axes = SPACE
    names = list(axes) if isinstance(axes, Sequence) else None
    if names is None or len(names) != rank or len({*names}) != rank or not {*SPACE} <= {*names}:
        raise ValueError(
            f"axes must name each of the {rank} axes of {name} once, x, y and z among them, such as "
            f'"{"tczyx"[-rank:] if 3 <= rank <= 5 else "zyx"}"; got {axes!r}.'
        )
    return names


def _fixed(name: str, names: list[str], shape: tuple[int, ...], index: Mapping[str, int]) -> list[int]:
    """The entry to take along each axis that is not one of space."""
    if unknown := {*index} - {*names} | {*index} & {*SPACE}:
        raise ValueError(
            f"index must name axes of {name} other than x, y, z; got {sorted(unknown)} of {names}."
        )
    fixed = []
    for axis, count in zip(names, shape, strict=True):
        if axis not in SPACE and axis not in index and count > 1:
            raise ValueError(
                f"index must choose one of the {count} entries of {name} along {axis!r}; got none. Pass "
                f'index={{"{axis}": 0}}.'
            )
        fixed.append(integer(f"index[{axis!r}]", index.get(axis, 0), 0, max(count - 1, 0)))
    return fixed


def empty_array(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """An uninitialized array, aligned so that `jax.device_put` uses it in place where the device is the
    CPU."""
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + ALIGNED, np.uint8)
    start = -memory.ctypes.data % ALIGNED
    return memory[start : start + size].view(dtype).reshape(shape)


def _triple(name: str, value: Any) -> Triple:
    finite_array(name, value, (3,))
    x, y, z = np.asarray(value, float).tolist()
    if name == "spacing" and min(x, y, z) <= 0:
        raise ValueError(f"spacing must be positive along every axis; got {value!r}.")
    return x, y, z


def check_is_array(thing: Any) -> None:
    """**Raises** `ValueError` for traced voxels, spacing or origin, and for what is neither an array nor a
    `Volume`."""
    if is_traced(thing):
        raise ValueError(
            "source must not be traced, since it is read while an image is made: there are no gradients to "
            "voxels by bricks (jv.render has them), and none inside jax.jit and jax.vmap. For gradients to "
            "spacing and origin, pass these to render_bricks, beside an array."
        )
    if isinstance(thing, VoxelSource):
        raise ValueError(f"array must be one, not a source; got {described(thing)}.")
    try:
        has_boxes = all(hasattr(thing, name) for name in ("shape", "dtype", "__getitem__"))
    except Exception as fault:  # of whatever library, such as h5py where the file is closed
        raise ValueError(
            f"source must be an array that can be read; got {described(thing)} ({fault}). Keep its file open."
        ) from fault
    if isinstance(thing, type) or not (isinstance(thing, Volume) or has_boxes):
        raise ValueError(
            "source must be an array, a Volume, a VoxelSource, or the path of a file or folder; got "
            f"{described(thing)}."
        )
