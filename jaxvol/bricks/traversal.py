"""Marches an image's rays through all bricks, while the next brick is read."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Int

from .._util.files import MOST_VOXELS
from .._util.memory import give_back
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
from ..xla.trees import with_fields
from .cells import BrickCells, CurvedRays, Visit, curved_cells, padded, straight_cells
from .grid import BrickGrid, Margin, Node, divided, split, stored_shape
from .sources import READERS, VoxelSource
from .summary import summary_of


Schedule: TypeAlias = Callable[["Traversal"], Iterator["Load"]]
"""Which brick is read next, and for which cells of each ray. Bricks are planned one ahead of the march:
`Traversal.at` tells how far it has come."""

Method: TypeAlias = Literal["overlap", "reload"] | Schedule

BEAMS = 32  # of curved rays, searched at a time on a GPU: it takes as long as the longest of these
BATCH = 72  # groups at a time on a CPU: few rays meet a brick, and a batch lasts as long as its longest
KEPT = 64 * 2**20  # bytes that are read before freed memory is given back to the system, which takes 8 ms


class Load(NamedTuple):
    """A brick that is being read, its first node, and the cells that are marched in it."""

    brick: int
    cells: CellRange | None
    first: Node
    voxels: "Future[np.ndarray]"


@dataclass(frozen=True)
class Request:
    """What `render_bricks` was asked for."""

    source: VoxelSource
    memory: int
    counts: Any = None  # bricks along x, y and z, in place of those chosen to fit into `memory`
    method: Method | Any = "overlap"
    progress: Callable[[int, int], Any] | None = None
    outputs: Any = "all"
    mesh: Mesh | None = None  # devices to which bricks are dealt out


class Traversal:
    """An image's rays through all bricks. `scene`: as rays are marched, without voxels."""

    rays: Ray
    start: Progress  # at their entries
    at: Progress  # how far they have been marched

    def __init__(self, request: Request, shown: Scene):
        marched, outputs = shown.marched, request.outputs
        outputs = "depth" if shown.resolves and outputs == "rgba" else outputs
        assert isinstance(marched.source, Camera)
        self.request, self.source, self.scene = request, request.source, marched
        source, shape, counts = request.source, request.source.shape, request.counts
        tiling = Tiling.of_backend()
        if not tiling.turns:  # on a CPU
            tiling = tiling._replace(batch=BATCH)
        self.options = RenderOptions(outputs, tiling)
        self.done, self.bytes_read = 0, 0
        self.loads: list[int] = []  # bricks whose reading has begun
        self.space = marched.march.locate(marched.volume)
        margin = Margin.of(marched.march, self.space, shape, tiling.cells, shown)
        least = 1 if request.mesh is None else request.mesh.size
        if counts is None:
            self.grid = split(shape, source.dtype, request.memory, margin, least)
        else:
            self.grid = divided(shape, counts)
        self.margin = margin if request.method == "overlap" else replace(margin, probe=None)
        # nodes along each axis that are read at a time, and that any single brick needs
        self.stored = self.min_stored = self.margin.stored(self.grid)
        if math.prod(self.stored) > MOST_VOXELS:
            raise ValueError(
                f"bricks must be so many that each has fewer than 2**31 voxels; got {self.stored}."
            )
        if not self.margin.straight and not callable(request.method):
            # what is read follows from the rays: begin with less
            middle = (np.asarray(shape) - 1) / 2
            cells = self.margin.of_box(self.space, shape, middle, middle)
            self.stored = replace(self.margin, cells=cells).stored(self.grid)
        self.memory = max(request.memory, self.margin.bytes(self.min_stored, source.dtype))
        self.order = self.grid.order(self.space, marched.source)
        # last, since it may read the whole source
        occupied = eqx.Partial(marched.compositing.occupied, marched.transfer)
        self.visible = summary_of(source, memory=request.memory).bricks_where(occupied, self.grid)

    def bricks(self, rays: Ray, at: Progress) -> Iterator[tuple[Volume, CellRange]]:
        """Yields the needed bricks and their cells. Before the next, the caller drops it and sets `at`."""
        self.rays, self.start, self.at, given_back = rays, at, at, self.bytes_read
        method = self.request.method
        if not callable(method):
            method = in_order if self.margin.straight else METHODS[method]
        schedule = cast(Schedule, method)(self)
        load = next(schedule, None)
        while load is not None:
            jax.block_until_ready(self.at)  # or two bricks, and what is made of both, would be in memory
            if self.bytes_read - given_back >= KEPT:
                give_back()
                given_back = self.bytes_read
            # on a CPU, aligned voxels are not copied
            brick = with_voxels(self.scene.volume, [jax.device_put(load.voxels.result())])
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
        needed, loads, distinct = int(self.visible.sum()), len(self.loads), len(set(self.loads))
        held = self.margin.bytes(self.stored, self.source.dtype)
        return BrickReport(
            self.grid.counts, needed, loads, loads - distinct, self.bytes_read, self.stored, held
        )

    def cells_of(
        self, brick: int, passable: np.ndarray, empty: np.ndarray, reached: Array, beyond: int = 0
    ) -> BrickCells | None:
        """The cells of curved rays in a brick, None if there are none. `passable`, `empty`: as in `Visit`."""
        visit = jnp.asarray(brick, jnp.int32), jnp.asarray(passable), jnp.asarray(empty)
        march = self.scene.march
        # with their shift still ahead, or a cell that waits for a brick would leave it when its ray shifts
        at = with_fields(self.start, finished=self.at.finished)
        beams = BEAMS if self.options.tiling.turns else 1  # on a CPU
        found = _curved(beams, self.grid, beyond, march, (self.rays, at, reached), visit)
        return found if bool(found.any) else None

    def box_of(self, found: BrickCells) -> tuple[np.ndarray, np.ndarray] | None:
        """Box to read for these cells, which enlarges `stored`; None if memory does not suffice."""
        shape = self.grid.shape
        low, high = np.asarray(found.low, float), np.asarray(found.high, float)
        around = self.margin.of_points(self.space, shape, low, high)
        low, high = np.floor(low - 1e-2).astype(int) - around, np.ceil(high + 1e-2).astype(int) + around
        low, high = np.maximum(low, 0), np.minimum(high, np.asarray(shape) - 1)
        x, y, z = map(max, stored_shape(shape, tuple((high - low + 1).tolist())), self.stored)
        nx, ny, nz = map(max, (x, y, z), self.min_stored)
        if not self.margin.fits((nx, ny, nz), self.source.dtype, self.memory):
            return None
        self.stored = x, y, z
        return low, high

    def load(
        self, brick: int, cells: CellRange | None, box: tuple[np.ndarray, np.ndarray] | None = None
    ) -> Load:
        """Starts to read a brick, from a multiple of BLOCK on: `box`, or the nodes of all its cells."""
        if box is None:
            low, high = (np.asarray(end) for end in self.grid.cells(brick))
            box = low - self.margin.cells, high + self.margin.cells
        low, high = box
        shape, stored = np.asarray(self.grid.shape), np.asarray(self.stored)
        first = np.minimum(np.maximum(low, 0) // BLOCK * BLOCK, shape - stored)
        assert np.all(np.minimum(high, shape - 1) < first + stored), (low, high, first, stored)
        x, y, z = first.tolist()
        self.loads.append(brick)
        self.bytes_read += int(stored.prod()) * self.source.dtype.itemsize
        voxels = READERS.submit(self.source.read, first, first + stored, self.source.order)
        return Load(brick, cells, (x, y, z), voxels)


def in_order(traversal: Traversal) -> Iterator[Load]:
    """Where rays are straight: bricks front to back, each of which a ray meets once."""
    for brick in traversal.order:
        if traversal.visible[brick]:
            number, march = jnp.asarray(brick, jnp.int32), traversal.scene.march
            cells, any_ = _straight(traversal.grid, march, traversal.rays, traversal.at.finished, number)
            if any_:
                yield traversal.load(brick, cells)


def until_all_left(traversal: Traversal, *, overlap: bool) -> Iterator[Load]:
    """Where rays are curved: bricks front to back, and again as long as rays come back to them. With
    `overlap`, each is read with what rays come back to of those before it, as far as memory goes."""
    empty, steps = np.append(~traversal.visible, True), traversal.margin.steps
    reached, unfinished = jnp.zeros(traversal.rays.length.shape, jnp.int32), True
    while unfinished:
        before, unfinished = np.zeros_like(empty), False
        for brick in [b for b in traversal.order if traversal.visible[b]]:
            this = np.arange(len(empty)) == brick
            passable = empty | this | before if overlap else empty | this
            before |= this
            for through in (passable, this):  # through fewer bricks if memory does not suffice
                found = traversal.cells_of(brick, through, empty, reached, steps)
                box = None if found is None else traversal.box_of(found)
                if found is not None and box is not None:
                    unfinished, reached = True, found.reached
                    yield traversal.load(brick, padded(found.cells), box)
                if found is None or box is not None:
                    break
            assert found is None or box is not None
        unfinished &= not bool(jnp.all(traversal.at.finished))


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
    beams: int, grid: BrickGrid, beyond: int, march: March, rays: CurvedRays, visit: Visit
) -> BrickCells:
    """By beams of rays, so many of them at a time."""
    by_beam = jax.tree.map(lambda leaf: leaf.reshape(-1, 4, *leaf.shape[2:]), rays)
    found: BrickCells = jax.lax.map(
        lambda beam: curved_cells(grid, march, beam, visit, beyond), by_beam, batch_size=beams
    )
    shape = rays[0].length.shape
    cells: CellRange = jax.tree.map(lambda leaf: leaf.reshape(shape), found.cells)
    low, high, any_ = jnp.min(found.low, 0), jnp.max(found.high, 0), jnp.any(found.any)
    return BrickCells(cells=cells, reached=found.reached.reshape(shape), low=low, high=high, any=any_)
