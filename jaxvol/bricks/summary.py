"""Which values occur where in a source? Ranges of its blocks, found in one pass over all voxels.

From these, a renderer tells which bricks are empty without reading them. They are the ranges that
`occupancy.Blocks` has of a volume in memory.
"""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from itertools import product
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._util.axes import XYZ, Axes, inverse, permuted
from .._util.checks import integer
from .._util.memory import give_back
from ..scene.occupancy import BLOCK, Blocks, widened
from .dtypes import Box, is_half
from .sources import Corner, VoxelSource


CELL = 16
"""Cells along the side of a block, if the volume has more."""

AT_ONCE = 2**18
"""Blocks that are looked through at a time, if a layer of them has no more."""

COPIES = 8
"""Of the voxels that are read at a time: these, the next ones, and what finding their ranges takes."""

MOST = 2**25
"""Bytes of voxels that are read at a time, if a chunk has no more: larger parts leave the caches."""

Progress = Callable[[int, int], Any]
"""Called with the number of voxels done and the number of all."""


@dataclass(frozen=True)
class Summary:
    """Ranges of the voxels in each block of `cell`³ cells, including the nodes on its faces.

    - `shape`: of the volume, in voxels.
    - `cell`: cells along the side of a block.
    - `low`, `high`: least and greatest voxel, in the voxels' type, (bx, by, bz).
    """

    shape: tuple[int, int, int]
    cell: int
    low: np.ndarray
    high: np.ndarray

    def range_of(self, low: Corner, high: Corner) -> tuple[float, float]:
        """A range that holds all voxels with `low` <= (x, y, z) < `high`: the range of the blocks that hold
        these. Interpolation between them stays within it up to rounding (`occupancy.ROUNDING`)."""
        touched = tuple(
            slice(first, last + 1)
            for first, last in (
                self.blocks_of(int(a), int(b) - 1, n) for a, b, n in zip(low, high, self.shape, strict=True)
            )
        )
        return float(self.low[touched].min()), float(self.high[touched].max())

    def where(self, holds: Callable[[Blocks], Any]) -> np.ndarray:
        """For each block, whether something holds of it, such as `transfer.visible`: some layers of them at a
        time, since a transfer function may take a hundred times their memory. `holds` is a
        tree (`eqx.Partial`): a new lambda would be compiled anew."""
        layers = max(1, AT_ONCE // self.low[0].size)
        found = []
        for begin in range(0, len(self.low), layers):
            some = slice(begin, begin + layers)
            found.append(np.asarray(_holding(holds, self.low[some], self.high[some])))
        return np.concatenate(found)

    def blocks_of(self, first: int, last: int, count: int) -> tuple[int, int]:
        """First and last block along an axis of `count` nodes, that together hold the nodes `first` to
        `last`."""
        final = -(-(count - 1) // self.cell) - 1
        begin = min(first // self.cell, final)
        return begin, min(max(begin, (last - 1) // self.cell), final)


def summary_of(source: VoxelSource, *, memory: int = 2**28, progress: Progress | None = None) -> Summary:
    """The summary of a source, from one pass over its voxels. The source keeps it for the next images, unless
    it is an array of NumPy or a memory map that is open for writing. Of arrays of other libraries it is taken
    that nobody writes to them: open a source anew after that.

    **Arguments:** `source`: the voxels. `memory`, `progress`: see `scan`.

    **Returns:** the summary.

    **Raises:** as `scan` does.
    """
    if source._summary is not None:
        source.check_unchanged()
        return source._summary
    cell = CELL if min(source.shape) > CELL else BLOCK
    found = scan(source, cell, memory=memory, progress=progress)
    if source.is_constant:
        source._summary = found
    return found


def scan(
    source: VoxelSource, cell: int | Any = BLOCK, *, memory: int = 2**28, progress: Progress | None = None
) -> Summary:
    """The summary of a source, from one pass over its voxels.

    **Arguments:**

    - `cell`: cells along the side of a block. A summary takes 2 / `cell`³ of the voxels' memory.
    - `memory`: bytes for the pass, beside the summary. It is exceeded where one chunk takes more.
    - `progress`: called after each part; what it raises ends the pass.

    **Raises:** `ValueError` for what `VoxelSource.read` raises it for, such as NaN, anywhere in the source.
    """
    cell = integer("cell", cell, 1)
    blocks = tuple(-(-(n - 1) // cell) for n in source.shape)
    limits = (jnp.iinfo if source.dtype.kind in "iu" else jnp.finfo)(source.dtype)
    low, high = np.full(blocks, limits.max, source.dtype), np.full(blocks, limits.min, source.dtype)
    done, order = 0, source.order
    for box, voxels in _parts(source, memory):
        done += voxels.size
        if is_half(voxels.dtype):  # NumPy compares these one by one, and float32 in a fraction of the time
            voxels = voxels.astype(np.float32)
        first = permuted(box[0], order)
        for ranges, combine in ((low, np.minimum), (high, np.maximum)):
            part, place = _over_blocks(voxels, first, cell, combine, permuted(blocks, order))
            part, where = part.transpose(inverse(order)), permuted(place, inverse(order))
            ranges[where] = combine(ranges[where], part.astype(source.dtype))
        if progress is not None:
            progress(done, math.prod(source.shape))
    give_back()
    return Summary(source.shape, cell, low, high)


def _parts(source: VoxelSource, memory: int) -> Iterator[tuple[Box, np.ndarray]]:
    """All voxels, in boxes of whole chunks, each read while the one before is looked at, with their axes in
    the order of storage."""
    most = min(memory // COPIES, MOST)
    extent = list(source.chunks)
    item = source.dtype.itemsize
    for axis in reversed(source.order):  # rows first
        while extent[axis] < source.shape[axis] and 2 * math.prod(extent) * item <= most:
            extent[axis] = min(2 * extent[axis], source.shape[axis])
    ends = [range(0, n, step) for n, step in zip(source.shape, extent, strict=True)]
    boxes: list[Box] = []
    for low in product(*permuted(ends, source.order)):
        first = permuted(low, inverse(source.order))
        last = [min(a + e, n) for a, e, n in zip(first, extent, source.shape, strict=True)]
        boxes.append((first, permuted(last, XYZ)))

    def reading(number: int) -> "Future[np.ndarray]":
        low, high = boxes[number]
        return source.read_async(low, high, source.order)

    coming = reading(0)
    for number, box in enumerate(boxes):
        voxels = coming.result()
        if number + 1 < len(boxes):
            coming = reading(number + 1)
        yield box, voxels


def _over_blocks(
    voxels: np.ndarray, first: Axes, cell: int, combine: np.ufunc, counts: Axes
) -> tuple[np.ndarray, tuple[slice, slice, slice]]:
    """Ranges of the blocks that nodes from `first` on are part of, and the place of these among all. A node
    on a face is part of both blocks beside it. `counts`: of all blocks."""
    place = []
    for axis, (begin, count) in enumerate(zip(first, counts, strict=True)):
        end = begin + voxels.shape[axis]
        block, until = max((begin - 1) // cell, 0), min((end - 1) // cell + 1, count)
        place.append(slice(block, until))
        voxels = _along(voxels, axis, begin, end, range(block, until), cell, combine)
    return voxels, (place[0], place[1], place[2])


def _along(
    voxels: np.ndarray, axis: int, begin: int, end: int, blocks: range, cell: int, combine: np.ufunc
) -> np.ndarray:
    """Along one axis, of which there are the nodes from `begin` to `end`."""

    at = np.arange(blocks.start, blocks.stop) * cell + np.arange(cell + 1)[:, None]
    at = np.clip(at, begin, end - 1) - begin  # a node that is not there becomes one of the same block
    found = voxels.take(at[0], axis)
    for nodes in at[1:]:
        combine(found, voxels.take(nodes, axis), out=found)
    return found


@eqx.filter_jit
def _holding(holds: Callable[[Blocks], Any], low: Array | np.ndarray, high: Array | np.ndarray) -> Array:
    least, most = widened(jnp.asarray(low), jnp.asarray(high))
    return holds(Blocks(least, most, None))
