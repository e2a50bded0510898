"""How is a box of voxels read from a file that holds them uncompressed?

By seeking and reading, not through a memory map: pages of a map count as memory of the process until the
system takes them back, and a file cut short ends the process.
"""

import hashlib
import math
import mmap
import os
from collections.abc import Sequence
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from .._util.axes import XYZ, Axes
from .._util.checks import finite_array
from .._util.files import Header, check_size, decoding, file_size
from .._util.npy import npy_header
from .._util.voxels import check_shape
from ..formats.raw import raw_header
from .dtypes import voxel_type
from .sources import AT_ONCE, VoxelSource, by_stride, empty_box


GAP = 2**14
"""Bytes: what is not wanted between two rows is read with them if it is no more, since a system call, and on
a disk the pages at its ends, cost as much."""

AGAIN = "Open it again."

SAMPLES, SAMPLE = 64, 2**12
"""Pieces of a file that its fingerprint reads, and bytes of each."""


class FileSource(VoxelSource):
    """Voxels stored uncompressed in a file, at equal distances along each axis.

    **Arguments:**

    - `path`: the file.
    - `stored`: type of the voxels in the file, with their byte order.
    - `shape`: number of voxels along x, y, z.
    - `start`: position of voxel (0, 0, 0) in the file, bytes.
    - `strides`: distance in the file between neighbours along x, y, z, bytes; one of them is the size of a
      voxel.
    - `writable`: whether the file is mapped into memory for writing, so that its time does not tell whether
      it was written to.

    **Raises:** `ValueError` for a file that is too short; for a shape or type that no volume has.
    """

    def __init__(
        self,
        path: Path,
        stored: np.dtype,
        shape: Sequence[int],
        start: int,
        strides: Sequence[int],
        *,
        spacing: tuple[float, float, float] | None = None,
        origin: tuple[float, float, float] | None = None,
        writable: bool = False,
    ):
        check_shape(tuple(shape))
        nx, ny, nz = shape
        self.path = self.beside = path.resolve()
        self.name, self.shape, self.dtype = str(path), (nx, ny, nz), voxel_type(stored)
        self.spacing, self.origin = spacing, origin
        self._type, self._start, self._strides = stored, start, tuple(strides)
        self.stored_type = stored.newbyteorder("=")
        self._writable = writable
        size = file_size(self.path)
        end = start + stored.itemsize + sum((n - 1) * s for n, s in zip(shape, strides, strict=True))
        if size < end:
            raise ValueError(
                f"path: {path} is cut short: it holds {size} bytes, and its last voxel ends at {end}. Check "
                "shape and dtype, or fetch the file again."
            )
        slow, *_ = self.order = by_stride(self._strides)
        x, y, z = (1 if axis == slow else n for axis, n in enumerate(self.shape))
        self.chunks = (x, y, z)
        self._state = self._state_of(os.stat(self.path))

    def fingerprint(self) -> dict[str, Any] | None:
        """Path, size and times of the file, a checksum of pieces of it, and where its voxels lie. The times
        alone may miss a change within a tick of the system's clock, or through a memory map that was not
        written back; a file of up to 256 KiB is read whole."""
        if self._writable:
            return None
        with self._opened() as file:
            status, digest = os.fstat(file.fileno()), hashlib.blake2b(digest_size=16)
            whole = status.st_size <= SAMPLES * SAMPLE
            step = SAMPLE if whole else (status.st_size - SAMPLE) // (SAMPLES - 1)
            for piece in range(SAMPLES):
                file.seek(piece * step)
                digest.update(file.read(SAMPLE))
        return {
            "path": str(self.path),
            "size": status.st_size,
            "inode": status.st_ino,
            "modified": [status.st_mtime_ns, status.st_ctime_ns],
            "pieces": digest.hexdigest(),
            "voxels": [self._type.str, self._start, *self.shape, *self._strides],
        }

    def touched(self, size: tuple[int, int, int]) -> int:
        planes, rows, row = (size[axis] for axis in self.order)
        _, row_stride, voxel = (self._strides[axis] for axis in self.order)
        with_gap = row_stride if row_stride - row * voxel <= GAP else row * voxel + GAP
        return planes * rows * with_gap

    def holds(self, array: np.ndarray) -> bool:
        """Whether the file has these voxels, as far as samples of them tell."""
        for piece in range(SAMPLES):
            x, y, z = ((n - 1) * piece // (SAMPLES - 1) for n in self.shape)
            nx, ny, nz = self.shape
            low, high = (x, y, z), (min(x + 8, nx), min(y + 8, ny), min(z + 8, nz))
            own, given = self._stored(low, high, XYZ), array[tuple(map(slice, low, high))]
            if own.tobytes() != given.astype(own.dtype).tobytes():
                return False
        return True

    def _stored(self, low: tuple[int, int, int], high: tuple[int, int, int], axes: Axes) -> np.ndarray:
        voxels = empty_box(low, high, axes, self._type.newbyteorder("="))
        ordered = voxels.transpose([axes.index(axis) for axis in self.order])
        count, rows, row = ordered.shape
        with self._opened() as file:
            if ordered.flags.c_contiguous:
                self._planes(file, low, 0, ordered.view(self._type))
                return voxels if self._type.isnative else voxels.byteswap(inplace=True)
            some = np.empty((max(1, min(count, AT_ONCE // ordered[0].nbytes)), rows, row), self._type)
            for begin in range(0, count, len(some)):
                planes = some[: count - begin]
                self._planes(file, low, begin, planes)
                # one row of all planes after the other: NumPy transposes two axes fast, and three slowly
                for number in range(rows):
                    ordered[begin : begin + len(planes), number] = planes[:, number]
        return voxels

    def _planes(self, file: FileIO, low: tuple[int, int, int], begin: int, planes: np.ndarray) -> None:
        """Reads planes of a box, in the order of storage, from the one numbered `begin` in the box on."""
        size, (_, rows, row) = self._type.itemsize, planes.shape
        plane_stride, row_stride, _ = (self._strides[axis] for axis in self.order)
        gap = row_stride - row * size
        run = memoryview(bytearray((rows - 1) * row_stride + row * size if gap <= GAP else 0))
        at = self._start + sum(first * stride for first, stride in zip(low, self._strides, strict=True))
        for number, plane in enumerate(planes, begin):
            start = at + number * plane_stride
            if not gap:
                self._fill(file, start, _bytes_of(plane))
            elif gap <= GAP:
                self._fill(file, start, run)
                plane[:] = np.ndarray((rows, row), self._type, run, 0, (row_stride, size))
            else:
                for of_plane, one in enumerate(plane):
                    self._fill(file, start + of_plane * row_stride, _bytes_of(one))

    def _fill(self, file: FileIO, at: int, part: memoryview) -> None:
        file.seek(at)
        while part:
            count = file.readinto(part)
            if not count:
                raise ValueError(f"{self.name} ends at byte {file.tell()}, before its last voxel. {AGAIN}")
            part = part[count:]

    def _opened(self) -> FileIO:
        try:
            file = FileIO(self.path)
        except OSError as fault:
            raise ValueError(f"{self.name} cannot be read any more ({fault.strerror}). {AGAIN}") from fault
        if self._state_of(os.fstat(file.fileno())) != self._state:
            file.close()
            raise ValueError(f"{self.name} changed after it was opened as a source. {AGAIN}")
        return file

    def _state_of(self, status: os.stat_result) -> tuple[int, ...]:
        time = 0 if self._writable else status.st_mtime_ns
        return status.st_size, status.st_ino, status.st_dev, time


def _bytes_of(voxels: np.ndarray) -> memoryview:
    """The memory of a contiguous array."""
    return voxels.reshape(-1).view(np.uint8).data


def raw(
    path: Path,
    shape: Any = None,
    dtype: Any = None,
    spacing: tuple[float, float, float] | None = None,
    origin: tuple[float, float, float] | None = None,
) -> FileSource:
    """A `.raw` file, x fastest. Shape and type, and spacing and origin, are found as by `jv.load`.

    **Arguments:** `path`: of the file. `shape`, `dtype`, `spacing`, `origin`: as for `jv.load`.

    **Returns:** the source. Nothing is read before it is asked for.

    **Raises:** `ValueError` for a compressed file, and one whose size is not what shape and type say."""
    if path.name.lower().endswith(".gz"):
        raise ValueError(
            f"path: {path} is compressed, so that no part of it can be read alone. Decompress it: "
            f"gunzip -k {path}."
        )
    (nx, ny, nz), stored, fields = raw_header(path, Header(shape, dtype), 48)
    check_size(path, file_size(path), nx * ny * nz * stored.itemsize)
    spacing, origin = (
        triple(name, fields.get(name)) if given is None else given
        for name, given in (("spacing", spacing), ("origin", origin))
    )
    strides = np.array([1, nx, nx * ny], int) * stored.itemsize
    return FileSource(path, stored, (nx, ny, nz), 0, strides.tolist(), spacing=spacing, origin=origin)


def npy(
    path: Path,
    spacing: tuple[float, float, float] | None = None,
    origin: tuple[float, float, float] | None = None,
) -> FileSource:
    """A `.npy` file, data[x, y, z].

    **Arguments:** `path`: of the file. `spacing`, `origin`: as in `Volume`; by default unknown.

    **Returns:** the source. Nothing but the header is read before it is asked for.

    **Raises:** `ValueError` for a damaged header, and a size that is not what it says."""
    size = file_size(path)
    with decoding(path), path.open("rb") as stream:
        shape, fortran, stored = npy_header(path, stream)
        start = stream.tell()
    check_shape(shape)
    check_size(path, size - start, math.prod(shape) * stored.itemsize)
    strides = np.cumprod([1, *(shape[:2] if fortran else shape[:0:-1])]) * stored.itemsize
    strides = strides if fortran else strides[::-1]
    return FileSource(path, stored, shape, start, strides.tolist(), spacing=spacing, origin=origin)


def mapped(
    array: np.ndarray,
    spacing: tuple[float, float, float] | None = None,
    origin: tuple[float, float, float] | None = None,
) -> FileSource | None:
    """The file under a memory map (`np.memmap`), or under a part or a transposed view of one; None for other
    arrays, those whose voxels lie in the file at odd distances or not at all, and maps of which the file is
    deleted, or has other voxels, since another one has taken its name: SAMPLES boxes along the diagonal are
    compared. The voxels of such a map are there as long as it is."""
    root: Any = array
    while isinstance(root, np.ndarray) and not isinstance(root.base, mmap.mmap):
        root = root.base
    if not isinstance(root, np.memmap) or root.filename is None or root.mode == "c":
        return None
    if array.ndim != 3 or min(array.strides) != array.itemsize or not Path(root.filename).exists():
        return None
    # a map has no name but the one under which its file was opened
    start = root.offset + array.__array_interface__["data"][0] - root.__array_interface__["data"][0]
    source = FileSource(
        Path(root.filename),
        array.dtype,
        array.shape,
        start,
        array.strides,
        spacing=spacing,
        origin=origin,
        writable=root.mode != "r",
    )
    return source if source.holds(array) else None


def triple(name: str, value: Any) -> tuple[float, float, float] | None:
    """`value` as three finite numbers; None stays None."""
    if value is None:
        return None
    finite_array(name, value, (3,))
    x, y, z = np.asarray(value, float).tolist()
    if name == "spacing" and min(x, y, z) <= 0:
        raise ValueError(f"spacing must be positive along every axis; got {value!r}.")
    return x, y, z
