"""Into which bricks is a volume split, so that little is read of it?

Where rays are straight, any split shows the same image. Bricks that follow the shape of what is visible leave
out more of what is not; rows of a file that are cut are read with their gaps; and each brick takes time for
all rays.
"""

import math
from collections.abc import Iterator
from itertools import product
from typing import Any

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
    table: np.ndarray,
    margin: Margin,
    memory: int,
    rays: int,
    least: int = 1,
) -> BrickGrid:
    """The split of the volume that takes the least time to read and to march, as far as that is known, among
    those into no more than MORE times as many bricks as `grid` has that fit into `memory`. `table`: of what
    may be visible (`counts`). `least`: devices that take a brick each at a time, and the least number of
    bricks."""

    def cost(other: BrickGrid) -> int:
        stored = stored_of(other, margin, None)
        each = source.bytes_touched(stored) + math.prod(stored) * source.dtype.itemsize + PER_RAY * rays
        return each * -(-int(visible(other, summary, table).sum()) // least)

    tried = [other for other in _others(grid, source, margin, memory) if other.number >= least]
    return min([grid, *tried], key=cost)


def counts(occupied: np.ndarray) -> np.ndarray:
    """How many blocks before each one along all axes may hold anything visible: a summed-volume table, of one
    entry more along each axis."""
    table = occupied.astype(np.int32)
    for axis in range(3):
        np.cumsum(table, axis, out=table)
    return np.pad(table, ((1, 0),) * 3)


def visible(grid: BrickGrid, summary: Summary, table: np.ndarray) -> np.ndarray:
    """For each brick, whether anything may be visible in it. `table`: `counts` of the summary's blocks."""
    ends = []
    for size, n in zip(grid.size, grid.shape, strict=True):
        touched = [summary.blocks_of(low, min(low + size, n - 1), n) for low in range(0, n - 1, size)]
        first, last = np.array(touched).T
        ends.append(((first, -1), (last + 1, 1)))
    number: Any = 0
    for corner in product(*ends):
        x, y, z = (index for index, _ in corner)
        number = number + math.prod(sign for _, sign in corner) * table[np.ix_(x, y, z)]
    return number.reshape(-1) > 0


def _others(grid: BrickGrid, source: VoxelSource, margin: Margin, memory: int) -> Iterator[BrickGrid]:
    """Splits that fit: of any sizes along two axes, and of the largest that fits along the third."""
    sizes = [_sizes(n - 1) for n in grid.shape]
    most, seen = MORE * grid.number, set[Node]()
    for third in range(3):
        a, b = (axis for axis in range(3) if axis != third)
        for along_a, along_b in product(sizes[a], sizes[b]):
            for along_third in sizes[third]:
                by_axis = {a: along_a, b: along_b, third: along_third}
                other = BrickGrid(grid.shape, (by_axis[0], by_axis[1], by_axis[2]))
                if other.number > most or other.size in seen:
                    break
                if fits(stored_of(other, margin, None), source.dtype, margin, memory):
                    seen.add(other.size)
                    yield other
                    break


def _sizes(cells: int) -> list[int]:
    """Sizes of bricks along an axis of so many cells, one for each number of parts, the largest first."""
    parts = range(1, max(1, -(-cells // EDGE)) + 1)
    return sorted({rounded(-(-cells // part), cells) for part in parts}, reverse=True)
