"""Where do the voxels of a brick come from? What every source answers, and arrays in memory.

A source is a volume that need not be in memory: it reads boxes of voxels. Indices are those of a `Volume`,
data[x, y, z], whatever the order of axes in a file.
"""

import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np

from .._util.axes import XYZ, Axes, permuted
from .._util.checks import Arrayable, is_traced
from .._util.voxels import check_shape, given_array
from ..volume import Volume
from .dtypes import Box, converted, voxel_type


Result = TypeVar("Result")

Corner: TypeAlias = Sequence[int] | np.ndarray | Any
"""Three voxel indices along x, y, z, checked at run time."""


AT_ONCE = 2**23
"""Bytes of a box that are read before they are converted, or brought into another order of axes."""

ALIGNED = 64
"""Bytes, of whose multiples the addresses of JAX's arrays are."""

_READERS = ThreadPoolExecutor(max_workers=4, thread_name_prefix="jaxvol-read")


def in_background(function: Callable[..., Result], *arguments: Any) -> "Future[Result]":
    """A call in another thread of those that read."""
    return _READERS.submit(function, *arguments)


class VoxelSource(ABC):
    """A volume of which boxes are read.

    - `name`: what it is called in errors: its path, or "array".
    - `shape`: number of voxels along x, y, z.
    - `dtype`: of the voxels that `read` returns (`dtypes.voxel_type`).
    - `stored_type`: of the voxels that `_stored` returns. Where it is not `dtype`, boxes are read and
      converted some layers at a time, so that they take little more memory than what they become. By default
      it is not known, and boxes are read at once.
    - `spacing`, `origin`: as in `Volume`, where the source knows them, or else None.
    - `chunks`: voxels along x, y, z of the parts in which it is stored. Reading parts of these costs as much
      as reading all. Boxes that are longest along the axes of long chunks are read fastest.
    - `beside`: the path that files derived from the data are named after; None for data in memory.
    - `order`: axes in the order of storage: along the first one, neighbours lie farthest apart, along the
      last one, side by side. By default x, y, z.
    """

    name: str
    shape: tuple[int, int, int]
    dtype: np.dtype
    stored_type: np.dtype | None = None
    spacing: tuple[float, float, float] | None
    origin: tuple[float, float, float] | None
    chunks: tuple[int, int, int]
    beside: Path | None
    order: Axes = XYZ

    @property
    def nbytes(self) -> int:
        """Bytes of all voxels, as they are read."""
        nx, ny, nz = self.shape
        return nx * ny * nz * self.dtype.itemsize

    def touched(self, size: tuple[int, int, int]) -> int:
        """Bytes of storage, uncompressed, that are read for a box of so many voxels, about."""
        chunks = (
            min(-(-(s - 1) // c) + 1, -(-n // c)) * c
            for s, c, n in zip(size, self.chunks, self.shape, strict=True)
        )
        return math.prod(chunks) * (self.stored_type or self.dtype).itemsize

    def read(self, low: Corner, high: Corner, axes: Axes = XYZ) -> np.ndarray:
        """Voxels data[x, y, z] with `low` <= (x, y, z) < `high`.

        **Arguments:** `low`, `high`: corners of the box. `axes`: of what is returned: data[z, y, x] for
        (2, 1, 0). In the `order` of storage, voxels keep their order, and are read fastest.

        **Returns:** a C-contiguous array of type `dtype` in native byte order. It may be a view of the source
        where that is an array: do not write to it.

        **Raises:** `ValueError` for a box that is empty or exceeds the volume; for voxels that are NaN,
        infinite, or not exact in `dtype`; and where the data are missing, damaged, or, as far as size and
        time of a single file tell, changed since the source was made.
        """
        box = self._box(low, high)
        if self.stored_type is None or self.stored_type == self.dtype:
            return converted(self._stored(*box, axes), box, axes, self.name)
        voxels = empty_box(*box, axes, self.dtype)
        for layer in self._layers_of(box, self.stored_type.itemsize):
            place = [slice(a - x, b - x) for a, b, x in zip(*layer, box[0], strict=True)]
            voxels[permuted(place, axes)] = converted(self._stored(*layer, axes), layer, axes, self.name)
        return voxels

    def _layers_of(self, box: Box, of_voxel: int) -> Iterator[Box]:
        """A box, cut along the first axis of storage into parts of no more than AT_ONCE bytes, or of single
        chunks. `of_voxel`: bytes of one."""
        axis, (low, high) = self.order[0], box
        plane = math.prod(b - a for a, b in zip(low, high, strict=True)) // (high[axis] - low[axis])
        chunk = self.chunks[axis]
        for begin, end in pairwise(cuts(low[axis], high[axis], chunk, plane * chunk * of_voxel, AT_ONCE)):
            first, last = list(low), list(high)
            first[axis], last[axis] = begin, end
            yield (first[0], first[1], first[2]), (last[0], last[1], last[2])

    def read_async(self, low: Corner, high: Corner, axes: Axes = XYZ) -> "Future[np.ndarray]":
        """`read` in another thread: `.result()` waits for the voxels, and raises what `read` raises."""
        return in_background(self.read, low, high, axes)

    @abstractmethod
    def fingerprint(self) -> dict[str, Any] | None:
        """Identifies the data, as a tree that JSON can hold. Equal fingerprints mean equal voxels, as far as
        times of files tell: these may miss a change within a tick of the system's clock, and one through a
        memory map until it is written back.

        None: nothing identifies them, such as an array that anybody may write to. What is computed from the
        voxels is then valid for this object alone, and while nobody writes to it."""

    @abstractmethod
    def _stored(self, low: tuple[int, int, int], high: tuple[int, int, int], axes: Axes) -> np.ndarray:
        """The voxels of a box that lies inside, as they are stored: of any byte order, and any layout in
        memory. A source of your own has this method.

        `low`, `high`: as for `read`. `axes`: of what is returned, of which the first one is the axis axes[0]
        of the volume, and so on: data[z, y, x] for (2, 1, 0). What has data[x, y, z] returns
        `data[x0:x1, y0:y1, z0:z1].transpose(axes)`; it is asked for its own `order`, so that this moves
        nothing, and for others by those who call `read` alone."""

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


class ArraySource(VoxelSource):
    """Voxels of an array in memory, data[x, y, z], of any memory layout. It is not copied.

    **Arguments:** `data`: the array. `spacing`, `origin`: as in `Volume`; by default unknown.

    **Raises:** `ValueError` for arrays of a shape or type that no volume has, and for traced ones.
    """

    def __init__(
        self,
        data: Arrayable,
        spacing: tuple[float, float, float] | None = None,
        origin: tuple[float, float, float] | None = None,
    ):
        check_known(data)
        array = given_array("data", data)
        check_shape(array.shape)
        self._data = np.asarray(array)
        self.name, self.beside = "array", None
        self.shape = nx, ny, nz = self._data.shape
        self.dtype, self.stored_type = voxel_type(self._data.dtype), self._data.dtype
        self.spacing, self.origin = spacing, origin
        slowest, *_ = self.order = by_stride(self._data.strides)
        self.chunks = (1, ny, nz) if slowest == 0 else (nx, 1, nz) if slowest == 1 else (nx, ny, 1)

    def touched(self, size: tuple[int, int, int]) -> int:
        return math.prod(size) * self._data.dtype.itemsize

    def fingerprint(self) -> dict[str, Any] | None:
        return None

    def _stored(self, low: tuple[int, int, int], high: tuple[int, int, int], axes: Axes) -> np.ndarray:
        return self._data[tuple(map(slice, low, high))].transpose(axes)


def cuts(begin: int, end: int, chunk: int, of_chunk: int, at_once: int) -> list[int]:
    """Where an interval of voxels along an axis is cut: between chunks, so that each is read once; into parts
    of no more than `at_once` bytes, if these are thicker than a chunk, of `of_chunk` bytes."""
    thick = chunk * max(1, at_once // of_chunk)
    return [begin, *range(begin // chunk * chunk + thick, end, thick), end]


def by_stride(strides: Sequence[int]) -> Axes:
    """Axes in the order of storage, by the distances of neighbours along them."""
    a, b, c = sorted(range(3), key=lambda axis: -abs(strides[axis]))
    return a, b, c


def empty_box(low: Corner, high: Corner, axes: Axes, dtype: np.dtype) -> np.ndarray:
    """An array for the voxels of a box, with its axes in this order. It is aligned as JAX aligns its own, so
    that `jax.device_put` uses it in place where the device is the CPU."""
    size = [int(b) - int(a) for a, b in zip(low, high, strict=True)]
    shape = permuted(size, axes)
    size = math.prod(shape) * dtype.itemsize
    memory = np.empty(size + ALIGNED, np.uint8)
    start = -memory.ctypes.data % ALIGNED
    return memory[start : start + size].view(dtype).reshape(shape)


def check_known(thing: Any) -> None:
    """**Raises** `ValueError` for traced voxels, spacing or origin."""
    if is_traced(thing):
        raise ValueError(
            "source must not be traced, since it is read while an image is made: there are no gradients to "
            "voxels by bricks (jv.render has them), and none inside jax.jit and jax.vmap. For gradients to "
            "spacing and origin, pass these to render_bricks, beside an array."
        )


def array_of(volume: Volume) -> ArraySource:
    """The voxels of a `Volume`.

    **Raises:** `ValueError` for one with labels or a field, which are not voxels, and for a traced one."""
    check_known(volume)
    for part in ("labels", "field"):
        if getattr(volume, part) is not None:
            raise ValueError(
                f"source must be a volume of voxels alone; got a Volume with {part}. Pass volume.data, or "
                "render it with jv.render."
            )
    (dx, dy, dz), (x, y, z) = (np.asarray(part, float).tolist() for part in (volume.spacing, volume.origin))
    return ArraySource(volume.data, (dx, dy, dz), (x, y, z))
