"""How large may bricks be, and how much is read around them?"""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._util.files import MOST_VOXELS
from .._util.vec3 import Vec3
from ..march.march import March
from ..march.strides import longest_run, stride_control
from ..march.transforms import ToroidalMap
from ..march.transforms.adaptive_sampling import FARTHEST
from ..ray import Scene
from ..scene.occupancy import BLOCK
from ..scene.space import Space
from ..xla.compiling import compiled
from .cells import SLACK
from .grid import BrickGrid, Node, is_straight, overlap_of


EDGE = 16
"""Bricks are at least so many cells long, and of a multiple of these, where the volume is."""

MOST_BRICKS = 2**16
"""How many a user may ask for: each is looked for along all rays, also where it is not read."""

COPIES = 2.5
"""Of each voxel of a brick: in the device; of the next brick, as read; and what finding the extremes of
blocks takes, less than half. Voxels of another type take `sources.AT_ONCE` bytes more, or a layer of chunks,
while they are read."""


class TooLittleMemory(ValueError):
    """The smallest bricks, with what is read around them, do not fit into the budget."""


@dataclass(frozen=True)
class Margin:
    """What is read around a brick.

    - `cells`: along each axis, on both sides, around any brick.
    - `steps`, `length`: how far cells that begin in the brick may reach along a ray, and in the world.
    - `light`: world length around a sample within which light is looked for.
    - `around`: nodes more, for interpolation, `slopes`, and the windows of `AdaptiveSampling`.
    - `straight`: whether rays are straight in the grid. `probe`: whose bricks overlap, if they do.
    """

    cells: Node
    steps: int
    length: float
    light: float
    around: int
    slopes: bool
    straight: bool = True
    probe: ToroidalMap | None = None

    @classmethod
    def of(cls, march: March, space: Space, shape: Node, segment: int, shown: Scene) -> "Margin":
        """That of a march in a grid of this shape, which takes `segment` cells of a ray at a time. `shown`:
        what is measured and lit there."""
        transfer, lighting, straight = shown.transfer, shown.lighting, is_straight(space)
        steps = SLACK + max(segment, longest_run(march))
        # where rays are curved, a brick's own cells are found by points that may lie four steps apart
        length = (steps + (0 if straight else 4)) * float(march.step)
        slopes = transfer.reads_gradient or (lighting is not None and lighting.reads_gradient)
        around = 2 if slopes else 1
        if stride_control(march) is not None:  # blocks around a run's own, and the windows of these
            shortest = min(_distances(space, np.zeros(3), np.asarray(shape) + BLOCK))
            rounds = longest_run(march) * float(march.step) / max(2 * BLOCK * shortest, 1e-30)
            around += BLOCK * (math.ceil(min(rounds, FARTHEST)) + 2)  # runs that touch more are not made
        light = 0.0 if lighting is None else lighting.farthest_read
        assert light is not None
        probe = next((t for t in march.transforms if isinstance(t, ToroidalMap)), None)
        margin = cls((0, 0, 0), steps, length, light, around, slopes, straight, probe)
        return replace(margin, cells=margin.of_box(space, shape, np.zeros(3), np.asarray(shape) - 1))

    def of_box(self, space: Space, shape: Node, low: np.ndarray, high: np.ndarray) -> Node:
        """Nodes along each axis that are read around the cells that begin in a box."""
        far = nodes_within(space, shape, low, high, self.length)
        low, high = np.maximum(low - far, 0), np.minimum(high + far, np.asarray(shape) - 1)
        x, y, z = far + self.of_points(space, shape, low, high) + (0 if self.straight else 1)
        return int(x), int(y), int(z)

    def of_points(self, space: Space, shape: Node, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Nodes along each axis that are read around points in a box."""
        return nodes_within(space, shape, low, high, self.light) + self.around


def nodes_within(space: Space, shape: Node, low: np.ndarray, high: np.ndarray, length: float) -> np.ndarray:
    """Nodes along each axis, on both sides of a box, that hold everything within a world length of it. Where
    rays are curved they follow from the least distances between nodes in the box and in these nodes
    themselves, also beyond the grid, through which a ray may come to other nodes of it."""
    nodes = np.zeros(3)
    while length > 0:
        distances = _distances(space, low - nodes, high + nodes)
        with np.errstate(divide="ignore"):
            more = np.maximum(nodes, np.minimum(np.ceil(length / distances), shape))
        if np.array_equal(more, nodes):
            break
        nodes = more
    return nodes.astype(int)


def _distances(space: Space, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least distances between neighbouring nodes along each axis in a box."""
    ends = (tuple(jnp.asarray(c, space.middle[0].dtype) for c in end.tolist()) for end in (low, high))
    return np.asarray([float(distance) for distance in _least_distances(space, *ends)])


@compiled
def _least_distances(space: Space, low: Vec3, high: Vec3) -> Vec3:
    return space.least_distances(low, high)


def stored_shape(shape: Node, wanted: tuple[int, int, int]) -> Node:
    """Nodes that are read at a time, at least so many. Such a box can begin at a multiple of BLOCK wherever
    it lies, so that its blocks are those of the whole."""
    x, y, z = (n - BLOCK * max((n - w - BLOCK + 1) // BLOCK, 0) for n, w in zip(shape, wanted, strict=True))
    return x, y, z


def stored_of(grid: BrickGrid, margin: Margin) -> Node:
    """Nodes that are read at a time for the bricks of this grid."""
    overlap = 0 if margin.probe is None else math.ceil(max(overlap_of(margin.probe, grid), default=0.0))
    x, y, z = (size + 1 + 2 * around for size, around in zip(grid.size, margin.cells, strict=True))
    return stored_shape(grid.shape, (x, y, z + overlap))


def bytes_of(stored: Node, dtype: Any, margin: Margin) -> int:
    """Memory that bricks of this shape take: the one that is rendered, what is made of it, and the next
    one."""
    kind = np.dtype(dtype)
    packed = (8 if kind.itemsize == 1 else 4) if margin.slopes and kind.kind in "ui" else 0
    return math.ceil(math.prod(stored) * (COPIES * kind.itemsize + packed))


def fits(stored: Node, dtype: Any, margin: Margin, memory: int) -> bool:
    """Whether bricks of this shape can be volumes, and take no more than so many bytes."""
    return math.prod(stored) <= MOST_VOXELS and bytes_of(stored, dtype, margin) <= memory


def check_stored(stored: Node) -> None:
    """**Raises** `ValueError` if a brick of this shape has more voxels than a volume may have."""
    if math.prod(stored) > MOST_VOXELS:
        raise ValueError(
            "bricks must be so many that fewer than 2**31 voxels are read for each; got "
            f"{' x '.join(map(str, stored))}."
        )


def divided(shape: Node, counts: Node) -> BrickGrid:
    """So many bricks along each axis, or fewer along one of too few voxels.

    **Raises:** `ValueError` for more than MOST_BRICKS in all."""
    x, y, z = (-(-(n - 1) // c) for n, c in zip(shape, counts, strict=True))
    grid = BrickGrid(shape, (x, y, z))
    if grid.number > MOST_BRICKS:
        raise ValueError(
            f"bricks must be no more than {MOST_BRICKS} in all; got {counts}, which divide "
            f"{' x '.join(map(str, shape))} voxels into {grid.number}."
        )
    return grid


def split(shape: Node, dtype: Any, memory: int, margin: Margin, devices: int = 1) -> BrickGrid:
    """The fewest bricks of about cubic shape, and at least as many as `devices` if these are not too small,
    that fit into so many bytes: there is one more along the axis where they are longest, until they do. Axes
    along which even the smallest bricks would be read whole are split last.

    **Raises:** `TooLittleMemory` if the smallest ones do not fit."""
    cells = [n - 1 for n in shape]
    x, y, z = (min(EDGE, c) for c in cells)
    short = np.less(stored_of(BrickGrid(shape, (x, y, z)), margin), shape).tolist()
    counts = [1, 1, 1]
    while True:
        x, y, z = (min(-(-c // (count * EDGE)) * EDGE, c) for c, count in zip(cells, counts, strict=True))
        grid = BrickGrid(shape, (x, y, z))
        stored = stored_of(grid, margin)
        divisible = [axis for axis in range(3) if grid.size[axis] > min(EDGE, cells[axis])]
        if fits(stored, dtype, margin, memory) and (grid.number >= devices or not divisible):
            return grid
        if not divisible:
            check_stored(stored)
            raise TooLittleMemory(
                f"memory must be at least {bytes_of(stored, dtype, margin)} bytes, for bricks of "
                f"{' x '.join(map(str, grid.size))} cells and what is read around them, less for a "
                f"shorter step; got {memory}."
            )
        counts[max(divisible, key=lambda axis: (short[axis], grid.size[axis]))] += 1
