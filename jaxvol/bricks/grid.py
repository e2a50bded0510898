"""Division of a volume into bricks: their size, their order, and the margin that is read around them."""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._util.checks import Arrayable, integer, shortened
from .._util.files import MOST_VOXELS
from .._util.vec3 import Vec3, apart
from ..march.march import March
from ..march.transforms.toroidal_map import ToroidalMap
from ..ray import Scene
from ..scene.camera import Camera, axes_of
from ..scene.occupancy import BLOCK
from ..scene.space import Space, Straight
from ..xla.compiling import compiled


Node = tuple[int, int, int]

SLACK = 3  # steps by which jitter may move samples from the start of their cells, and one more for rounding
EDGE = 16  # cells along the side of a brick are a multiple of this, in a volume that is long enough
MOST_BRICKS = 2**16  # limit of the argument `bricks`: each brick is searched for along all rays

# Copies of a voxel: in the device, in the next brick, and less than half for the extremes of blocks. Voxels
# that are converted take `sources.AT_ONCE` bytes more, or a layer of chunks, while they are read.
COPIES = 2.5


@dataclass(frozen=True)
class BrickGrid:
    """Bricks of equally many cells, numbered in row-major order; the last ones along an axis may have fewer.

    Attributes:
        shape: nodes of the volume.
        size: cells of a brick.
    """

    shape: Node
    size: Node

    @property
    def counts(self) -> Node:
        """Number of bricks along each axis."""
        x, y, z = (-(-(n - 1) // s) for n, s in zip(self.shape, self.size, strict=True))
        return x, y, z

    @property
    def number(self) -> int:
        """Number of all bricks."""
        return math.prod(self.counts)

    def cells(self, brick: int) -> tuple[Node, Node]:
        """First and last node of a brick along each axis."""
        index = np.unravel_index(brick, self.counts)
        x, y, z = (int(i) * s for i, s in zip(index, self.size, strict=True))
        end = [min(a + s, n - 1) for a, s, n in zip((x, y, z), self.size, self.shape, strict=True)]
        return (x, y, z), (end[0], end[1], end[2])

    def brick_of(self, coordinate: Vec3) -> Int[Array, "..."]:
        """The brick nearest to a grid coordinate; any brick for NaN."""
        number = jnp.zeros(jnp.shape(coordinate[0]), jnp.int32)
        for c, size, count in zip(coordinate, self.size, self.counts, strict=True):
            index = jnp.floor(c * (1 / size)).astype(jnp.int32)
            number = number * count + jnp.clip(index, 0, count - 1)
        return number

    def order(self, space: Space, camera: Camera) -> list[int]:
        """Bricks front to back. In a straight grid, depth is the sum of distances along the axes in bricks,
        which do not decrease along a ray: rays meet bricks in this order. In a curved grid it is the distance
        from the camera, as in the paper, and a ray may come back."""
        index = np.stack(np.unravel_index(np.arange(self.number), self.counts), axis=-1)
        centers = (index + 0.5) * self.size
        eye, (_, _, forward) = camera.position, axes_of(camera)
        parallel = camera.parallel_scale is not None
        path = space.path(apart(eye), apart(forward))
        if isinstance(path, Straight):
            # not the difference of two points, which float32 may round to equal coordinates far away
            start, rate = (np.array([float(c) for c in part]) for part in (path.start, path.rate))
            if parallel:
                depth = index @ np.sign(rate)
            else:
                depth = np.sum(np.abs(centers - start) / self.size, axis=-1)
        else:
            x, y, z = (jnp.asarray(c) for c in np.minimum(centers, np.asarray(self.shape) - 1).T)
            points = np.stack([np.asarray(c) for c in jax.vmap(space.point)((x, y, z))], axis=-1)
            toward = points - np.asarray(eye)
            depth = toward @ np.asarray(forward) if parallel else np.linalg.norm(toward, axis=-1)
        return np.argsort(depth, kind="stable").tolist()


def is_straight(space: Space) -> bool:
    """Tests whether rays are straight in the grid."""
    zero, one = jnp.zeros(()), jnp.ones(())
    return isinstance(space.path((zero, zero, zero), (one, zero, zero)), Straight)


def overlap_of(probe: ToroidalMap, grid: BrickGrid) -> list[float]:
    """Overlap of bricks at their curved faces along γ with which each ray meets each brick once.

    A ray may enter a brick, pass through the one nearer to the probe, and come back. If the farther brick
    includes the cap between the curved face and its chord, it need not be rendered again. At a face at the
    distance l from the apex the cap has the height K = l - l cos(θ/2), where θ is the angle of a brick's fan;
    along the sweep, l is measured from the motor axis, and θ is the angle of its sweep. The larger counts.
    `render_bricks` instead derives the voxels to read from its rays.

    Args:
        probe: the volume's probe geometry.
        grid: the division of the volume into bricks.

    Returns:
        K* of each face between two bricks, from the probe outwards, voxels.

    Source: Kim, Kwon and Shin 2008, section 3.2.
    """
    cells = [n - 1 for n in grid.shape]
    beta, sigma, gamma = (
        np.asarray(ends, float) for ends in (probe.beta_range, probe.sigma_range, probe.gamma_range)
    )
    sweep, fan, depth = (
        np.ptp(ends) * size / n for ends, size, n in zip((beta, sigma, gamma), grid.size, cells, strict=True)
    )
    at: Float[np.ndarray, " faces"] = gamma[0] + depth * np.arange(1, grid.counts[2])
    from_apex, from_axis = float(probe.b) + at, float(probe.a) + float(probe.b) + at
    height = np.maximum(from_apex * (1 - np.cos(fan / 2)), from_axis * (1 - np.cos(sweep / 2)))
    return (np.maximum(height, 0) * cells[2] / np.ptp(gamma)).tolist()


@dataclass(frozen=True)
class Margin:
    """Voxels that are read around a brick."""

    cells: Node  # along each axis, on both sides of any brick
    steps: int  # reach along a ray of cells that begin in the brick
    length: float  # the same reach, world length
    light: float  # radius around a sample within which lighting reads, world length
    around: int  # additional nodes for interpolation and slopes
    slopes: bool
    straight: bool = True  # rays are straight in the grid
    probe: ToroidalMap | None = None  # set if bricks overlap by `overlap_of`

    @classmethod
    def of(cls, march: March, space: Space, shape: Node, segment: int, shown: Scene) -> "Margin":
        """Margin of a march of `segment` cells at a time. `shown`: the scene that is measured and lit."""
        transfer, lighting, straight = shown.transfer, shown.lighting, is_straight(space)
        steps = SLACK + segment
        # on curved rays, a brick's cells are found by points that may lie four steps apart
        length = (steps + (0 if straight else 4)) * float(march.step)
        slopes = transfer.reads_gradient or (lighting is not None and lighting.reads_gradient)
        around = 2 if slopes else 1
        light = 0.0 if lighting is None else lighting.farthest_read
        assert light is not None
        probe = next((t for t in march.transforms if isinstance(t, ToroidalMap)), None)
        margin = cls((0, 0, 0), steps, length, light, around, slopes, straight, probe)
        return replace(margin, cells=margin.of_box(space, shape, np.zeros(3), np.asarray(shape) - 1))

    def of_box(self, space: Space, shape: Node, low: np.ndarray, high: np.ndarray) -> Node:
        """Nodes along each axis to read around the cells that begin in a box."""
        far = nodes_within(space, shape, low, high, self.length)
        low, high = np.maximum(low - far, 0), np.minimum(high + far, np.asarray(shape) - 1)
        x, y, z = far + self.of_points(space, shape, low, high) + (0 if self.straight else 1)
        return int(x), int(y), int(z)

    def of_points(self, space: Space, shape: Node, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Nodes along each axis to read around points in a box."""
        return nodes_within(space, shape, low, high, self.light) + self.around

    def stored(self, grid: BrickGrid) -> Node:
        """Shape of the boxes of nodes that are read for the bricks of a grid."""
        overlap = 0 if self.probe is None else math.ceil(max(overlap_of(self.probe, grid), default=0.0))
        x, y, z = (size + 1 + 2 * around for size, around in zip(grid.size, self.cells, strict=True))
        return stored_shape(grid.shape, (x, y, z + overlap))

    def bytes(self, stored: Node, dtype: np.dtype) -> int:
        """Memory of bricks of this shape: the rendered brick, its derived arrays, and the next brick."""
        packed = (8 if dtype.itemsize == 1 else 4) if self.slopes and dtype.kind in "ui" else 0
        return math.ceil(math.prod(stored) * (COPIES * dtype.itemsize + packed))

    def fits(self, stored: Node, dtype: np.dtype, memory: int) -> bool:
        """Tests whether bricks of this shape can be volumes and take at most `memory` bytes."""
        return math.prod(stored) <= MOST_VOXELS and self.bytes(stored, dtype) <= memory


def nodes_within(space: Space, shape: Node, low: np.ndarray, high: np.ndarray, length: float) -> np.ndarray:
    """Nodes along each axis, on both sides of a box, that cover a world length around it: a bound by the
    least distances between nodes, also beyond the grid, as rays may return to it."""
    nodes = np.zeros(3)
    while length > 0:
        box = (low - nodes).tolist(), (high + nodes).tolist()
        ends = (tuple(jnp.asarray(c, space.middle[0].dtype) for c in end) for end in box)
        distances = np.array([float(distance) for distance in _least_distances(space, *ends)])
        with np.errstate(divide="ignore"):
            more = np.maximum(nodes, np.minimum(np.ceil(length / distances), shape))
        if np.array_equal(more, nodes):
            break
        nodes = more
    return nodes.astype(int)


_least_distances = compiled(lambda space, low, high: space.least_distances(low, high))


def stored_shape(shape: Node, wanted: tuple[int, int, int]) -> Node:
    """Shape of the boxes to read, at least `wanted`. Any such box can begin at a multiple of BLOCK, so that
    its blocks coincide with the volume's."""
    x, y, z = (n - BLOCK * max((n - w - BLOCK + 1) // BLOCK, 0) for n, w in zip(shape, wanted, strict=True))
    return x, y, z


def divided(shape: Node, counts: Arrayable) -> BrickGrid:
    """Grid of `counts` bricks along each axis, fewer along an axis of too few voxels."""
    try:
        x, y, z = (-(-(n - 1) // integer("bricks", c, 1)) for n, c in zip(shape, counts, strict=True))
    except (TypeError, ValueError) as fault:
        raise ValueError(
            f"bricks must be three numbers, each an integer of at least 1; got {shortened(counts)}."
        ) from fault
    grid = BrickGrid(shape, (x, y, z))
    if grid.number > MOST_BRICKS:
        raise ValueError(f"bricks must be no more than {MOST_BRICKS} in all; got {counts}, {grid.number}.")
    return grid


def split(shape: Node, dtype: np.dtype, memory: int, margin: Margin, devices: int = 1) -> BrickGrid:
    """Grid of the fewest nearly cubic bricks that fit into memory, and at least `devices` if they are not too
    small: the longest side is split until they fit. Axes that the smallest bricks would read completely are
    split last."""
    cells = [n - 1 for n in shape]
    x, y, z = (min(EDGE, c) for c in cells)
    short = np.less(margin.stored(BrickGrid(shape, (x, y, z))), shape).tolist()
    counts = [1, 1, 1]
    while True:
        x, y, z = (min(-(-c // (count * EDGE)) * EDGE, c) for c, count in zip(cells, counts, strict=True))
        grid = BrickGrid(shape, (x, y, z))
        stored = margin.stored(grid)
        divisible = [axis for axis in range(3) if grid.size[axis] > min(EDGE, cells[axis])]
        if margin.fits(stored, dtype, memory) and (grid.number >= devices or not divisible):
            return grid
        if not divisible:
            raise ValueError(
                f"memory must be at least {margin.bytes(stored, dtype)} bytes for bricks of {grid.size} "
                f"cells with their margins; got {memory}. Raise it, or shorten the step."
            )
        counts[max(divisible, key=lambda axis: (short[axis], grid.size[axis]))] += 1
