"""In which order are all voxels of a source read once, with bounded memory?

A source is cut into columns, which are read slab by slab along the axis where a layer of chunks is smallest.
Slabs end where chunks do, and what the next slab needs of this one is kept, so that a chunk is read once in
its column.
"""

import math
from collections.abc import Iterator
from concurrent.futures import Future
from itertools import pairwise, product
from typing import NamedTuple, TypeVar

import numpy as np

from ..occupancy import BLOCK
from .sources import VoxelSource


T = TypeVar("T")

COPIES = 8
"""Slabs in memory at once, at most: this one, as read and with what was kept of the one before; the next; and
what finding the extremes of blocks takes."""


class Slab(NamedTuple):
    """A part of a volume that is read at once.

    - `voxels`: those of its blocks, with the nodes on all their faces; with its axes in the source's `order`.
    - `first`: index of its first block along each axis, and `blocks`: number of blocks.
    """

    voxels: np.ndarray
    first: tuple[int, int, int]
    blocks: tuple[int, int, int]


def slabs(source: VoxelSource, memory: int) -> Iterator[Slab]:
    """Cut a source into slabs of whole blocks of BLOCK³ cells, of which each is in one slab.

    `memory`: bytes for what is computed of a slab; it is exceeded if a single chunk exceeds it.
    """
    axis = _axis(source)
    extent = _extent(source, axis, memory)
    cuts = [[*range(0, n - 1, step), n - 1] for n, step in zip(source.shape, extent, strict=True)]
    columns = product(*_with([list(pairwise(cut)) for cut in cuts], axis, [(0, 0)]))
    for column in columns:
        yield from _column(source, axis, extent[axis], column)


def _column(source: VoxelSource, axis: int, step: int, nodes: tuple[tuple[int, int], ...]) -> Iterator[Slab]:
    """The slabs of the blocks between these first and last nodes across `axis`, along which they are read."""
    length, stored = source.shape[axis], source.order.index(axis)
    ends = [*range(step, length - 1, step), length]
    low, high = [first for first, _ in nodes], [last + 1 for _, last in nodes]

    def reading(begin: int, end: int) -> "Future[np.ndarray]":
        return source.read_async(_with(low, axis, begin), _with(high, axis, end), source.order)

    coming, kept = reading(0, ends[0]), None
    begin = done = 0  # the first voxel kept, and the blocks done
    for end, following in zip(ends, [*ends[1:], None], strict=True):
        new = coming.result()
        if following is not None:
            coming = reading(end, following)
        voxels = new if kept is None else np.concatenate([kept, new], stored)
        # blocks that are complete
        blocks = -(-(length - 1) // BLOCK) if following is None else (end - 1) // BLOCK
        if blocks > done:
            last = min(length, BLOCK * blocks + 1)
            spans = [(first // BLOCK, -(-final // BLOCK)) for first, final in nodes]
            (x0, x1), (y0, y1), (z0, z1) = _with(spans, axis, (done, blocks))
            yield Slab(
                _along(voxels, stored, 0, last - begin),
                (x0, y0, z0),
                (x1 - x0, y1 - y0, z1 - z0),
            )
            done = blocks
        needed = BLOCK * done
        kept, begin = _along(voxels, stored, needed - begin, end - begin), needed


def _with(of_axes: list[T], axis: int, one: T) -> list[T]:
    return [one if a == axis else other for a, other in enumerate(of_axes)]


def _along(voxels: np.ndarray, axis: int, begin: int, end: int) -> np.ndarray:
    return voxels[tuple(slice(begin, end) if a == axis else slice(None) for a in range(3))]


def _axis(source: VoxelSource) -> int:
    """The axis along which one layer of chunks has the fewest voxels."""
    return int(np.argmax([n / c for n, c in zip(source.shape, source.chunks, strict=True)]))


def _extent(source: VoxelSource, axis: int, memory: int) -> list[int]:
    """Voxels of a slab along each axis: multiples of BLOCK, and of chunks where memory allows."""
    steps = [-(-c // BLOCK) * BLOCK for c in source.chunks]

    def cost(extent: list[int]) -> int:
        x, y, z = (min(e + BLOCK, n) for e, n in zip(extent, source.shape, strict=True))
        return COPIES * source.dtype.itemsize * x * y * z

    extent = [-(-n // BLOCK) * BLOCK for n in source.shape]
    thinnest = min(max(steps[axis], 2 * BLOCK), extent[axis])
    extent[axis] = thinnest
    others = [a for a in range(3) if a != axis]
    for least in (steps, [BLOCK] * 3):  # whole chunks first, then parts of them
        while cost(extent) > memory:
            a = max(others, key=lambda a: extent[a] / least[a])
            if extent[a] <= least[a]:
                break
            extent[a] = max(least[a], math.ceil(extent[a] / 2 / least[a]) * least[a])
        if cost(extent) <= memory:
            break
    while cost(extent) > memory and extent[axis] > 2 * BLOCK:
        extent[axis] = max(2 * BLOCK, extent[axis] // 2 // BLOCK * BLOCK)
    while extent[axis] < source.shape[axis]:
        more = _with(extent, axis, extent[axis] + thinnest)
        if cost(more) > memory:
            break
        extent = more
    return extent
