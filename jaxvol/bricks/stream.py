"""Takes an image's rays through all bricks in turn, while the next brick is read."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._util.vec3 import apart
from .._util.xla import compiled
from ..camera import Camera
from ..engine.batch import CellRange
from ..engine.image import RenderOptions
from ..engine.scene import Scene
from ..march import March
from ..occupancy import BLOCK, Blocks, widened as with_slack
from ..reference import Progress
from ..rendering import BrickReport
from ..space import Ray, Space
from ..transforms import ToroidalMap
from ..volume import Volume, part_of
from .grid import BrickGrid, Node, is_straight
from .ranges import Found, Turn, of_curved, of_straight, widened
from .sources import VoxelSource
from .split import Margin, bytes_of, split, stored_of, stored_shape
from .summary import Summary


Method = Literal["overlap", "reload", "naive"]
State = TypeVar("State")

CELL = 16
"""Cells along the side of the blocks whose ranges of values tell which bricks are empty."""

BEAMS = 32
"""Beams whose cells are looked for at a time, where rays are curved: it takes as long as the longest of their
rays."""


class Load(NamedTuple):
    """A brick that is being read, and the cells for which."""

    brick: int
    cells: CellRange
    first: Node
    voxels: "Future[np.ndarray]"


@dataclass
class Stream:
    """The bricks of a scene.

    - `scene`: with a volume without its voxels.
    - `visible`: for each brick, whether anything may be visible in it.
    - `straight`: whether rays are straight in the grid.
    - `stored`: nodes along each axis that are read at a time. `memory`: bytes that these may take.
    """

    source: VoxelSource
    scene: Scene
    options: RenderOptions
    grid: BrickGrid
    margin: Margin
    order: list[int]
    visible: np.ndarray
    straight: bool
    stored: Node
    memory: int
    method: Method
    progress: Callable[[int, int], Any] | None = None
    loads: list[int] = field(default_factory=list)
    bytes_read: int = 0

    @classmethod
    def of(
        cls,
        source: VoxelSource,
        summary: Summary,
        marched: Scene,
        shown: Scene,
        options: RenderOptions,
        memory: int,
        counts: Node | None,
        method: Method,
        progress: Callable[[int, int], Any] | None,
    ) -> "Stream":
        """The bricks of a scene: as its rays are marched, and as it is `shown`. `counts`: along each axis, in
        place of as few as fit into `memory`."""
        march = marched.march
        space = march.locate(marched.volume)
        straight = is_straight(space)
        probe = next((t for t in march.transforms if isinstance(t, ToroidalMap)), None)
        margin = Margin.of(march, _distances(space, source.shape), options.tiling.cells, shown)
        if counts is None:
            grid = split(source.shape, source.dtype, memory, margin, probe)
        else:
            x, y, z = (-(-(n - 1) // c) for n, c in zip(source.shape, counts, strict=True))
            grid = BrickGrid(source.shape, (x, y, z))
        stored = stored_of(grid, margin, probe)
        assert isinstance(marched.source, Camera)
        order, visible = grid.order(space, marched.source), _visible(marched, grid, summary)
        return cls(
            *(source, marched, options, grid, margin, order, visible, straight, stored),
            *(max(memory, bytes_of(stored, source.dtype, margin)), method, progress),
        )

    def through(
        self,
        rays: Ray,
        state: State,
        where: Callable[[State], Progress],
        march: Callable[[Volume, CellRange, State], State],
    ) -> State:
        """The state after `march(part, cells, state)` of all bricks."""
        living = [where(state)]
        turns = self._turns(rays, living)
        load = next(turns, None)
        while load is not None:
            jax.block_until_ready(state)  # or two bricks, and what is made of both, would be in memory
            part, cells = self._part(load), load.cells
            load = None  # and with it the voxels as they were read
            following = next(turns, None)
            state = march(part, cells, state)
            del part, cells
            living[0] = where(state)
            if self.progress is not None:
                self.progress(len(self.loads), int(self.visible.sum()))
            load = following
        return state

    def report(self) -> BrickReport:
        """What all passes so far took."""
        return BrickReport(
            self.grid.counts,
            int(self.visible.sum()),
            len(self.loads),
            len(self.loads) - len(set(self.loads)),
            self.bytes_read,
            self.stored,
            bytes_of(self.stored, self.source.dtype, self.margin),
        )

    def _part(self, load: Load) -> Volume:
        """A part of the volume, once it is read."""
        volume = self.scene.volume
        part = Volume(load.voxels.result(), volume.spacing, volume.origin, direction=volume.direction)
        return part_of(part, jnp.asarray(load.first, jnp.int32), self.grid.shape)

    def _turns(self, rays: Ray, living: list[Progress]) -> Iterator[Load]:
        """Bricks, each from when it is planned to be read. `living`: which rays may still see more, the
        newest answer."""
        if self.method == "naive":
            yield from self._alone(rays, living)
            return
        if self.straight:
            for brick in self.order:
                if not self.visible[brick]:
                    continue
                turn = self._turn(brick, {brick})
                cells, any_ = _cells_of_straight(self.grid, self.scene.march, rays, living[0].finished, turn)
                if any_:
                    yield self._load(brick, cells, *self._around(brick))
            return
        reached, going = jnp.zeros(rays.length.shape, jnp.int32), True
        while going:
            had, going = set[int](), False
            for brick in self.order:
                if not self.visible[brick]:
                    continue
                through = {brick} if self.method == "reload" else {brick, *had}
                found = self._found(brick, through, rays, living[0], reached)
                if found is not None and self._too_large(found):
                    found = self._found(brick, {brick}, rays, living[0], reached)
                had.add(brick)
                if found is not None:
                    going, reached = True, found.reached
                    yield self._load(brick, widened(found.cells), *self._box(found))
            going &= self.method == "reload" or not bool(jnp.all(living[0].finished))

    def _alone(self, rays: Ray, living: list[Progress]) -> Iterator[Load]:
        """Each brick with all its cells of each ray, whatever other bricks the ray meets between them."""
        nowhere = np.append(np.ones(self.grid.number, bool), True)
        for brick in self.order:
            reached = jnp.zeros(rays.length.shape, jnp.int32)
            others = nowhere.copy()
            others[brick] = False
            own, load = jnp.asarray(~others), None
            turn = Turn(jnp.asarray(brick, jnp.int32), jnp.asarray(others), own, jnp.asarray(others))
            while self.visible[brick]:
                found = _cells_of_curved(self.grid, 0, self.scene.march, rays, living[0], reached, turn)
                if not bool(found.any):
                    break
                if load is None:
                    load = self._load(brick, found.cells, *self._around(brick))
                else:
                    load = load._replace(cells=found.cells)
                reached = found.reached
                yield load

    def _turn(self, brick: int, through: set[int]) -> Turn:
        empty = np.append(~self.visible, True)
        through_ = empty.copy()
        through_[list(through)] = True
        return Turn(
            jnp.asarray(brick, jnp.int32), jnp.asarray(empty), jnp.asarray(through_), jnp.asarray(empty)
        )

    def _found(self, brick: int, through: set[int], rays: Ray, at: Progress, reached: Array) -> Found | None:
        beyond = self.margin.steps
        found = _cells_of_curved(
            self.grid, beyond, self.scene.march, rays, at, reached, self._turn(brick, through)
        )
        return found if bool(found.any) else None

    def _around(self, brick: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = (np.asarray(end) for end in self.grid.cells(brick))
        return low - self.margin.cells, high + self.margin.cells

    def _box(self, found: Found) -> tuple[np.ndarray, np.ndarray]:
        around = self.margin.around
        low, high = np.asarray(found.low, float), np.asarray(found.high, float)
        return np.floor(low - 1e-2).astype(int) - around, np.ceil(high + 1e-2).astype(int) + around

    def _too_large(self, found: Found) -> bool:
        """Whether a box does not fit into what is read at a time, also if that is made as large as it may
        be."""
        low, high = self._box(found)
        low, high = np.maximum(low, 0), np.minimum(high, np.asarray(self.grid.shape) - 1)
        wanted = tuple(np.maximum(high - low + 1 + BLOCK, self.stored).tolist())
        larger = stored_shape(self.grid.shape, wanted)
        if bytes_of(larger, self.source.dtype, self.margin) > self.memory:
            return True
        self.stored = larger
        return False

    def _load(self, brick: int, cells: CellRange, low: np.ndarray, high: np.ndarray) -> Load:
        """Starts to read a brick: a part that begins at a multiple of BLOCK and holds these nodes."""
        shape, stored = np.asarray(self.grid.shape), np.asarray(self.stored)
        first = np.minimum(np.maximum(low, 0) // BLOCK * BLOCK, shape - stored)
        assert np.all(np.minimum(high, shape - 1) < first + stored), (low, high, first, stored)
        x, y, z = first.tolist()
        self.loads.append(brick)
        self.bytes_read += int(stored.prod()) * self.source.dtype.itemsize
        return Load(brick, cells, (x, y, z), self.source.read_async(first, first + stored))


def _distances(space: Space, shape: Node) -> np.ndarray:
    """World distances between nodes along the three axes, in the middle of the grid. Where rays are curved,
    they differ elsewhere, and what a brick reads is found from its rays."""
    middle = jnp.asarray([(n - 1) / 2 for n in shape])
    along = jax.jacfwd(lambda at: jnp.stack(space.point(apart(at))))(middle)
    return np.linalg.norm(np.asarray(along, float), axis=0)


def _visible(scene: Scene, grid: BrickGrid, summary: Summary) -> np.ndarray:
    """For each brick, whether anything may be visible in it."""
    corners = [grid.cells(brick) for brick in range(grid.number)]
    ranges = np.array([summary.range_of(low, [end + 1 for end in high]) for low, high in corners])
    low, high = (jnp.asarray(end.reshape(grid.counts), jnp.float32) for end in ranges.T)
    low, high = with_slack(low, high)
    blocks = Blocks(low, high, None)
    return np.asarray(scene.compositing.occupied(scene.transfer, blocks)).reshape(-1)


def _straight(
    grid: BrickGrid, march: March, rays: Ray, finished: Bool[Array, "*rays"], turn: Turn
) -> tuple[CellRange, Bool[Array, ""]]:
    cells = of_straight(grid, march, rays, ~finished, turn)
    return cells, jnp.any(cells.until > cells.first)


def _curved(
    grid: BrickGrid, beyond: int, march: March, rays: Ray, at: Progress, reached: Array, turn: Turn
) -> Found:
    """By beams of rays, as many as are looked at at a time."""
    shape = rays.length.shape
    by_beam = jax.tree.map(lambda leaf: leaf.reshape(-1, 4, *leaf.shape[2:]), (rays, at, reached))

    def some(each: tuple[Ray, Progress, Array]) -> Found:
        rays, at, reached = each
        return of_curved(grid, march, rays, at, reached, turn, beyond)

    found = jax.lax.map(some, by_beam, batch_size=BEAMS)
    cells, reached = jax.tree.map(lambda leaf: leaf.reshape(shape), (found.cells, found.reached))
    return Found(cells, reached, jnp.min(found.low, 0), jnp.max(found.high, 0), jnp.any(found.any))


_cells_of_straight = compiled(_straight)
_cells_of_curved = compiled(_curved)
