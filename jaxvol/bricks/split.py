"""How large may bricks be, and how much larger are they read than they are?"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._util.checks import integer
from ..engine.scene import Scene
from ..march import RUN, March
from ..occupancy import BLOCK
from ..transforms import ToroidalMap
from .grid import BrickGrid, Node
from .overlap import most
from .ranges import reach


EDGE = 16
"""Bricks are at least so many cells long, and of a multiple of these, where the volume is."""

COPIES = 3
"""Of each voxel of a brick: in the device; of the next brick, as read; and what reading and finding the
extremes of blocks takes, less than one."""


@dataclass(frozen=True)
class Margin:
    """What is read around a brick.

    - `cells`: along each axis, on both sides: as far as cells that begin in the brick may reach, and one more
      where the gradient is read.
    - `steps`: the same in steps along a ray.
    - `slopes`: whether the gradient is read.
    - `around`: nodes more, for interpolation, slopes, the windows of `AdaptiveSampling`, and light.
    """

    cells: Node
    steps: int
    around: int
    slopes: bool

    @classmethod
    def of(cls, march: March, spacing: np.ndarray, segment: int, shown: Scene) -> "Margin":
        """That of a march in a grid of this spacing, which takes `segment` cells of a ray at a time. `shown`:
        what is measured and lit there."""
        transfer, lighting = shown.transfer, shown.lighting
        steps, length = reach(march, segment), float(march.step) / spacing
        slopes = transfer.reads_gradient or (lighting is not None and lighting.reads_gradient)
        around = 2 if slopes else 1
        if march.looks_ahead:  # blocks around a run's own, and the windows of these
            rounds = math.ceil(RUN * march.longest_stride * float(np.max(length)) / (2 * BLOCK))
            around += BLOCK * (rounds + 2)
        if lighting is not None:
            assert lighting.farthest_read is not None
            around += math.ceil(lighting.farthest_read / float(np.min(spacing)))
        x, y, z = (math.ceil(steps * d) + around for d in length)
        return cls((x, y, z), steps, around, slopes)


def stored_shape(shape: Node, wanted: tuple[int, int, int]) -> Node:
    """Nodes that are read at a time, at least so many. Such a part can begin at a multiple of BLOCK wherever
    it lies, so that its blocks are those of the whole."""
    x, y, z = (n - BLOCK * max((n - w - BLOCK + 1) // BLOCK, 0) for n, w in zip(shape, wanted, strict=True))
    return x, y, z


def bytes_of(stored: Node, dtype: Any, margin: Margin) -> int:
    """Memory that parts of this shape take: the one that is rendered, what is made of it, and the next
    one."""
    kind = np.dtype(dtype)
    packed = (8 if kind.itemsize == 1 else 4) if margin.slopes and kind.kind in "ui" else 0
    return math.ceil(math.prod(stored) * (COPIES * kind.itemsize + packed))


def split(
    shape: Node, dtype: Any, memory: int, margin: Margin, probe: ToroidalMap | None, least: int = 1
) -> BrickGrid:
    """Few bricks that fit into so many bytes: there is one more along the axis where they are longest, until
    they do. There are at least `least`, unless they would be smaller than bricks are.

    **Raises:** `ValueError` if the smallest ones do not fit."""
    memory = integer("memory", memory, 1)
    cells = [n - 1 for n in shape]
    parts = [1, 1, 1]
    while True:
        size = [_rounded(-(-c // p), c) for c, p in zip(cells, parts, strict=True)]
        grid = BrickGrid(shape, (size[0], size[1], size[2]))
        needed = bytes_of(stored_of(grid, margin, probe), dtype, margin)
        longest = max(range(3), key=lambda axis: (size[axis] > min(EDGE, cells[axis])) * size[axis])
        smallest = size[longest] <= min(EDGE, cells[longest])
        if needed <= memory and (grid.number >= least or smallest):
            return grid
        if smallest:
            raise ValueError(
                f"memory must be at least {needed} bytes, for bricks of {' x '.join(map(str, size))} cells "
                f"and what is read around them; got {memory}."
            )
        parts[longest] += 1


def stored_of(grid: BrickGrid, margin: Margin, probe: ToroidalMap | None) -> Node:
    """Nodes that are read at a time for the bricks of this grid."""
    overlap = most(probe, grid)
    wanted = [s + 1 + 2 * m + k for s, m, k in zip(grid.size, margin.cells, overlap, strict=True)]
    return stored_shape(grid.shape, (wanted[0], wanted[1], wanted[2]))


def _rounded(size: int, cells: int) -> int:
    return min(-(-size // EDGE) * EDGE, cells)
