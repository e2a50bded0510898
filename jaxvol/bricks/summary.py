"""Which values occur where in a source? Ranges of its blocks, found in one pass over all voxels. They tell
which bricks are empty without reading them, as `occupancy.Blocks` does of a volume in memory."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._util.axes import Axes, inverse, permuted
from .._util.memory import give_back
from ..scene.occupancy import BLOCK, Blocks, widened
from .conversion import comparable
from .grid import BrickGrid
from .sources import READERS, Corner, VoxelSource


CELL = 16
"""Cells along the side of a block, if the volume has more."""

AT_ONCE = 2**18
"""Blocks that are looked through at a time, if a layer of them has no more."""

COPIES = 8
"""Of the voxels that are read at a time: these, the next ones, and what finding their ranges takes."""

MOST = 2**25
"""Bytes of voxels that are read at a time, if a chunk has no more: larger parts leave the caches."""


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
        """Range of the blocks that hold the voxels with `low` <= (x, y, z) < `high`. Interpolation between
        these stays within it up to rounding (`occupancy.ROUNDING`)."""
        ends = zip(low, high, self.shape, strict=True)
        touched = tuple(self._blocks_of(int(a), int(b) - 1, n) for a, b, n in ends)
        return float(self.low[touched].min()), float(self.high[touched].max())

    def where(self, holds: Callable[[Blocks], Any]) -> Bool[np.ndarray, "bx by bz"]:
        """For each block, whether something holds of it, such as `transfer.visible`. Some layers of blocks at
        a time, since a transfer function may take a hundred times their memory. `holds` is a tree
        (`eqx.Partial`), so that it is compiled once."""
        layers = max(1, AT_ONCE // self.low[0].size)
        some = [slice(begin, begin + layers) for begin in range(0, len(self.low), layers)]
        return np.concatenate([_holding(holds, self.low[each], self.high[each]) for each in some])

    def bricks_with(
        self, blocks: Bool[np.ndarray, "bx by bz"], grid: BrickGrid
    ) -> Bool[np.ndarray, " bricks"]:
        """For each brick, whether it has any of these blocks."""
        for axis, (size, n) in enumerate(zip(grid.size, grid.shape, strict=True)):
            bricks = [self._blocks_of(low, min(low + size, n - 1), n) for low in range(0, n - 1, size)]
            within = np.moveaxis(blocks, axis, 0)
            blocks = np.stack([within[brick].any(axis=0) for brick in bricks], axis)
        return blocks.reshape(-1)

    def _blocks_of(self, first: int, last: int, count: int) -> slice:
        """The blocks along an axis of `count` nodes that together hold the nodes `first` to `last`."""
        final = -(-(count - 1) // self.cell) - 1
        begin = min(first // self.cell, final)
        return slice(begin, min(max(begin, (last - 1) // self.cell), final) + 1)


def summary_of(source: VoxelSource, *, memory: int = 2**28) -> Summary:
    """The summary of a source, from one pass over its voxels. The source keeps it if it `is_constant`; open
    it again after writing to it.

    **Arguments:**

    - `source`: the voxels.
    - `memory`: bytes for the pass, beside the summary. It is exceeded where one chunk takes more.

    **Returns:** the summary. It takes 2 / 16³ of the voxels' memory.

    **Raises:** `ValueError` for what `VoxelSource.read` raises it for, such as NaN, anywhere in the source.
    """
    if source._summary is not None:
        source.check_unchanged()
        return source._summary
    cell = CELL if min(source.shape) > CELL else BLOCK
    found = scan(source, cell, memory=memory)
    if source.is_constant:
        source._summary = found
    return found


def scan(source: VoxelSource, cell: int, *, memory: int = 2**28) -> Summary:
    """As `summary_of`, by reading all voxels in slabs, each while the one before is looked at. `cell`: cells
    along the side of a block."""
    order, shape = source.order, tuple(-(-(n - 1) // cell) for n in source.shape)
    limits = (jnp.iinfo if source.dtype.kind in "iu" else jnp.finfo)(source.dtype)
    low, high = np.full(shape, limits.max, source.dtype), np.full(shape, limits.min, source.dtype)
    boxes = list(source.parts(((0, 0, 0), source.shape), min(memory // COPIES, MOST)))
    coming = READERS.submit(source.read, *boxes[0], order)
    for (begin, end), following in zip(boxes, [*boxes[1:], None], strict=True):
        voxels = comparable(coming.result())
        if following is not None:
            coming = READERS.submit(source.read, *following, order)
        # a node on a face is part of both blocks beside it
        blocks = tuple(
            slice(max((a - 1) // cell, 0), min((b - 1) // cell + 1, n))
            for a, b, n in zip(begin, end, shape, strict=True)
        )
        for ranges, combine in ((low, np.minimum), (high, np.maximum)):
            found = _over_blocks(voxels, permuted(begin, order), permuted(blocks, order), cell, combine)
            found = found.transpose(inverse(order)).astype(source.dtype)
            ranges[blocks] = combine(ranges[blocks], found)
    give_back()
    return Summary(source.shape, cell, low, high)


def _over_blocks(
    voxels: np.ndarray, first: Axes, blocks: tuple[slice, ...], cell: int, combine: np.ufunc
) -> np.ndarray:
    """Extremes of the nodes from `first` on that are in each of these blocks."""
    for axis, (begin, each) in enumerate(zip(first, blocks, strict=True)):
        at = np.arange(each.start, each.stop) * cell + np.arange(cell + 1)[:, None] - begin
        at = np.clip(at, 0, voxels.shape[axis] - 1)  # a node that is not there becomes one of the same block
        found = voxels.take(at[0], axis)
        for nodes in at[1:]:
            combine(found, voxels.take(nodes, axis), out=found)
        voxels = found
    return voxels


@eqx.filter_jit
def _holding(holds: Callable[[Blocks], Any], low: Array | np.ndarray, high: Array | np.ndarray) -> Array:
    least, most = widened(jnp.asarray(low), jnp.asarray(high))
    return holds(Blocks(least, most, None))
