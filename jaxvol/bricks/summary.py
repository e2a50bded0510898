"""Which values occur where in a source? Ranges of its blocks, found in one pass over all voxels.

From these, a renderer tells which bricks are empty without reading them. They are the ranges that
`occupancy.Blocks` has of a volume in memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._util.axes import inverse
from .._util.checks import integer
from .._util.memory import give_back
from ..occupancy import BLOCK, Blocks, over_blocks, widened
from .dtypes import is_half
from .sources import Corner, VoxelSource
from .streaming import slabs


COMBINED = {"low": np.minimum, "high": np.maximum}
"""Each kind of range, and how those of two blocks are combined."""

AT_ONCE = 2**18
"""Blocks that are looked through at a time, if a layer of them has no more."""

LAYERS = 8
"""Layers of blocks of 16-bit floats that are converted at a time."""

Progress = Callable[[int, int], Any]
"""Called with the number of voxels done and the number of all."""


@dataclass(frozen=True)
class Summary:
    """Ranges of the voxels in each block of `cell`³ cells, including the nodes on its faces.

    - `shape`: of the volume, in voxels.
    - `cell`: cells along the side of a block, a multiple of `occupancy.BLOCK`.
    - `ranges`: `low`, `high`: least and greatest voxel, in the voxels' type, (bx, by, bz).
    """

    shape: tuple[int, int, int]
    cell: int
    ranges: dict[str, np.ndarray]

    @property
    def nbytes(self) -> int:
        """Bytes of all ranges."""
        return sum(each.nbytes for each in self.ranges.values())

    def range_of(self, low: Corner, high: Corner) -> tuple[float, float]:
        """A range that holds all voxels with `low` <= (x, y, z) < `high`: the range of the blocks that hold
        these. Interpolation between them stays within it up to rounding (`occupancy.ROUNDING`)."""
        touched = tuple(
            slice(first, last + 1)
            for first, last in (
                self.blocks_of(int(a), int(b) - 1, n) for a, b, n in zip(low, high, self.shape, strict=True)
            )
        )
        return float(self.ranges["low"][touched].min()), float(self.ranges["high"][touched].max())

    def where(self, holds: Callable[[Blocks], Any]) -> np.ndarray:
        """For each block, whether something holds of it, such as `transfer.visible`: some layers of them at a
        time, since a transfer function may take a hundred times their memory. `holds` is a
        tree (`eqx.Partial`): a new lambda would be compiled anew."""
        low, high = self.ranges["low"], self.ranges["high"]
        layers = max(1, AT_ONCE // low[0].size)
        found = []
        for begin in range(0, len(low), layers):
            some = slice(begin, begin + layers)
            found.append(np.asarray(_holding(holds, low[some], high[some])))
        return np.concatenate(found)

    def blocks(self, low: Corner | None = None, high: Corner | None = None) -> Blocks:
        """The `Blocks` of the volume, or of the voxels with `low` <= (x, y, z) < `high` as a volume of their
        own. They have no slopes.

        They equal those of the voxels in memory if `cell` is `occupancy.BLOCK` and the box is the volume.
        Otherwise each range holds all voxels of its block, and others around it: up to `cell` away."""
        found = self._of_box(low, high)
        least, most = widened(jnp.asarray(found["low"]), jnp.asarray(found["high"]))
        return Blocks(least, most, None)

    def _of_box(self, low: Corner | None, high: Corner | None) -> dict[str, np.ndarray]:
        """Ranges of the blocks of BLOCK³ cells of a box of voxels."""
        found = self.ranges
        first, last = (0, 0, 0) if low is None else low, self.shape if high is None else high
        for axis in range(3):
            begin, end, n = int(first[axis]), int(last[axis]), self.shape[axis]
            nodes = range(begin, end - 1, BLOCK)
            touched = [self.blocks_of(node, min(node + BLOCK, end - 1), n) for node in nodes]
            found = {
                name: over_intervals(part, axis, touched, COMBINED[name]) for name, part in found.items()
            }
        return found

    def blocks_of(self, first: int, last: int, count: int) -> tuple[int, int]:
        """First and last block along an axis of `count` nodes, that together hold the nodes `first` to
        `last`."""
        final = -(-(count - 1) // self.cell) - 1
        begin = min(first // self.cell, final)
        return begin, min(max(begin, (last - 1) // self.cell), final)


def over_intervals(
    values: np.ndarray, axis: int, intervals: Sequence[tuple[int, int]], combine: np.ufunc
) -> np.ndarray:
    """Combine the entries of each interval along an axis, from its first to its last."""
    first, last = np.array(intervals).T
    found = np.take(values, first, axis)
    for offset in range(1, int(np.max(last - first)) + 1):
        found = combine(found, np.take(values, np.minimum(first + offset, last), axis))
    return found


def scan(
    source: VoxelSource,
    cell: int | Any = BLOCK,
    *,
    memory: int = 2**28,
    progress: Progress | None = None,
) -> Summary:
    """The summary of a source, from one pass over its voxels. `summary_of` keeps it in a file.

    **Arguments:**

    - `cell`: cells along the side of a block, a multiple of `occupancy.BLOCK`. A summary takes
      2 / `cell`³ of the voxels' memory.
    - `memory`: bytes for the pass, beside the summary. It is exceeded where one chunk of the source does.
    - `progress`: called after each slab; what it raises ends the pass.

    **Raises:** `ValueError` for what `VoxelSource.read` raises it for, such as NaN, anywhere in the source.
    """
    cell = integer("cell", cell, BLOCK)
    if cell % BLOCK:
        raise ValueError(f"cell must be a multiple of {BLOCK}; got {cell}.")
    blocks = tuple(-(-(n - 1) // cell) for n in source.shape)
    ranges: dict[str, np.ndarray] = {}
    done, whole = 0, int(np.prod([-(-(n - 1) // BLOCK) for n in source.shape], dtype=np.int64))
    nx, ny, nz = source.shape
    for slab in slabs(source, memory):
        for name, combine in COMBINED.items():
            # by NumPy: to compile for each shape of a slab takes longer, and memory
            part = _over_blocks(slab.voxels, combine).transpose(inverse(source.order))
            merged, place = _merged(part, slab.first, cell // BLOCK, combine)
            if name not in ranges:
                ranges[name] = np.full(blocks, _neutral(part.dtype, combine), part.dtype)
            ranges[name][place] = combine(ranges[name][place], merged)
        done += int(np.prod(slab.blocks))
        if progress is not None:
            progress(done * (nx * ny * nz) // whole, nx * ny * nz)
    give_back()
    return Summary(source.shape, cell, ranges)


def _over_blocks(voxels: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Combines the nodes of each block. NumPy compares 16-bit floats one by one, and float32 in a fraction of
    the time, which they become layer by layer."""
    if not is_half(voxels.dtype):
        return over_blocks(voxels, combine)
    thick = LAYERS * BLOCK
    starts = range(0, len(voxels) - 1, thick)
    parts = [over_blocks(voxels[i : i + thick + 1].astype(np.float32), combine) for i in starts]
    return np.concatenate(parts).astype(voxels.dtype)


def _merged(
    part: np.ndarray, first: tuple[int, int, int], several: int, combine: np.ufunc
) -> tuple[np.ndarray, tuple[Any, ...]]:
    """Ranges of blocks that are `several` times as long, as far as `part`, from block `first` on, tells; and
    their place among all."""
    place = []
    for axis, begin in enumerate(first):
        block = np.arange(begin, begin + part.shape[axis]) // several
        starts = np.flatnonzero(np.diff(block, prepend=-1))
        part = combine.reduceat(part, starts, axis)
        place.append(slice(block[0], block[-1] + 1))
    return part, tuple(place)


def _neutral(dtype: np.dtype, combine: np.ufunc) -> Any:
    limits = jnp.iinfo(dtype) if dtype.kind in "iu" else jnp.finfo(dtype)
    return limits.max if combine is np.minimum else limits.min


@eqx.filter_jit
def _holding(holds: Callable[[Blocks], Any], low: Array | np.ndarray, high: Array | np.ndarray) -> Array:
    least, most = widened(jnp.asarray(low), jnp.asarray(high))
    return holds(Blocks(least, most, None))
