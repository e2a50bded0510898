"""Ranges of the values in blocks of a source, from one pass over it, so that empty bricks are not read."""

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
from .grid import BrickGrid
from .sources import READERS, VoxelSource


CELL = 16  # cells along the side of a block, if the volume has more
AT_ONCE = 2**18  # blocks that are tested at a time, but at least a layer of them
COPIES = 8  # copies of the voxels of a read: the voxels, the next ones, and temporary arrays of the search
MAX_BYTES = 2**25  # bytes of voxels of a read, but at least a chunk: larger ones exceed the CPU's caches


@dataclass(frozen=True)
class Summary:
    """Ranges of the voxels in each block of `cell`³ cells, including the nodes on its faces."""

    cell: int
    low: np.ndarray
    high: np.ndarray

    def bricks_where(self, holds: Callable[[Blocks], Any], grid: BrickGrid) -> Bool[np.ndarray, " bricks"]:
        """Mask of the bricks with a block for which `holds`, an `eqx.Partial` compiled once, is true."""
        layers = max(1, AT_ONCE // self.low[0].size)  # a transfer function may need 100 times their memory
        parts = [slice(begin, begin + layers) for begin in range(0, len(self.low), layers)]
        blocks = np.concatenate([_holding(holds, self.low[part], self.high[part]) for part in parts])
        for axis, (size, n) in enumerate(zip(grid.size, grid.shape, strict=True)):
            ends = [(low, min(low + size, n - 1)) for low in range(0, n - 1, size)]
            within = np.moveaxis(blocks, axis, 0)
            bricks = [within[a // self.cell : (b - 1) // self.cell + 1].any(axis=0) for a, b in ends]
            blocks = np.stack(bricks, axis)
        return blocks.reshape(-1)


def summary_of(source: VoxelSource, *, memory: int = 2**28) -> Summary:
    """Summary of a source, computed once. `memory`: bytes of the pass, which a chunk may exceed."""
    if source._summary is not None:
        source.check_unchanged()
        return source._summary
    source._summary = scan(source, CELL if min(source.shape) > CELL else BLOCK, memory=memory)
    return source._summary


def scan(source: VoxelSource, cell: int, *, memory: int = 2**28) -> Summary:
    """Summary in blocks of `cell`³ cells. The next voxels are read while the last are searched."""
    order, shape = source.order, tuple(-(-(n - 1) // cell) for n in source.shape)
    limits = (jnp.iinfo if source.dtype.kind in "iu" else jnp.finfo)(source.dtype)
    low, high = np.full(shape, limits.max, source.dtype), np.full(shape, limits.min, source.dtype)
    boxes = list(source.boxes(((0, 0, 0), source.shape), min(memory // COPIES, MAX_BYTES)))
    coming = READERS.submit(source.read, *boxes[0], order)
    for (begin, end), following in zip(boxes, [*boxes[1:], None], strict=True):
        voxels = coming.result()
        if following is not None:
            coming = READERS.submit(source.read, *following, order)
        if voxels.itemsize == 2 and voxels.dtype.kind not in "iu":
            voxels = voxels.astype(np.float32)  # NumPy finds its extremes many times faster
        # a node on a face belongs to the blocks on both sides
        blocks = tuple(
            slice(max((a - 1) // cell, 0), min((b - 1) // cell + 1, n))
            for a, b, n in zip(begin, end, shape, strict=True)
        )
        for ranges, combine in ((low, np.minimum), (high, np.maximum)):
            extremes = _over_blocks(voxels, permuted(begin, order), permuted(blocks, order), cell, combine)
            extremes = extremes.transpose(inverse(order)).astype(source.dtype)
            ranges[blocks] = combine(ranges[blocks], extremes)
    give_back()
    return Summary(cell, low, high)


def _over_blocks(
    voxels: np.ndarray, first: Axes, blocks: tuple[slice, ...], cell: int, combine: np.ufunc
) -> np.ndarray:
    """Extremes of the voxels of each block. `first`: the node of the first voxel."""
    for axis, (begin, block) in enumerate(zip(first, blocks, strict=True)):
        at = np.arange(block.start, block.stop) * cell + np.arange(cell + 1)[:, None] - begin
        at = np.clip(at, 0, voxels.shape[axis] - 1)  # a missing node becomes one of the same block
        extremes = voxels.take(at[0], axis)
        for nodes in at[1:]:
            combine(extremes, voxels.take(nodes, axis), out=extremes)
        voxels = extremes
    return voxels


@eqx.filter_jit
def _holding(holds: Callable[[Blocks], Any], low: Array | np.ndarray, high: Array | np.ndarray) -> Array:
    low, high = map(jnp.asarray, widened(low, high))
    return holds(Blocks(low, high, None))
