"""Sources of boxes of voxels: any array with `shape`, `dtype` and `array[box]`."""

import math
import mmap
import operator
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import pairwise, product
from typing import Any, SupportsIndex, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from .._util.axes import XYZ, Axes, inverse, permuted
from .._util.checks import Arrayable, described, finite_array
from .._util.voxels import DTYPES, WHOLE, check_shape, check_type
from ..scene.volume import Volume
from ..xla.memory import zeros_in_reserve
from ..xla.platform import is_traced


Corner: TypeAlias = Sequence[SupportsIndex] | np.ndarray  # three voxel indices along x, y, z
Box: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]  # first voxel, and the end (exclusive)

SPACE = ("x", "y", "z")
AT_ONCE = 2**23  # bytes of voxels that are read at a time: a larger box is read in several steps
READERS = ThreadPoolExecutor(max_workers=4, thread_name_prefix="jaxvol-read")


class VoxelSource:
    """A volume that is read box by box, so that it need not be in memory.

    It keeps the `Summary` of its voxels: make another source after writing to the array.

    Args:
        array: an object with `shape`, `dtype` and `array[box]`, where `box` has a slice or an integer for
            each axis, such as an array of NumPy, zarr, h5py, dask or tensorstore. Several threads read it at
            once. `source_of` takes data[x, y, z]; `dask.array` and xarray transpose and index lazily.
        spacing: as in `Volume`.
        origin: as in `Volume`.
        direction: as in `Volume`.
        space: the axes of the array that are x, y and z.
        index: an integer for each other axis, and a slice for each axis in `space`.
        nan: value that replaces NaN and infinite voxels; by default reading them raises an error.
        name: name of the source in errors.

    Attributes:
        shape: number of voxels along x, y, z.
        dtype: type of the voxels that `read` returns.
        chunks: voxels along x, y, z of a stored chunk, or of a row if the array has no chunks.
        order: axes in the order of storage, the slowest first, 0 for x.

    Raises:
        ValueError: for a shape or type that no volume has, and for a traced array.
    """

    def __init__(
        self,
        array: Any,
        spacing: Arrayable | None = None,
        origin: Arrayable | None = None,
        *,
        direction: Arrayable | None = None,
        space: Sequence[int] = XYZ,
        index: Sequence[int | slice] | None = None,
        nan: float | None = None,
        name: str = "array",
    ):
        if is_traced((array, spacing, origin, direction)):
            raise ValueError(
                "source must not be traced: bricks have no gradients (jv.render has), and are not read "
                "inside jax.jit and jax.vmap."
            )
        try:
            is_array = all(hasattr(array, attribute) for attribute in ("shape", "dtype", "__getitem__"))
        except Exception as fault:  # of any library, such as h5py if the file is closed
            raise ValueError(
                f"source must be an array that can be read; got {described(array)} ({fault}). Keep its file "
                "open."
            ) from fault
        if not is_array:
            raise ValueError(
                f"source must be an array, a Volume, a VoxelSource or a path; got {described(array)}."
            )
        if isinstance(array, jax.Array):
            array = np.asarray(array)  # JAX would compile a program for each box
        elif hasattr(array, "translate_to"):
            array = array.translate_to[0]  # indices of a view of tensorstore begin at its origin
        self.array, self.name, self.direction = array, name, direction
        self._nan = None if nan is None else np.float64(finite_array("nan", nan, ()))
        self.spacing = _triple("spacing", (1.0, 1.0, 1.0) if spacing is None else spacing)
        self.origin = _triple("origin", (0.0, 0.0, 0.0) if origin is None else origin)
        if min(self.spacing) <= 0:
            raise ValueError(f"spacing must be positive along every axis; got {spacing!r}.")
        shape = tuple(map(int, array.shape))
        if index is None:
            check_shape(shape)
            if len(shape) > 3:
                raise ValueError(f"{name} must be data[x, y, z]; got shape {shape}. Choose a channel first.")
        self._place, self._index = list(space), [slice(None)] * 3 if index is None else list(index)
        self.shape: tuple[int, int, int] = permuted([shape[axis] for axis in self._place], XYZ)
        check_shape(self.shape)
        self.dtype = voxel_type(np.dtype(getattr(array.dtype, "numpy_dtype", array.dtype)))  # of tensorstore
        chunks, order = _layout_of(array, shape)
        self.order: Axes = permuted([self._place.index(axis) for axis in order if axis in self._place], XYZ)
        if chunks is None:
            sizes = [n if axis == self.order[2] else 1 for axis, n in enumerate(self.shape)]
        else:  # of zarr and h5py a number for each axis, of dask all numbers
            sizes = [min(int(np.max(chunks[k])), n) for k, n in zip(self._place, self.shape, strict=True)]
        self.chunks: tuple[int, int, int] = permuted(sizes, XYZ)
        while isinstance(array, np.ndarray) and not isinstance(array.base, mmap.mmap):
            array = array.base
        self._map = array if isinstance(array, np.memmap) else None  # the array is a part of it
        self._file = self._file_state()
        self._in_memory = isinstance(self.array, np.ndarray) and self._map is None
        self._summary: Any = None  # set by `summary.summary_of`

    def _file_state(self) -> tuple[int, int] | None:
        """Size of the file under a memory map, and the time of the last change where the map is read-only."""
        if self._map is not None:
            with suppress(OSError, TypeError):  # the file was removed or has no name: the map still holds it
                status = os.stat(self._map.filename)  # pyright: ignore[reportArgumentType]
                return status.st_size, status.st_mtime_ns if self._map.mode == "r" else 0
        return None

    def check_unchanged(self) -> None:
        """Raises if the mapped file changed: reading a truncated map would end the process."""
        now = self._file_state()
        if now is not None and now != self._file:
            raise ValueError(f"{self.name} changed after it was opened as a source. Open it again.")

    def read(self, low: Corner, high: Corner, axes: Axes = XYZ) -> np.ndarray:
        """Reads the voxels data[x, y, z] with `low` <= (x, y, z) < `high`.

        Args:
            low: first voxel along x, y, z.
            high: end along x, y, z, exclusive.
            axes: order of the axes of the result, data[z, y, x] for (2, 1, 0). Reading is fastest in the
                `order` of storage.

        Returns:
            A C-contiguous array of type `dtype` in native byte order. It may be a view of the source: do not
            write to it.

        Raises:
            ValueError: for a box that is empty or exceeds the volume; for voxels that are NaN, infinite, or
                integers that float32 does not represent exactly; if the array raises any error or returns
                another shape; and if the file under a memory map changed since the source was made.
        """
        box, within = ((), ()), False
        with suppress(TypeError, ValueError):
            box = tuple(map(operator.index, low)), tuple(map(operator.index, high))
            within = all(0 <= a < b <= n for a, b, n in zip(*box, self.shape, strict=True))
        if not within:
            raise ValueError(
                "low and high must be the corners of a box of at least one voxel, three integers each within "
                f"{self.shape}, `high` exclusive; got {low!r} and {high!r}."
            )
        if self._in_memory:
            return self._read_at_once(box, axes)
        self.check_unchanged()
        shape = permuted([b - a for a, b in zip(*box, strict=True)], axes)
        voxels = zeros_in_reserve(math.prod(shape), self.dtype).reshape(shape)
        for low, high in self.boxes(box, AT_ONCE):
            place = [slice(a - x, b - x) for a, b, x in zip(low, high, box[0], strict=True)]
            voxels[permuted(place, axes)] = self._read_at_once((low, high), axes)
        if self._map is not None and self._map.mode == "r" and hasattr(mmap, "MADV_DONTNEED"):
            mapped: Any = self._map.base
            mapped.madvise(mmap.MADV_DONTNEED)  # else the pages would count as the process's memory
        return voxels

    def subsampled(self, stride: int) -> Volume:
        """Copies every `stride`-th voxel to a volume."""
        voxels = np.empty([-(-n // stride) for n in self.shape], self.dtype)
        for low, high in self.boxes(((0, 0, 0), self.shape), AT_ONCE):
            place = tuple(slice(-(-a // stride), -(-b // stride)) for a, b in zip(low, high, strict=True))
            voxels[place] = self.read(low, high)[tuple(slice(-a % stride, None, stride) for a in low)]
        return Volume(voxels, [stride * s for s in self.spacing], self.origin)

    def boxes(self, box: Box, limit: int) -> Iterator[Box]:
        """Cuts a box at faces of chunks into boxes of one chunk or up to `limit` bytes, in storage order."""
        extent, item = list(self.chunks), self.dtype.itemsize
        for axis in reversed(self.order):  # rows first
            while extent[axis] < self.shape[axis] and 2 * math.prod(extent) * item <= limit:
                extent[axis] = min(2 * extent[axis], self.shape[axis])
        pieces = []
        for low, high, chunk, size in zip(*box, self.chunks, extent, strict=True):
            begin = low - low % min(chunk, size)
            pieces.append(list(pairwise([low, *range(begin + size, high, size), high])))
        for piece in product(*permuted(pieces, self.order)):
            x, y, z = permuted(piece, inverse(self.order))
            yield (x[0], y[0], z[0]), (x[1], y[1], z[1])

    def _read_at_once(self, box: Box, axes: Axes) -> np.ndarray:
        index, size = list[Any](self._index), dict[int, int]()
        for a, b, axis in zip(*box, self._place, strict=True):
            index[axis], size[axis] = slice(a, b), b - a
        where = f"from {box[0]} to {box[1]}"
        try:
            stored = self.array[tuple(index)]
            voxels = np.asarray(stored)
        except Exception as fault:  # of any library
            raise ValueError(
                f"{self.name}: the voxels {where} cannot be read ({fault}). Fetch it again."
            ) from fault
        expected = tuple(size[axis] for axis in sorted(size))
        if voxels.shape != expected:
            raise ValueError(
                f"{self.name}: the voxels {where} must have the shape {expected}; its array returns "
                f"{voxels.shape}."
            )
        if isinstance(stored, np.ma.MaskedArray) and np.any(stored.mask):
            raise ValueError(f"{self.name}: voxels {where} are masked. Fill them first.")
        if self._nan is not None and voxels.dtype.kind not in "biu":
            voxels = np.where(np.isfinite(voxels), voxels, voxels.dtype.type(self._nan))
        if self.dtype == np.float32 and voxels.dtype.kind in "iu":
            (lowest, highest), (low, high) = WHOLE["float32"], (int(voxels.min()), int(voxels.max()))
            if low < lowest or high > highest:
                raise ValueError(
                    f"{self.name}: voxels must be whole numbers from -2**24 to 2**24, which float32 holds "
                    f"exactly; got {voxels.dtype} from {low} to {high} {where}."
                )
        rank = [sorted(self._place).index(axis) for axis in self._place]
        with np.errstate(over="ignore"):  # overflow to infinity is rejected below
            voxels = np.ascontiguousarray(voxels.transpose(permuted(rank, axes)), self.dtype)
        if self.dtype.kind not in "iu" and not np.isfinite(voxels).all():
            raise ValueError(
                f"{self.name}: voxels must be finite in {self.dtype}; got NaN or infinite ones {where}. "
                "Replace them first, or pass nan=VALUE."
            )
        return voxels


def voxel_type(stored: np.dtype) -> np.dtype:
    """Type in which voxels are read, one of `Volume`'s, in native byte order. Booleans become uint8, integers
    of 32 and 64 bits float32; float64 is kept if JAX's 64-bit types are enabled."""
    check_type(stored)
    if stored.kind == "b":
        return np.dtype(np.uint8)
    if stored.name in DTYPES:
        return stored.newbyteorder("=")
    return np.dtype(np.float32) if stored.kind in "iu" else np.dtype(jnp.result_type(float))


def _layout_of(array: Any, shape: tuple[int, ...]) -> tuple[Any, list[int]]:
    """Voxels of a chunk along each axis, or None; and the axes in the order of storage, slowest first."""
    axes, layout = list(range(len(shape))), getattr(array, "chunk_layout", None)
    if layout is not None:  # tensorstore
        chunks = [c or n for c, n in zip(layout.read_chunk.shape, shape, strict=True)]
        return chunks, list(layout.inner_order or axes)
    if isinstance(array, np.ndarray):
        return None, sorted(axes, key=lambda axis: -abs(array.strides[axis]))
    return getattr(array, "chunks", None), axes


def _triple(name: str, value: Any) -> tuple[float, float, float]:
    finite_array(name, value, (3,))
    x, y, z = np.asarray(value, float).tolist()
    return x, y, z
