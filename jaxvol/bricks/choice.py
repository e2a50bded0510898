"""Into which bricks is a volume split, so that little is read of it?

Where rays are straight, any split shows the same image. Bricks that follow the shape of what is visible leave
out more of what is not; rows of a file that are cut are read with their gaps; and each brick takes time for
all rays.
"""

import math
from collections.abc import Iterator

import numpy as np

from .grid import BrickGrid, Node
from .sources import VoxelSource
from .split import EDGE, Margin, fits, rounded, stored_of
from .summary import Summary


PER_RAY = 100
"""Bytes that could be read, and looked through, in the time that a brick takes for a ray that misses it: on a
CPU, of 512 x 512 rays."""

MORE = 2
"""How many times as many bricks are tried as fit into memory."""


def cheapest(
    grid: BrickGrid,
    source: VoxelSource,
    summary: Summary,
    occupied: np.ndarray,
    margin: Margin,
    memory: int,
    rays: int,
    least: int = 1,
) -> BrickGrid:
    """The split of the volume of which least is read, among those into no more than MORE times as many bricks
    as `grid` has, and at least `least`, that fit into `memory`. `occupied`: blocks of the summary in which
    anything may be visible."""

    def cost(grid: BrickGrid) -> int:
        stored = stored_of(grid, margin, None)
        each = source.touched(stored) + math.prod(stored) * source.dtype.itemsize + PER_RAY * rays
        return each * int(visible(grid, summary, occupied).sum())

    tried = [other for other in _others(grid, source, margin, memory) if other.number >= least]
    return min([grid, *tried], key=cost)


def visible(grid: BrickGrid, summary: Summary, occupied: np.ndarray) -> np.ndarray:
    """For each brick, whether anything may be visible in it."""
    found = occupied
    for axis, (size, n) in enumerate(zip(grid.size, grid.shape, strict=True)):
        ends = [(low, min(low + size, n - 1)) for low in range(0, n - 1, size)]
        touched = [summary.touched(low, high, n) for low, high in ends]
        parts = [found.take(range(a, b + 1), axis).any(axis, keepdims=True) for a, b in touched]
        found = np.concatenate(parts, axis)
    return found.reshape(-1)


def _others(grid: BrickGrid, source: VoxelSource, margin: Margin, memory: int) -> Iterator[BrickGrid]:
    """Splits that fit: with any numbers of parts along two axes, and along the third as few as may be."""
    cells = [n - 1 for n in grid.shape]
    most = [max(1, -(-c // EDGE)) for c in cells]
    seen = set[Node]()
    for third in range(3):
        a, b = (axis for axis in range(3) if axis != third)
        for i in range(1, most[a] + 1):
            for j in range(1, min(most[b], MORE * grid.number // i) + 1):
                for k in range(1, min(most[third], MORE * grid.number // (i * j)) + 1):
                    parts = {a: i, b: j, third: k}
                    x, y, z = (rounded(-(-c // parts[axis]), c) for axis, c in enumerate(cells))
                    other = BrickGrid(grid.shape, (x, y, z))
                    if fits(stored_of(other, margin, None), source.dtype, margin, memory):
                        if other.size not in seen:
                            seen.add(other.size)
                            yield other
                        break
