"""Which values occur where in a source? Ranges of its blocks, found in one pass over all voxels.

They tell which bricks are empty without reading them, as `occupancy.Blocks` does of a volume in memory.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._util.axes import Axes, inverse, permuted
from .._util.memory import give_back
from ..scene.occupancy import BLOCK, Blocks, widened
from .conversion import Box, comparable
from .grid import BrickGrid
from .sources import Corner, VoxelSource, in_background


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
                self._blocks_of(int(a), int(b) - 1, n) for a, b, n in zip(low, high, self.shape, strict=True)
            )
        )
        return float(self.low[touched].min()), float(self.high[touched].max())

    def where(self, holds: Callable[[Blocks], Any]) -> Bool[np.ndarray, "bx by bz"]:
        """For each block, whether something holds of it, such as `transfer.visible`. Some layers of blocks at
        a time, since a transfer function may take a hundred times their memory. `holds` is a tree
        (`eqx.Partial`), so that it is compiled once."""
        layers = max(1, AT_ONCE // self.low[0].size)
        found = []
        for begin in range(0, len(self.low), layers):
            some = slice(begin, begin + layers)
            found.append(np.asarray(_holding(holds, self.low[some], self.high[some])))
        return np.concatenate(found)

    def bricks_with(
        self, blocks: Bool[np.ndarray, "bx by bz"]
    ) -> Callable[[BrickGrid], Bool[np.ndarray, " bricks"]]:
        """A function that tells for each brick of a grid whether it has any of these blocks. It looks them up
        in a summed-volume table."""
        table = blocks.astype(np.int32)
        for axis in range(3):
            np.cumsum(table, axis, out=table)
        table = np.pad(table, ((1, 0),) * 3)

        def among(grid: BrickGrid) -> Bool[np.ndarray, " bricks"]:
            ends = []
            for size, n in zip(grid.size, grid.shape, strict=True):
                touched = [self._blocks_of(low, min(low + size, n - 1), n) for low in range(0, n - 1, size)]
                first, last = np.array(touched).T
                ends.append(((first, -1), (last + 1, 1)))
            number: Any = 0
            for corner in product(*ends):
                x, y, z = (index for index, _ in corner)
                number = number + math.prod(sign for _, sign in corner) * table[np.ix_(x, y, z)]
            return number.reshape(-1) > 0

        return among

    def _blocks_of(self, first: int, last: int, count: int) -> tuple[int, int]:
        """First and last block along an axis of `count` nodes, that together hold the nodes `first` to
        `last`."""
        final = -(-(count - 1) // self.cell) - 1
        begin = min(first // self.cell, final)
        return begin, min(max(begin, (last - 1) // self.cell), final)


def summary_of(source: VoxelSource, *, memory: int = 2**28, progress: Progress | None = None) -> Summary:
    """The summary of a source, from one pass over its voxels. The source keeps it for the next images, unless
    it is an array of NumPy or a memory map that is open for writing. Arrays of other libraries are assumed
    not to change: open a source again after writing to one.

    **Arguments:**

    - `source`: the voxels.
    - `memory`: bytes for the pass, beside the summary. It is exceeded where one chunk takes more.
    - `progress`: called after each part; what it raises ends the pass.

    **Returns:** the summary. It takes 2 / 16³ of the voxels' memory.

    **Raises:** `ValueError` for what `VoxelSource.read` raises it for, such as NaN, anywhere in the source.
    """
    if source._summary is not None:
        source.check_unchanged()
        return source._summary
    cell = CELL if min(source.shape) > CELL else BLOCK
    found = scan(source, cell, memory=memory, progress=progress)
    if source.is_constant:
        source._summary = found
    return found


def scan(source: VoxelSource, cell: int, *, memory: int = 2**28, progress: Progress | None = None) -> Summary:
    """As `summary_of`, by reading all voxels. `cell`: cells along the side of a block."""
    blocks = tuple(-(-(n - 1) // cell) for n in source.shape)
    limits = (jnp.iinfo if source.dtype.kind in "iu" else jnp.finfo)(source.dtype)
    low, high = np.full(blocks, limits.max, source.dtype), np.full(blocks, limits.min, source.dtype)
    done, order = 0, source.order
    for box, voxels in _parts(source, memory):
        done += voxels.size
        voxels = comparable(voxels)
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
    boxes = list(source.parts(((0, 0, 0), source.shape), min(memory // COPIES, MOST)))
    coming = in_background(source.read, *boxes[0], source.order)
    for box, following in zip(boxes, [*boxes[1:], None], strict=True):
        voxels = coming.result()
        if following is not None:
            coming = in_background(source.read, *following, source.order)
        yield box, voxels


def _over_blocks(
    voxels: np.ndarray, first: Axes, cell: int, combine: np.ufunc, counts: Axes
) -> tuple[np.ndarray, tuple[slice, slice, slice]]:
    """Ranges of the blocks that nodes from `first` on are part of, and the place of these among all. A node
    on a face is part of both blocks beside it. `counts`: of all blocks."""
    place = []
    for axis, (begin, count) in enumerate(zip(first, counts, strict=True)):
        end = begin + voxels.shape[axis]
        blocks = slice(max((begin - 1) // cell, 0), min((end - 1) // cell + 1, count))
        at = np.arange(blocks.start, blocks.stop) * cell + np.arange(cell + 1)[:, None]
        at = np.clip(at, begin, end - 1) - begin  # a node that is not there becomes one of the same block
        found = voxels.take(at[0], axis)
        for nodes in at[1:]:
            combine(found, voxels.take(nodes, axis), out=found)
        voxels = found
        place.append(blocks)
    return voxels, (place[0], place[1], place[2])


@eqx.filter_jit
def _holding(holds: Callable[[Blocks], Any], low: Array | np.ndarray, high: Array | np.ndarray) -> Array:
    least, most = widened(jnp.asarray(low), jnp.asarray(high))
    return holds(Blocks(least, most, None))
