"""Takes an image's rays through all bricks in turn, while the next brick is read."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Int

from .._util.memory import give_back
from ..engine import devices
from ..engine.tiling import RenderOptions
from ..engine.wavefront import CellRange
from ..march.march import March
from ..march.transforms import ToroidalMap
from ..ray import Progress, Scene
from ..scene.camera import Camera
from ..scene.occupancy import BLOCK
from ..scene.rendering import BrickReport
from ..scene.space import Ray, Space
from ..scene.volume import Volume, part_of, with_voxels
from ..xla.compiling import compiled
from .cells import Found, Turn, of_curved, of_straight, widened
from .choice import cheapest, counts as counted, visible
from .dtypes import range_of
from .grid import BrickGrid, Node, is_straight
from .sources import VoxelSource, in_background
from .split import Margin, bytes_of, check_part, divided, fits, split, stored_of, stored_shape
from .summary import Summary


State = TypeVar("State")

Turns: TypeAlias = Callable[["Stream", Ray, list[Progress]], Iterator["Load"]]
"""Which brick is read next, and for which cells of each ray: called with the stream, the rays, and a list
whose only entry always tells how far rays have come. Bricks are planned one ahead of what is marched."""

Method: TypeAlias = Literal["overlap", "reload"] | Turns

BEAMS = 32
"""Beams whose cells are looked for at a time, where rays are curved: it takes as long as the longest of their
rays."""

KEPT = 64 * 2**20
"""Bytes that are read before what was freed meanwhile, by decoders as much as a brick, goes back to the
system. That takes some 8 ms: of a small brick, nearly as long as marching through it."""


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
    - `turns`: which of them is read next.
    - `done`: bricks that were rendered. `loads`: those whose reading has begun.
    - `stored`: nodes along each axis that are read at a time. `alone`: as many suffice for each brick without
      the bricks that had their turn before. `memory`: bytes that these may take.
    """

    source: VoxelSource
    summary: Summary
    scene: Scene
    options: RenderOptions
    space: Space
    grid: BrickGrid
    margin: Margin
    order: list[int]
    visible: np.ndarray
    straight: bool
    alone: Node
    stored: Node
    memory: int
    turns: Turns
    progress: Callable[[int, int], Any] | None = None
    done: int = 0
    loads: list[int] = field(default_factory=list)
    bytes_read: int = 0

    @classmethod
    def of(
        cls,
        source: VoxelSource,
        summary_of: Callable[[], Summary],
        marched: Scene,
        shown: Scene,
        options: RenderOptions,
        memory: int,
        counts: Node | None,
        method: Method,
        progress: Callable[[int, int], Any] | None,
        least: int = 1,
    ) -> "Stream":
        """The bricks of a scene: as its rays are marched, and as it is `shown`.

        - `summary_of`: called once it is known that bricks fit, since it may read the whole source.
        - `counts`: along x, y and z, in place of those chosen to fit into `memory`, at least `least`."""
        assert isinstance(marched.source, Camera)
        march = marched.march
        space = march.locate(marched.volume)
        straight = is_straight(space)
        probe = next((t for t in march.transforms if isinstance(t, ToroidalMap)), None)
        margin = Margin.of(march, space, source.shape, options.tiling.cells, shown)
        if counts is None:
            grid = split(source.shape, source.dtype, memory, margin, probe, least)
        else:
            grid = divided(source.shape, counts)
        overlapping = probe if method == "overlap" else None
        check_part(stored_of(grid, margin, overlapping))
        summary = summary_of()
        occupied = eqx.Partial(marched.compositing.occupied, marched.transfer)
        table = counted(summary.where(occupied))
        if counts is None and straight:
            rays = math.prod(marched.source.size)
            grid = cheapest(grid, source, summary, table, margin, memory, rays, least)
        stored = alone = stored_of(grid, margin, overlapping)
        if not straight and isinstance(method, str):  # what is read is found from the rays: begin with less
            middle = (np.asarray(source.shape) - 1) / 2
            typical = replace(margin, cells=margin.of_box(space, source.shape, middle, middle))
            stored = stored_of(grid, typical, overlapping)
        order, seen = grid.order(space, marched.source), visible(grid, summary, table)
        turns = method if callable(method) else in_order if straight else METHODS[method]
        room = max(memory, bytes_of(alone, source.dtype, margin))
        place = space, grid, margin, order, seen, straight, alone, stored, room
        return cls(source, summary, marched, options, *place, turns, progress)

    @property
    def mesh(self) -> Mesh | None:
        """The devices to which rays are dealt out."""
        return self.options.tiling.devices

    def through(
        self,
        rays: Ray,
        state: State,
        where: Callable[[State], Progress],
        march: Callable[[Volume, CellRange, State], State],
    ) -> State:
        """The state after `march(part, cells, state)` of all bricks."""
        living, returned = [where(state)], self.bytes_read
        turns = self.turns(self, rays, living)
        load = next(turns, None)
        while load is not None:
            jax.block_until_ready(state)  # or two bricks, and what is made of both, would be in memory
            if self.bytes_read - returned >= KEPT:
                give_back()
                returned = self.bytes_read
            part, cells = self._part(load), load.cells
            load = None  # and with it the voxels as they were read
            following = next(turns, None)
            state = march(part, cells, state)
            del part, cells
            living[0] = where(state)
            self.finish(1, int(self.visible.sum()))
            load = following
        return state

    def finish(self, bricks: int, of: int) -> None:
        """Says that so many more bricks are rendered, `of` all that hold anything visible."""
        self.done += bricks
        if self.progress is not None:
            self.progress(self.done, of)

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
        voxels = jax.device_put(load.voxels.result())  # on a CPU, not copied if a file was read (`empty_box`)
        return part_of(with_voxels(volume, voxels), jnp.asarray(load.first, jnp.int32), self.grid.shape)

    def found(
        self,
        brick: int,
        through: set[int],
        rays: Ray,
        at: Progress,
        reached: Array,
        *,
        over_empty: bool = True,
    ) -> Found | None:
        """The cells of rays in a brick and in those `through` which they go on from it. `over_empty`: and in
        those that are empty."""
        empty = np.append(~self.visible, True)
        on = empty.copy() if over_empty else np.zeros_like(empty)
        on[list(through)] = True
        turn = Turn(jnp.asarray(brick, jnp.int32), jnp.asarray(empty), jnp.asarray(on), jnp.asarray(empty))
        return self.cells_in(turn, rays, at, reached, self.margin.steps)

    def cells_in(self, turn: Turn, rays: Ray, at: Progress, reached: Array, beyond: int = 0) -> Found | None:
        """The cells of rays in a turn, as of `cells.of_curved`, by the device; None if there are none."""
        march = self.scene.march
        found = _cells_of_curved(self.mesh, self.grid, beyond, march, rays, at, reached, turn)
        return found if bool(found.any) else None

    def around(self, brick: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = (np.asarray(end) for end in self.grid.cells(brick))
        cells = self.margin.cells  # where rays are straight, of any box
        if not self.straight:
            cells = self.margin.of_box(self.space, self.grid.shape, low, high)
        margin = np.asarray(cells)
        return low - margin, high + margin

    def box_of(self, found: Found) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.asarray(found.low, float), np.asarray(found.high, float)
        around = self.margin.of_points(self.space, self.grid.shape, low, high)
        return np.floor(low - 1e-2).astype(int) - around, np.ceil(high + 1e-2).astype(int) + around

    def make_room(self, found: Found) -> bool:
        """Whether a box fits into what is read at a time, which is made larger for it as far as memory goes:
        so far that each brick alone still fits."""
        low, high = self.box_of(found)
        low, high = np.maximum(low, 0), np.minimum(high, np.asarray(self.grid.shape) - 1)
        wanted = stored_shape(self.grid.shape, tuple((high - low + 1).tolist()))
        x, y, z = map(max, wanted, self.stored)
        nx, ny, nz = map(max, (x, y, z), self.alone)
        if not fits((nx, ny, nz), self.source.dtype, self.margin, self.memory):
            return False
        self.stored = x, y, z
        return True

    def load(self, brick: int, cells: CellRange, low: np.ndarray, high: np.ndarray) -> Load:
        """Starts to read a brick, for these cells."""
        return Load(brick, cells, *self.read(brick, low, high))

    def read(self, brick: int, low: np.ndarray, high: np.ndarray) -> tuple[Node, "Future[np.ndarray]"]:
        """Starts to read a brick: a part that begins at a multiple of BLOCK and holds these nodes."""
        shape, stored = np.asarray(self.grid.shape), np.asarray(self.stored)
        first = np.minimum(np.maximum(low, 0) // BLOCK * BLOCK, shape - stored)
        assert np.all(np.minimum(high, shape - 1) < first + stored), (low, high, first, stored)
        x, y, z = first.tolist()
        self.loads.append(brick)
        self.bytes_read += int(stored.prod()) * self.source.dtype.itemsize
        return (x, y, z), in_background(self._read, first, first + stored)

    def _read(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The voxels of a box, whose range tells whether they are those of the summary."""
        voxels = self.source.read(low, high, self.source.order)
        (least, most), (lowest, highest) = self.summary.range_of(low, high), range_of(voxels)
        if lowest < least or highest > most:
            raise ValueError(
                f"{self.source.name} changed since the ranges of its values were found: they are {least} to "
                f"{most} in the box {tuple(low.tolist())} to {tuple(high.tolist())}, and now {lowest} to "
                f"{highest}. Open it again."
            )
        return voxels


def in_order(stream: Stream, rays: Ray, living: list[Progress]) -> Iterator[Load]:
    """Where rays are straight: bricks front to back, each of which a ray meets once."""
    for brick in stream.order:
        if not stream.visible[brick]:
            continue
        number, finished = jnp.asarray(brick, jnp.int32), living[0].finished
        cells, any_ = _cells_of_straight(stream.grid, stream.scene.march, rays, finished, number)
        if any_:
            yield stream.load(brick, cells, *stream.around(brick))


def overlapping(stream: Stream, rays: Ray, living: list[Progress]) -> Iterator[Load]:
    """Where rays are curved: bricks front to back, each read with what rays come back to of those that had
    their turn, as far as memory goes; and again for rays that still come back."""
    return _until_all_left(stream, rays, living, lambda had: had)


def reloading(stream: Stream, rays: Ray, living: list[Progress]) -> Iterator[Load]:
    """Where rays are curved: bricks front to back, and again as long as rays come back to them."""
    return _until_all_left(stream, rays, living, lambda had: set())


def _until_all_left(
    stream: Stream, rays: Ray, living: list[Progress], overlap: Callable[[set[int]], set[int]]
) -> Iterator[Load]:
    reached, going = jnp.zeros(rays.length.shape, jnp.int32), True
    while going:
        had, going = set[int](), False
        for brick in stream.order:
            if not stream.visible[brick]:
                continue
            found = stream.found(brick, {brick, *overlap(had)}, rays, living[0], reached)
            if found is not None and not stream.make_room(found):
                found = stream.found(brick, {brick}, rays, living[0], reached, over_empty=False)
                assert found is None or stream.make_room(found)
            had.add(brick)
            if found is not None:
                going, reached = True, found.reached
                yield stream.load(brick, widened(found.cells), *stream.box_of(found))
        going &= not bool(jnp.all(living[0].finished))


METHODS: dict[str, Turns] = {"overlap": overlapping, "reload": reloading}


def _straight(
    grid: BrickGrid, march: March, rays: Ray, finished: Bool[Array, "*rays"], brick: Int[Array, ""]
) -> tuple[CellRange, Bool[Array, ""]]:
    cells = of_straight(grid, march, rays, ~finished, brick)
    return cells, jnp.any(cells.until > cells.first)


def _curved(
    mesh: Mesh | None,
    grid: BrickGrid,
    beyond: int,
    march: March,
    rays: Ray,
    at: Progress,
    reached: Array,
    turn: Turn,
) -> Found:
    """By beams of rays, as many as are looked at at a time."""

    def program(whole: tuple[March, Turn], dealt: tuple[Ray, Progress, Array]) -> tuple[None, Found]:
        march, turn = whole
        by_beam = jax.tree.map(lambda leaf: leaf.reshape(-1, 4, *leaf.shape[2:]), dealt)

        def some(each: tuple[Ray, Progress, Array]) -> Found:
            rays, at, reached = each
            return of_curved(grid, march, rays, at, reached, turn, beyond)

        found: Found = jax.lax.map(some, by_beam, batch_size=BEAMS)
        shape = dealt[0].length.shape
        cells: CellRange = jax.tree.map(lambda leaf: leaf.reshape(shape), found.cells)
        reached = found.reached.reshape(shape)
        return None, found._replace(cells=cells, reached=reached)

    _, found = devices.split(mesh, program, (march, turn), (rays, at, reached))
    low, high = jnp.min(found.low, 0), jnp.max(found.high, 0)
    return found._replace(low=low, high=high, any=jnp.any(found.any))


_cells_of_straight = compiled(_straight)
_cells_of_curved = compiled(_curved)
