"""How large may bricks be, and how much larger are they read than they are?"""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._util.checks import integer
from .._util.files import MOST_VOXELS
from ..march.march import March
from ..march.strides import longest_run, stride_control
from ..march.transforms import ToroidalMap
from ..march.transforms.adaptive_sampling import FARTHEST
from ..ray import Scene
from ..scene.occupancy import BLOCK
from ..scene.space import Space
from .cells import reach
from .grid import BrickGrid, Node, is_straight
from .overlap import most


EDGE = 16
"""Bricks are at least so many cells long, and of a multiple of these, where the volume is."""

MOST_BRICKS = 2**16
"""How many a user may ask for. Each has its turn, in which it is looked for along all rays, also where it is
not read: without a limit, an image of a billion bricks would not end."""

COPIES = 2.5
"""Of each voxel of a brick: in the device; of the next brick, as read; and what finding the extremes of
blocks takes, less than half. Voxels that are stored in another type take `sources.AT_ONCE` bytes more while
they are read, or a layer of chunks, if that is more."""


class TooLittleMemory(ValueError):
    """The smallest bricks, with what is read around them, do not fit into the budget."""


@dataclass(frozen=True)
class Margin:
    """What is read around a brick.

    - `cells`: along each axis, on both sides, and for any brick: as far as cells that begin in the brick may
      reach, and what is read around these.
    - `steps`: how far these cells may reach, in steps along a ray. `length`: the same as a world length.
    - `light`: world length around a sample within which light is looked for.
    - `around`: nodes more, for interpolation, slopes, and the windows of `AdaptiveSampling`.
    - `slopes`: whether the gradient is read.
    """

    cells: Node
    steps: int
    length: float
    light: float
    around: int
    slopes: bool

    @classmethod
    def of(cls, march: March, space: Space, shape: Node, segment: int, shown: Scene) -> "Margin":
        """That of a march in a grid of this shape, which takes `segment` cells of a ray at a time. `shown`:
        what is measured and lit there."""
        transfer, lighting = shown.transfer, shown.lighting
        steps = reach(march, segment)
        # where rays are curved, a brick's own cells are found by points that may lie four steps apart
        length = (steps + (0 if is_straight(space) else 4)) * float(march.step)
        slopes = transfer.reads_gradient or (lighting is not None and lighting.reads_gradient)
        around = 2 if slopes else 1
        if stride_control(march) is not None:  # blocks around a run's own, and the windows of these
            shortest = min(_distances(space, np.zeros(3), np.asarray(shape) + BLOCK))
            rounds = longest_run(march) * float(march.step) / max(2 * BLOCK * shortest, 1e-30)
            around += BLOCK * (math.ceil(min(rounds, FARTHEST)) + 2)  # runs that touch more are not made
        light = 0.0 if lighting is None else lighting.farthest_read
        assert light is not None
        margin = cls((0, 0, 0), steps, length, light, around, slopes)
        return replace(margin, cells=margin.of_box(space, shape, np.zeros(3), np.asarray(shape) - 1))

    def of_box(self, space: Space, shape: Node, low: np.ndarray, high: np.ndarray) -> Node:
        """Nodes along each axis that are read around the cells that begin in a box."""
        far = nodes_within(space, shape, low, high, self.length)
        low, high = np.maximum(low - far, 0), np.minimum(high + far, np.asarray(shape) - 1)
        x, y, z = far + self.of_points(space, shape, low, high) + (0 if is_straight(space) else 1)
        return int(x), int(y), int(z)

    def of_points(self, space: Space, shape: Node, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Nodes along each axis that are read around points in a box."""
        return nodes_within(space, shape, low, high, self.light) + self.around


def nodes_within(space: Space, shape: Node, low: np.ndarray, high: np.ndarray, length: float) -> np.ndarray:
    """Nodes along each axis, on both sides of a box of a grid of this shape, that hold everything within a
    world length of it. Where rays are curved they follow from the least distances between nodes in the box
    and in these nodes themselves, also beyond the grid, through which a ray may come to other nodes of it."""
    nodes = np.zeros(3)
    while length > 0:
        distances = np.asarray(_distances(space, low - nodes, high + nodes))
        with np.errstate(divide="ignore"):
            more = np.maximum(nodes, np.minimum(np.ceil(length / distances), shape))
        if np.array_equal(more, nodes):
            break
        nodes = more
    return nodes.astype(int)


def _distances(space: Space, low: np.ndarray, high: np.ndarray) -> tuple[float, float, float]:
    ends = [tuple(jnp.asarray(c, space.middle[0].dtype) for c in end.tolist()) for end in (low, high)]
    (x0, y0, z0), (x1, y1, z1) = ends
    dx, dy, dz = space.least_distances((x0, y0, z0), (x1, y1, z1))
    return float(dx), float(dy), float(dz)


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


def fits(stored: Node, dtype: Any, margin: Margin, memory: int) -> bool:
    """Whether parts of this shape can be volumes, and take no more than so many bytes."""
    return math.prod(stored) <= MOST_VOXELS and bytes_of(stored, dtype, margin) <= memory


def split(
    shape: Node, dtype: Any, memory: int, margin: Margin, probe: ToroidalMap | None, least: int = 1
) -> BrickGrid:
    """Few bricks that fit into so many bytes, and have fewer than 2**31 voxels: there is one more along the
    axis where they are longest, until they do; first among the axes along which the smallest bricks, with
    what is read around them, are shorter than the volume. There are at least `least`, unless they would be
    smaller than bricks are.

    **Raises:** `TooLittleMemory` if the smallest ones do not fit."""
    memory = integer("memory", memory, 1)
    cells = [n - 1 for n in shape]
    x, y, z = (min(EDGE, c) for c in cells)
    short = np.less(stored_of(BrickGrid(shape, (x, y, z)), margin, probe), shape).tolist()
    parts = [1, 1, 1]
    while True:
        size = [rounded(-(-c // p), c) for c, p in zip(cells, parts, strict=True)]
        grid = BrickGrid(shape, (size[0], size[1], size[2]))
        stored = stored_of(grid, margin, probe)
        left = [axis for axis in range(3) if size[axis] > min(EDGE, cells[axis])]
        smallest = not left
        if fits(stored, dtype, margin, memory) and (grid.number >= least or smallest):
            return grid
        if smallest:
            check_part(stored)
            raise TooLittleMemory(
                f"memory must be at least {bytes_of(stored, dtype, margin)} bytes, for bricks of "
                f"{' x '.join(map(str, size))} cells and what is read around them, less for a "
                f"shorter step; got {memory}."
            )
        parts[max(left, key=lambda axis: (short[axis], size[axis]))] += 1


def check_smallest(shape: Node, dtype: Any, memory: int) -> None:
    """**Raises** `TooLittleMemory` if no march at all has bricks that fit: not even one that reads nothing
    around them but what interpolation takes."""
    x, y, z = (min(EDGE, n - 1) for n in shape)
    margin = Margin((1, 1, 1), steps=0, length=0.0, light=0.0, around=1, slopes=False)
    least = bytes_of(stored_of(BrickGrid(shape, (x, y, z)), margin, None), dtype, margin)
    if memory < least:
        raise TooLittleMemory(
            f"memory must be at least {least} bytes, which the smallest bricks take, of {x} x {y} x {z} "
            f"cells, however short the step; most marches take more. Got {memory}."
        )


def divided(shape: Node, counts: Node) -> BrickGrid:
    """So many bricks along each axis, or fewer along one of too few voxels.

    **Raises:** `ValueError` for more than MOST_BRICKS in all."""
    x, y, z = (-(-(n - 1) // c) for n, c in zip(shape, counts, strict=True))
    grid = BrickGrid(shape, (x, y, z))
    if grid.number > MOST_BRICKS:
        raise ValueError(
            f"bricks must be no more than {MOST_BRICKS} in all, each of which has its turn; got {counts}, "
            f"which divide {' x '.join(map(str, shape))} voxels into {grid.number}. Ask for bricks of "
            f"{EDGE} cells or more along each side."
        )
    return grid


def check_part(stored: Node) -> None:
    """**Raises** `ValueError` if a part of this shape has more voxels than a volume may have."""
    if math.prod(stored) > MOST_VOXELS:
        raise ValueError(
            "bricks must be so many, and steps so short, that a brick and what is read around it have fewer "
            f"than 2**31 voxels; got {' x '.join(map(str, stored))} along x, y and z."
        )


def stored_of(grid: BrickGrid, margin: Margin, probe: ToroidalMap | None) -> Node:
    """Nodes that are read at a time for the bricks of this grid."""
    overlap = most(probe, grid)
    wanted = [s + 1 + 2 * m + k for s, m, k in zip(grid.size, margin.cells, overlap, strict=True)]
    return stored_shape(grid.shape, (wanted[0], wanted[1], wanted[2]))


def rounded(size: int, cells: int) -> int:
    """Cells of a brick along an axis of so many, at least `size`."""
    return min(-(-size // EDGE) * EDGE, cells)
