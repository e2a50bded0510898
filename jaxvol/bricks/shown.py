"""Which voxels of a brick are read? Those near which anything may be visible.

Most of a volume shows nothing: air, or what a transfer function leaves out. Rays leap over it, but for cells
that are taken together with visible ones. Such voxels are not read. In their place stands a value that is as
invisible, and so is everything interpolated between it and the voxels that were read.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._util.xla import compiled
from ..compositing import Compositing, Over
from ..engine.scene import Scene
from ..occupancy import Blocks, widened
from ..transfer import Transfer
from .dtypes import Box
from .grid import Node
from .sources import empty_box
from .summary import Summary


KINDS = 8
"""Ranges of invisible values that are told apart; where there are more of them, all voxels are read."""

TRIED = 64
"""Ranges of values that are looked up at a time."""

Visible = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Whether anything may be visible in each range, from its least and its greatest value, (bx, by, bz)."""


@dataclass(frozen=True)
class Shown:
    """The blocks of a summary that are read, and what stands in place of the others. A node belongs to the
    last block that holds it.

    - `kind`: for each block, READ, or which of `values` stands in its place, the first one for most.
    """

    summary: Summary
    kind: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, marched: Scene, summary: Summary, margin: Node) -> "Shown | None":
        """What a scene shows, as its rays are marched. `margin`: nodes along each axis that are read around a
        cell. None where all voxels are read: where rays do not leap, or samples are placed by what lies ahead
        of them, or what is invisible may count.

        Two ranges that a node shares overlap, so that with both of them everything between is invisible: one
        value of either may stand for all voxels of both."""
        march, mode, low, high = marched.march, marched.compositing, *summary.ranges.values()
        if not march.leaps or march.looks_ahead or not isinstance(mode, Over):
            return None

        def visible(low: np.ndarray, high: np.ndarray) -> np.ndarray:
            ends = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)
            return np.asarray(_occupied(mode, marched.transfer, *ends))

        read = visible(low, high)
        for axis, m in enumerate(margin):
            read = _dilated(read, axis, -(-m // summary.cell))
        kinds = _kinds(low[~read], high[~read], visible)
        if kinds is None:
            return None
        kind = np.full(low.shape, READ, np.int8)
        kind[~read], values = kinds
        return cls(summary, kind, values)

    def boxes(self, low: np.ndarray, high: np.ndarray, chunks: Node) -> list[Box]:
        """Boxes that hold all voxels that are read between these nodes, `high` exclusive. No two of
        them share a chunk of the source, and each is cut to the blocks in it."""
        cuts = []
        for a, b, chunk in zip(low.tolist(), high.tolist(), chunks, strict=True):
            step = chunk * max(1, self.summary.cell // chunk)
            cuts.append([a, *range((a // step + 1) * step, b, step), b])
        if all(len(cut) > 2 for cut in cuts):  # rows of chunks, of which several are decoded at a time
            longest = int(np.argmax([len(cut) for cut in cuts]))
            cuts[longest] = [cuts[longest][0], cuts[longest][-1]]
        parts = product(*(list(pairwise(cut)) for cut in cuts))
        return [box for part in parts if (box := self._cut(part)) is not None]

    def _cut(self, part: tuple[tuple[int, int], ...]) -> Box | None:
        """The smallest box of blocks that are read, as far as it lies between these nodes along each axis."""
        found = [self._blocks(begin, end, axis) for axis, (begin, end) in enumerate(part)]
        read = self.kind[tuple(slice(first, last + 1) for first, last in found)] == READ
        low, high = [], []
        for axis, ((begin, end), (first, _)) in enumerate(zip(part, found, strict=True)):
            there = first + np.flatnonzero(read.any(axis=tuple(a for a in range(3) if a != axis)))
            if not len(there):
                return None
            least, most = self._nodes(int(there[0]), int(there[-1]), axis)
            low.append(max(begin, least))
            high.append(min(end, most))
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])

    def unread(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """An array for the voxels between these nodes, `high` exclusive, with what stands in place of those
        that are not read."""
        voxels = empty_box(low, high, self.values.dtype, self.values[0])
        (x0, x1), (y0, y1), (z0, z1) = (
            self._blocks(int(a), int(b), axis) for axis, (a, b) in enumerate(zip(low, high, strict=True))
        )
        columns = self.kind[x0 : x1 + 1, y0 : y1 + 1, z0 : z1 + 1]
        for i, j in np.argwhere((columns > 0).any(axis=2)).tolist():
            column = columns[i, j]
            starts = np.flatnonzero(np.diff(column, prepend=READ))
            for k, after in pairwise([*starts.tolist(), len(column)]):
                if column[k] > 0:
                    ends = ((x0 + i,) * 2, (y0 + j,) * 2, (z0 + k, z0 + after - 1))
                    place = [self._nodes(*end, axis) for axis, end in enumerate(ends)]
                    inside = tuple(
                        slice(max(a - int(begin), 0), b - int(begin))
                        for (a, b), begin in zip(place, low, strict=True)
                    )
                    voxels[inside] = self.values[column[k]]
        return voxels

    def _blocks(self, begin: int, end: int, axis: int) -> tuple[int, int]:
        """First and last block to which nodes belong, `end` exclusive."""
        last = self.kind.shape[axis] - 1
        return min(begin // self.summary.cell, last), min((end - 1) // self.summary.cell, last)

    def _nodes(self, first: int, last: int, axis: int) -> tuple[int, int]:
        """First node of these blocks, and the one behind their last."""
        cell, n = self.summary.cell, self.summary.shape[axis]
        return first * cell, n if last == self.kind.shape[axis] - 1 else (last + 1) * cell


READ = -1
"""In place of a kind: blocks that are read."""


@compiled
def _occupied(mode: Compositing[Any], transfer: Transfer, low: Any, high: Any) -> Any:
    return mode.occupied(transfer, Blocks(*widened(low, high), None))


def _dilated(blocks: np.ndarray, axis: int, by: int) -> np.ndarray:
    """The blocks, and so many before and behind each of them."""
    found = blocks.copy()
    for offset in range(1, min(by, blocks.shape[axis] - 1) + 1):
        before, behind = ([slice(None)] * 3 for _ in range(2))
        before[axis], behind[axis] = slice(None, -offset), slice(offset, None)
        found[tuple(before)] |= blocks[tuple(behind)]
        found[tuple(behind)] |= blocks[tuple(before)]
    return found


def _kinds(low: np.ndarray, high: np.ndarray, visible: Visible) -> tuple[np.ndarray, np.ndarray] | None:
    """For ranges in which nothing is visible, which of them lie in one such range, and a value of each of
    these; the one that holds most ranges is first. None if there are no ranges, or more than KINDS."""
    order = np.argsort(low, kind="stable")
    least, most = low[order].astype(np.float32), np.maximum.accumulate(high[order].astype(np.float32))
    begins = [0]
    while begins[-1] < len(order):
        if len(begins) > KINDS:
            return None
        begins.append(_end(least[begins[-1]], most, begins[-1], visible))
    if len(begins) < 2:
        return None
    counts = np.diff(begins)
    rank = np.empty(len(counts), np.int8)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(counts))
    values = np.empty(len(counts), low.dtype)
    for number, (begin, end) in enumerate(pairwise(begins)):
        zero = np.zeros((), np.float32)
        ends = np.minimum(zero, least[begin]), np.maximum(zero, most[end - 1])
        with_zero = visible(*(np.full((TRIED, 1, 1), each) for each in ends)).any()
        # memory that is 0 is not touched before something is written there
        values[rank[number]] = low[order[begin]] if with_zero else 0
    kind = np.empty(len(order), np.int8)
    kind[order] = np.repeat(rank, counts)
    return kind, values


def _end(least: np.float32, most: np.ndarray, begin: int, visible: Visible) -> int:
    """The first of these values, behind `begin`, for which something is visible between it and `least`; their
    number if there is none. They grow."""
    end = len(most)  # nothing is visible up to `begin`
    while end - begin > 1:
        tried = np.linspace(begin + 1, end, TRIED + 1, dtype=int)[:-1]
        low = np.full((TRIED, 1, 1), least)
        seen = visible(low, most[tried].reshape(-1, 1, 1)).reshape(-1)
        first = int(np.argmax(seen)) if seen.any() else TRIED
        if first == TRIED:
            begin = int(tried[-1])
        else:
            begin, end = (int(tried[first - 1]) if first else begin), int(tried[first])
    return end
