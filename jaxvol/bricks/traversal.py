"""Takes an image's rays through all bricks, while the next brick is read."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Int

from .._util.memory import give_back
from ..engine import devices
from ..engine.tiling import RenderOptions, Tiling
from ..engine.wavefront import CellRange
from ..march.march import March
from ..ray import Progress, Scene
from ..scene.camera import Camera
from ..scene.occupancy import BLOCK
from ..scene.rendering import BrickReport
from ..scene.space import Ray
from ..scene.volume import Volume, part_of, with_voxels
from ..xla.compiling import compiled
from .cells import BrickCells, Visit, curved_cells, padded, straight_cells
from .conversion import range_of
from .grid import BrickGrid, Node
from .sources import READERS, VoxelSource
from .split import Margin, bytes_of, check_stored, divided, fits, split, stored_of, stored_shape
from .summary import summary_of


Schedule: TypeAlias = Callable[["Traversal"], Iterator["Load"]]
"""Which brick is read next, and for which cells of each ray. Bricks are planned one ahead of the march:
`Traversal.at` tells how far it has come."""

Method: TypeAlias = Literal["overlap", "reload"] | Schedule

BEAMS = 32
"""Beams whose cells are looked for at a time, where rays are curved: it takes as long as the longest of their
rays."""

BATCH = 72
"""`Tiling.batch` on a CPU. Few rays meet a brick, and the last batch takes as long as its longest ray."""

KEPT = 64 * 2**20
"""Bytes that are read before freed memory is given back to the system, which takes some 8 ms."""


class Load(NamedTuple):
    """A brick that is being read, its first node, and the cells that are marched in it."""

    brick: int
    cells: CellRange | None
    first: Node
    voxels: "Future[np.ndarray]"


@dataclass(frozen=True)
class Request:
    """What `render_bricks` was asked for.

    - `counts`: bricks along x, y and z, in place of those chosen to fit into `memory`.
    - `mesh`: devices over which rays are dealt out, or bricks, if `deals_bricks`.
    - `traversals`: filled while the scene is rendered. A gradient has a second one.
    """

    source: VoxelSource
    memory: int
    counts: Node | None = None
    method: Method = "overlap"
    progress: Callable[[int, int], Any] | None = None
    outputs: Any = "all"
    mesh: Mesh | None = None
    deals_bricks: bool = False
    traversals: "list[Traversal]" = field(default_factory=list)


class Traversal:
    """An image's rays on their way through all bricks.

    - `scene`: with a volume without its voxels. `space`: of its grid.
    - `order`: bricks, front to back. `visible`: for each brick, whether anything may be visible in it.
    - `stored`: nodes along each axis that are read at a time. `min_stored`: as many as any single brick
      needs. `memory`: bytes that these may take.
    - `rays`, `at`: the rays, and how far they have been marched.
    - `done`: number of bricks that were rendered. `loads`: bricks whose reading has begun.
    """

    rays: Ray
    at: Progress

    def __init__(self, request: Request, marched: Scene, shown: Scene, outputs: Any):
        """Of a scene as its rays are marched, and as it is `shown`."""
        assert isinstance(marched.source, Camera)
        self.request, self.source, self.scene = request, request.source, marched
        source, memory, counts = request.source, request.memory, request.counts
        tiling = Tiling.of_backend(request.mesh)
        if not tiling.turns:  # on a CPU
            tiling = tiling._replace(batch=BATCH)
        self.options = RenderOptions(
            outputs, tiling._replace(devices=None) if request.deals_bricks else tiling
        )
        self.done, self.bytes_read = 0, 0
        self.loads: list[int] = []
        self.space, shape = marched.march.locate(marched.volume), source.shape
        margin = Margin.of(marched.march, self.space, shape, tiling.cells, shown)
        least = devices.number_of(request.mesh) if request.deals_bricks else 1
        self.grid = divided(shape, counts) if counts else split(shape, source.dtype, memory, margin, least)
        self.margin = margin if request.method == "overlap" else replace(margin, probe=None)
        self.stored = self.min_stored = stored_of(self.grid, self.margin)
        check_stored(self.stored)
        if not self.margin.straight and not callable(request.method):
            # what is read follows from the rays: begin with less
            middle = (np.asarray(shape) - 1) / 2
            cells = self.margin.of_box(self.space, shape, middle, middle)
            self.stored = stored_of(self.grid, replace(self.margin, cells=cells))
        self.memory = max(memory, bytes_of(self.min_stored, source.dtype, self.margin))
        self.order = self.grid.order(self.space, marched.source)
        # last, since it may read the whole source
        known = request.traversals
        self.summary = known[0].summary if known else summary_of(source, memory=memory)
        known.append(self)
        occupied = self.summary.where(eqx.Partial(marched.compositing.occupied, marched.transfer))
        self.visible = self.summary.bricks_with(occupied, self.grid)

    def bricks(self, rays: Ray, at: Progress) -> Iterator[tuple[Volume, CellRange]]:
        """Each brick that rays need, and their cells there, while the next one is read. Before this one is
        asked for, `at` is set to where rays have come, and the brick dropped."""
        self.rays, self.at, given_back = rays, at, self.bytes_read
        method = self.request.method
        if not callable(method):
            method = in_order if self.margin.straight else METHODS[method]
        schedule = method(self)
        load = next(schedule, None)
        while load is not None:
            jax.block_until_ready(self.at)  # or two bricks, and what is made of both, would be in memory
            if self.bytes_read - given_back >= KEPT:
                give_back()
                given_back = self.bytes_read
            # on a CPU, voxels are not copied if aligned (`empty_array`)
            brick = with_voxels(self.scene.volume, jax.device_put(load.voxels.result()))
            brick = part_of(brick, jnp.asarray(load.first, jnp.int32), self.grid.shape)
            cells = load.cells
            assert cells is not None
            del load  # and with it the voxels as they were read
            load = next(schedule, None)
            yield brick, cells
            del brick, cells
            self.finish(1, int(self.visible.sum()))

    def finish(self, bricks: int, of: int) -> None:
        """Reports that so many more bricks are rendered, `of` all that hold anything visible."""
        self.done += bricks
        if self.request.progress is not None:
            self.request.progress(self.done, of)

    def report(self) -> BrickReport:
        """What the bricks so far took."""
        return BrickReport(
            self.grid.counts,
            int(self.visible.sum()),
            len(self.loads),
            len(self.loads) - len(set(self.loads)),
            self.bytes_read,
            self.stored,
            bytes_of(self.stored, self.source.dtype, self.margin),
        )

    def cells_of(
        self, brick: int, passable: set[int], reached: Array, *, over_empty: bool = True
    ) -> BrickCells | None:
        """The cells of curved rays in a brick and in those through which they go on from it. `over_empty`:
        and in those that are empty."""
        empty = np.append(~self.visible, True)
        on = empty & over_empty
        on[list(passable)] = True
        visit = Visit(jnp.asarray(brick, jnp.int32), jnp.asarray(on), jnp.asarray(empty))
        return self.cells_in(visit, reached, self.margin.steps)

    def cells_in(self, visit: Visit, reached: Array, beyond: int = 0) -> BrickCells | None:
        """The cells of `curved_cells`; None if there are none."""
        mesh, march = self.options.tiling.devices, self.scene.march
        found = _curved(mesh, self.grid, beyond, march, self.rays, self.at, reached, visit)
        return found if bool(found.any) else None

    def around(self, brick: int) -> tuple[np.ndarray, np.ndarray]:
        """The box that is read for all cells of a brick."""
        low, high = (np.asarray(end) for end in self.grid.cells(brick))
        cells = self.margin.cells  # where rays are straight, of any box
        if not self.margin.straight:
            cells = self.margin.of_box(self.space, self.grid.shape, low, high)
        return low - cells, high + cells

    def box_of(self, found: BrickCells) -> tuple[np.ndarray, np.ndarray]:
        """The box that is read for these cells."""
        low, high = np.asarray(found.low, float), np.asarray(found.high, float)
        around = self.margin.of_points(self.space, self.grid.shape, low, high)
        low, high = np.floor(low - 1e-2).astype(int) - around, np.ceil(high + 1e-2).astype(int) + around
        return np.maximum(low, 0), np.minimum(high, np.asarray(self.grid.shape) - 1)

    def make_room(self, found: BrickCells) -> bool:
        """Whether the box of these cells fits into what is read at a time, which is enlarged for it as far as
        memory goes: so far that any single brick still fits."""
        low, high = self.box_of(found)
        wanted = stored_shape(self.grid.shape, tuple((high - low + 1).tolist()))
        x, y, z = map(max, wanted, self.stored)
        nx, ny, nz = map(max, (x, y, z), self.min_stored)
        room = fits((nx, ny, nz), self.source.dtype, self.margin, self.memory)
        self.stored = (x, y, z) if room else self.stored
        return room

    def load(self, brick: int, cells: CellRange | None, low: np.ndarray, high: np.ndarray) -> Load:
        """Starts to read a brick, for these cells: a box that begins at a multiple of BLOCK and holds these
        nodes."""
        shape, stored = np.asarray(self.grid.shape), np.asarray(self.stored)
        first = np.minimum(np.maximum(low, 0) // BLOCK * BLOCK, shape - stored)
        assert np.all(np.minimum(high, shape - 1) < first + stored), (low, high, first, stored)
        x, y, z = first.tolist()
        self.loads.append(brick)
        self.bytes_read += int(stored.prod()) * self.source.dtype.itemsize
        return Load(brick, cells, (x, y, z), READERS.submit(self._read, first, first + stored))

    def _read(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The voxels of a box, whose range tells whether they are those of the summary."""
        voxels = self.source.read(low, high, self.source.order)
        (least, most), (lowest, highest) = self.summary.range_of(low, high), range_of(voxels)
        if lowest < least or highest > most:
            raise ValueError(
                f"{self.source.name} changed since the ranges of its values were found: {least} to {most} "
                f"then, and {lowest} to {highest} now, in the box from {tuple(low.tolist())}. Open it again."
            )
        return voxels


def in_order(traversal: Traversal) -> Iterator[Load]:
    """Where rays are straight: bricks front to back, each of which a ray meets once."""
    for brick in traversal.order:
        if traversal.visible[brick]:
            number, march = jnp.asarray(brick, jnp.int32), traversal.scene.march
            cells, any_ = _straight(traversal.grid, march, traversal.rays, traversal.at.finished, number)
            if any_:
                yield traversal.load(brick, cells, *traversal.around(brick))


def until_all_left(traversal: Traversal, *, overlap: bool) -> Iterator[Load]:
    """Where rays are curved: bricks front to back, and again as long as rays come back to them. With
    `overlap`, each is read with what rays come back to of those before it, as far as memory goes."""
    reached, going = jnp.zeros(traversal.rays.length.shape, jnp.int32), True
    while going:
        before, going = set[int](), False
        for brick in traversal.order:
            if not traversal.visible[brick]:
                continue
            found = traversal.cells_of(brick, {brick, *(before if overlap else ())}, reached)
            if found is not None and not traversal.make_room(found):
                found = traversal.cells_of(brick, {brick}, reached, over_empty=False)
                assert found is None or traversal.make_room(found)
            before.add(brick)
            if found is not None:
                going, reached = True, found.reached
                yield traversal.load(brick, padded(found.cells), *traversal.box_of(found))
        going &= not bool(jnp.all(traversal.at.finished))


METHODS: dict[str, Schedule] = {
    "overlap": partial(until_all_left, overlap=True),
    "reload": partial(until_all_left, overlap=False),
}


@compiled
def _straight(
    grid: BrickGrid, march: March, rays: Ray, finished: Bool[Array, "*rays"], brick: Int[Array, ""]
) -> tuple[CellRange, Bool[Array, ""]]:
    cells = straight_cells(grid, march, rays, ~finished, brick)
    return cells, jnp.any(cells.until > cells.first)


@compiled
def _curved(
    mesh: Mesh | None,
    grid: BrickGrid,
    beyond: int,
    march: March,
    rays: Ray,
    at: Progress,
    reached: Array,
    visit: Visit,
) -> BrickCells:
    """By beams of rays, BEAMS of them at a time."""

    def program(whole: tuple[March, Visit], dealt: tuple[Ray, Progress, Array]) -> tuple[None, BrickCells]:
        march, visit = whole
        by_beam = jax.tree.map(lambda leaf: leaf.reshape(-1, 4, *leaf.shape[2:]), dealt)

        def some(each: tuple[Ray, Progress, Array]) -> BrickCells:
            rays, at, reached = each
            return curved_cells(grid, march, rays, at, reached, visit, beyond)

        found: BrickCells = jax.lax.map(some, by_beam, batch_size=BEAMS)
        shape = dealt[0].length.shape
        cells: CellRange = jax.tree.map(lambda leaf: leaf.reshape(shape), found.cells)
        return None, found._replace(cells=cells, reached=found.reached.reshape(shape))

    _, found = devices.split(mesh, program, (march, visit), (rays, at, reached))
    low, high = jnp.min(found.low, 0), jnp.max(found.high, 0)
    return found._replace(low=low, high=high, any=jnp.any(found.any))
