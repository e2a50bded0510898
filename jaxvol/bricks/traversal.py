"""Marches an image's rays through the bricks, while the next brick is read."""

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
from ..engine.image import RenderOutputs
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
"""Generator of the bricks to read, with the cells of each ray. It runs one brick ahead of the march, whose
progress is `Traversal.at`."""

Method: TypeAlias = Literal["overlap", "reload"] | Schedule

BEAMS = 32  # beams of curved rays that a GPU searches at a time; a batch takes as long as its longest beam
BATCH = 72  # groups that a CPU marches at a time; few rays meet a brick, so that small batches are faster
KEPT = 64 * 2**20  # bytes read before freed memory is returned to the system, which takes 8 ms


class Load(NamedTuple):
    """A brick that is being read, its first node, and the cells that are marched in it."""

    brick: int
    cells: CellRange | None
    first: Node
    voxels: "Future[np.ndarray]"


@dataclass(frozen=True)
class Request:
    """Arguments of `render_bricks`."""

    source: VoxelSource
    memory: int
    counts: Any = None  # bricks along x, y and z; by default chosen to fit into `memory`
    method: Method = "overlap"
    progress: Callable[[int, int], Any] | None = None
    outputs: RenderOutputs = "all"
    mesh: Mesh | None = None  # devices over which bricks are distributed


class Traversal:
    """Traversal of the bricks by an image's rays. `scene`: as it is marched, without voxels."""

    rays: Ray
    start: Progress  # at the entries
    at: Progress  # of the march so far

    def __init__(self, request: Request, shown: Scene):
        marched, source, shape = shown.marched, request.source, request.source.shape
        outputs = "depth" if shown.resolves and request.outputs == "rgba" else request.outputs
        assert isinstance(marched.source, Camera)
        self.request, self.source, self.scene = request, source, marched
        tiling = Tiling.of_backend()
        if not tiling.turns:  # on a CPU
            tiling = tiling._replace(batch=BATCH)
        self.options = RenderOptions(outputs, tiling)
        self.done, self.bytes_read = 0, 0
        self.loads: list[int] = []  # bricks whose reading has begun
        self.space = marched.march.locate(marched.volume)
        margin = Margin.of(marched.march, self.space, shape, tiling.cells, shown)
        if request.counts is None:
            devices = 1 if request.mesh is None else request.mesh.size
            self.grid = split(shape, source.dtype, request.memory, margin, devices)
        else:
            self.grid = divided(shape, request.counts)
        self.margin = margin if request.method == "overlap" else replace(margin, probe=None)
        # shape of the boxes that are read, and the least for any single brick
        self.stored = self.min_stored = self.margin.stored(self.grid)
        if math.prod(self.stored) > MOST_VOXELS:
            raise ValueError(f"bricks must have fewer than 2**31 voxels each; got {self.stored}. Use more.")
        if not self.margin.straight and not callable(request.method):
            # the boxes to read follow from the rays: begin with small ones
            middle = (np.asarray(shape) - 1) / 2
            cells = self.margin.of_box(self.space, shape, middle, middle)
            self.stored = replace(self.margin, cells=cells).stored(self.grid)
        self.memory = max(request.memory, self.margin.bytes(self.min_stored, source.dtype))
        self.order = self.grid.order(self.space, marched.source)
        # last, since it may read the whole source
        occupied = eqx.Partial(marched.compositing.occupied, marched.transfer)
        self.visible = summary_of(source, memory=request.memory).bricks_where(occupied, self.grid)

    def bricks(self, rays: Ray, at: Progress) -> Iterator[tuple[Volume, CellRange]]:
        """Yields the needed bricks and their cells. The caller then drops the brick and sets `at`."""
        self.rays, self.start, self.at, returned = rays, at, at, self.bytes_read
        method = self.request.method
        if not callable(method):
            method = in_order if self.margin.straight else METHODS[method]
        schedule = cast(Schedule, method)(self)
        load = next(schedule, None)
        while load is not None:
            jax.block_until_ready(self.at)  # else two bricks and their derived arrays would be in memory
            if self.bytes_read - returned >= KEPT:
                give_back()
                returned = self.bytes_read
            # on a CPU, aligned voxels are not copied
            brick = with_voxels(self.scene.volume, [jax.device_put(load.voxels.result())])
            brick = part_of(brick, jnp.asarray(load.first, jnp.int32), self.grid.shape)
            cells = load.cells
            assert cells is not None
            del load  # and with it the voxels in the host's memory
            load = next(schedule, None)
            yield brick, cells
            del brick, cells
            self.finish(1, int(self.visible.sum()))

    def finish(self, bricks: int, total: int) -> None:
        """Reports `bricks` more rendered bricks of `total` visible ones."""
        self.done += bricks
        if self.request.progress is not None:
            self.request.progress(self.done, total)

    def report(self) -> BrickReport:
        """Report of the bricks read so far."""
        needed, loads = int(self.visible.sum()), len(self.loads)
        reloads, held = loads - len(set(self.loads)), self.margin.bytes(self.stored, self.source.dtype)
        return BrickReport(self.grid.counts, needed, loads, reloads, self.bytes_read, self.stored, held)

    def cells_of(
        self, brick: int, passable: np.ndarray, empty: np.ndarray, reached: Array, beyond: int = 0
    ) -> BrickCells | None:
        """The cells of curved rays in a brick, None if there are none. `passable`, `empty`: as in `Visit`."""
        visit = jnp.asarray(brick, jnp.int32), jnp.asarray(passable, bool), jnp.asarray(empty, bool)
        march = self.scene.march
        # from the start, before any shift, else a shift would move a waiting cell out of its brick
        at = with_fields(self.start, finished=self.at.finished)
        beams = BEAMS if self.options.tiling.turns else 1  # on a CPU
        cells = _curved(beams, self.grid, beyond, march, (self.rays, at, reached), visit)
        return cells if bool(cells.any) else None

    def box_of(self, cells: BrickCells) -> tuple[np.ndarray, np.ndarray] | None:
        """Box to read for cells, for which `stored` grows; None if memory does not suffice."""
        shape = self.grid.shape
        low, high = np.asarray(cells.low, float), np.asarray(cells.high, float)
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
        """Starts to read a brick from a multiple of BLOCK on: `box`, or the nodes of all its cells."""
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
    """Schedule for straight rays: front to back. A ray meets each brick once."""
    for brick in traversal.order:
        if traversal.visible[brick]:
            number, march = jnp.asarray(brick, jnp.int32), traversal.scene.march
            cells, any_ = _straight(traversal.grid, march, traversal.rays, traversal.at.finished, number)
            if any_:
                yield traversal.load(brick, cells)


def until_all_left(traversal: Traversal, *, overlap: bool) -> Iterator[Load]:
    """Schedule for curved rays: front to back, repeated while rays come back to bricks. With `overlap`, a
    brick is read with the parts of earlier bricks that its rays come back to, if memory suffices."""
    empty, steps = np.append(~traversal.visible, True), traversal.margin.steps
    reached, unfinished = jnp.zeros(traversal.rays.length.shape, jnp.int32), True
    while unfinished:
        before, unfinished = np.zeros_like(empty), False
        for brick in [b for b in traversal.order if traversal.visible[b]]:
            this = np.arange(len(empty)) == brick
            passable = empty | this | before if overlap else empty | this
            before |= this
            for through in (passable, this):  # through fewer bricks if memory does not suffice
                cells = traversal.cells_of(brick, through, empty, reached, steps)
                box = None if cells is None else traversal.box_of(cells)
                if cells is not None and box is not None:
                    unfinished, reached = True, cells.reached
                    yield traversal.load(brick, padded(cells.cells), box)
                if cells is None or box is not None:
                    break
            assert cells is None or box is not None
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
    """Cells of curved rays, by batches of `beams` beams."""
    by_beam = jax.tree.map(lambda leaf: leaf.reshape(-1, 4, *leaf.shape[2:]), rays)
    result: BrickCells = jax.lax.map(
        lambda beam: curved_cells(grid, march, beam, visit, beyond), by_beam, batch_size=beams
    )
    shape = rays[0].length.shape
    cells: CellRange = jax.tree.map(lambda leaf: leaf.reshape(shape), result.cells)
    low, high, nonempty = jnp.min(result.low, 0), jnp.max(result.high, 0), jnp.any(result.any)
    return BrickCells(cells, result.reached.reshape(shape), low, high, nonempty)
