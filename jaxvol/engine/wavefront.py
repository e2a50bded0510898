"""Marches the rays of a tile to their ends, in batches of groups that are refilled as rays finish.

- Rays are compacted in small *groups* of neighbours. A *batch* of groups, which fits into the cache, is
  marched segment by segment until too few of its groups are alive (`Tiling.min_alive`); then batches are
  refilled from the living groups. Idle lanes cost as much as working ones.
- On a GPU, counting the living groups costs more than some idle lanes: a batch, large enough to keep the GPU
  busy, is marched by a constant number of segments (`Tiling.turns`) between two refills.
- The shift of a ray (`Transform.shift`) is found before the march (`shifts`), so that all cells are known.
  Through bricks, whose voxels are loaded during the march, it is found cell by cell.
- With an `EmptySpaceIndex`, rays leap over empty space between two segments.

The image does not depend on it: cells, transforms and compositing are those of `ray`. (Measured on CPU.)
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..march.beams import Skips, Stretches
from ..march.march import CellRules
from ..ray import NEVER, Progress, Scene, Track, front, move
from ..scene.space import Ray
from ..xla.compaction import in_front
from ..xla.memory import gather
from ..xla.packing import Layout, Packed
from ..xla.sharding import varying
from ..xla.trees import PyTree, with_fields
from .rays import vmap_rays
from .segment import Samples, SampleVisitor, march_segment
from .tiling import GROUPS_OF_BEAM, Tiling


Visited: TypeAlias = tuple[PyTree, PyTree, PyTree]
"""A visitor's `carry`, `sums` and `total`."""


class CellRange(NamedTuple):
    """Indices of cells: all visible cells of a ray are in [first, until)."""

    first: Int[Array, "*rays"]
    until: Int[Array, "*rays"]

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "CellRange":
        """The ranges of rays without visible cells."""
        return cls(jnp.full(shape, NEVER, jnp.int32), jnp.zeros(shape, jnp.int32))

    def widened(self, at: Progress, samples: Samples) -> "CellRange":
        """The range, extended by the visible cells of a segment."""
        number = at.index[None] + jnp.arange(samples.number, dtype=at.index.dtype)[:, None]
        visible = jnp.any(jnp.stack(samples.opacity) > 0, axis=0) & ~at.finished[None]
        first = jnp.min(jnp.where(visible, number, NEVER), axis=0)
        until = jnp.max(jnp.where(visible, number + 1, 0), axis=0)
        return CellRange(jnp.minimum(self.first, first), jnp.maximum(self.until, until))


class Recorded(NamedTuple):
    """Record of the first march of rays, for the second.

    Attributes:
        range: range of visible cells, if rays leap.
        shifted: cell behind which each ray shifts, if rays shift.
        rays: rays of an image of a single tile, reused if they are not differentiated.
        skips: empty stretches along these rays.
    """

    range: CellRange | None
    shifted: Int[Array, "*rays"] | None
    rays: Ray | None = None
    skips: Skips | None = None

    def with_rays(self, rays: Ray, skips: Skips | None) -> "Recorded":
        """The record of a single tile, with its rays."""
        # other skips are of use only without ranges
        return self._replace(rays=rays, skips=skips if isinstance(skips, Stretches) else None)


class Marched(NamedTuple):
    """Result of marching a tile's rays, of shape (groups, rays in a group)."""

    lanes: Packed
    track: Track
    total: PyTree
    """Total of the visitor."""

    @property
    def at(self) -> Progress:
        """Progress of the rays at their ends."""
        return vmap_rays(_progress)(self.lanes.tree, self.track)

    @property
    def range(self) -> CellRange | None:
        """The range of each ray's visible cells, if it was recorded."""
        return self.lanes.tree.range

    @property
    def visited(self) -> Visited:
        """The visitor's carry, sums and total."""
        lanes = self.lanes.tree
        return lanes.carry, lanes.sums, self.total


class Lanes(eqx.Module):
    """State of rays that changes while they are marched."""

    index: Int[Array, "*rays"]
    composite: PyTree
    stats: Any
    finished: Bool[Array, "*rays"]
    shifted: Int[Array, "*rays"] | None
    range: CellRange | None
    carry: PyTree
    sums: PyTree


class Job(NamedTuple):
    """Constants of the march of a tile's rays.

    Attributes:
        fixed: constants of rays: `Ray`, `Track`, and the visitor's `constants`.
        skips, shifts: as for `march_rays`.
    """

    scene: Scene
    tiling: Tiling
    fixed: tuple[Ray, Track, PyTree]
    visitor: SampleVisitor | None
    skips: Skips | None
    shifts: bool

    @property
    def groups(self) -> int:
        """Number of groups."""
        return self.fixed[0].length.shape[0]

    @property
    def rules(self) -> CellRules:
        """The rules of the march."""
        rules: Any = self.scene.march
        return rules


def alive(at: Progress) -> Bool[Array, "*rays"]:
    """True for rays that are not finished, and may take more samples."""
    return ~at.finished & (at.index < at.track.until)


def march_rays(
    scene: Scene,
    rays: Ray,
    start: Progress,
    tiling: Tiling,
    skips: Skips | None = None,
    visitor: SampleVisitor | None = None,
    *,
    record: bool = False,
    shifts: bool = False,
) -> Marched:
    """Marches rays to their ends.

    Args:
        scene: the prepared scene, with the `rules` of its march as `march`.
        rays: rays of shape (groups, rays in a group); `GROUPS_OF_BEAM` successive groups form a beam.
        start: progress of the rays.
        skips: empty stretches along the beams, if known.
        visitor: visitor of all samples.
        record: whether to record the range of each ray's visible cells.
        shifts: whether the march finds the shifts of rays.
    """
    if shifts:  # one cell at a time, since the cells behind a transparent one are shifted
        tiling = tiling._replace(cells=1)
    constants, carry, sums, total = None, None, None, None
    if visitor is not None:
        constants, carry, sums, total = visitor.constants, visitor.carry, visitor.sums, visitor.total
    track, shifted = start.track, None
    if shifts:
        track, shifted = with_fields(track, shifted=None), track.shifted
    range_ = CellRange.none(start.index.shape) if record else None
    fixed = rays, track, constants
    lanes = Lanes(start.index, start.composite, start.stats, start.finished, shifted, range_, carry, sums)
    lanes, total = varying((lanes, total), rays)
    job = Job(scene, tiling, fixed, visitor, skips, shifts)
    living = jnp.any(alive(start), axis=-1)
    packed, total = _march_all(job, Layout.of(lanes).pack(lanes), total, living)
    return Marched(packed, track, total)


def _progress(lanes: Lanes, track: Track) -> Progress:
    """The progress of one ray."""
    if lanes.shifted is not None:
        track = with_fields(track, shifted=lanes.shifted)
    return Progress(lanes.index, lanes.composite, lanes.stats, lanes.finished, track)


def _march_all(
    job: Job, lanes: Packed, total: PyTree, living: Bool[Array, " groups"]
) -> tuple[Packed, PyTree]:
    """Marches groups in rounds of batches, until no ray is alive."""
    size = job.tiling.batch_of(job.groups)
    enough = int(job.tiling.min_alive * size)

    def round_(state: PyTree) -> PyTree:
        # as floats, which XLA adds with SIMD
        rows, count = in_front(state[2]), jnp.sum(state[2].astype(jnp.float32)).astype(jnp.int32)
        # only full batches, if any: the remaining groups join the next round
        batches = 1 if job.tiling.turns else jnp.maximum(count // size, 1)
        keep = jnp.where(count > size, enough, 0)

        def one(i: Int[Array, ""], state: PyTree) -> PyTree:
            packed, total, living = state
            batch = jax.lax.dynamic_slice_in_dim(rows, i * size, size)
            packed, total, living_batch = _march_batch(job, batch, packed, total, keep)
            return packed, total, living.at[batch].set(living_batch, mode="drop", unique_indices=True)

        return jax.lax.fori_loop(0, batches, one, state)

    start = lanes, total, living
    packed, total, _ = jax.lax.while_loop(lambda state: jnp.any(state[2]), round_, start)
    return packed, total


def _march_batch(
    job: Job, rows: Int[Array, " batch"], packed: Packed, total: PyTree, keep: Int[Array, ""]
) -> tuple[Packed, PyTree, Bool[Array, " batch"]]:
    """Marches the groups in these rows by `Tiling.turns` segments, or while more than `keep` are alive, and
    returns which are still alive. A row past the last group is padding."""
    tiling, group = job.tiling, job.tiling.group
    known = jnp.minimum(rows, job.groups - 1)
    beam = jnp.repeat(known // GROUPS_OF_BEAM, group)
    lanes = packed.take(known).tree

    def take(leaf: Array) -> Array:
        # from each array separately: packing the arrays of all rays would take longer
        return gather(leaf, known).reshape(-1, *leaf.shape[2:])

    rays, track, constants = jax.tree.map(take, job.fixed)
    padding = jnp.repeat(rows >= job.groups, group)
    lanes = with_fields(lanes, finished=lanes.finished | padding)

    def living(lanes: Lanes) -> Bool[Array, " batch"]:
        active = ~lanes.finished & (lanes.index < track.until)
        # XLA reduces floats with SIMD, booleans one by one
        return jnp.max(active.astype(jnp.float32).reshape(-1, group), axis=-1) > 0

    def advance(state: tuple[Lanes, PyTree]) -> tuple[Lanes, PyTree]:
        lanes, total = state
        at = to_next_cell(job, beam, rays, jax.vmap(_progress)(lanes, track))
        visited = job.visitor is not None
        after, samples = march_segment(job.scene, tiling, rays, at, shifts=job.shifts, visited=visited)
        carry, sums = lanes.carry, lanes.sums
        if job.visitor is not None:
            carry, terms, total = job.visitor.visit(samples.ray, at, samples, constants, carry, total)
            sums = jax.tree.map(jnp.add, sums, terms)
        range_ = None if lanes.range is None else lanes.range.widened(at, samples)
        shifted = after.track.shifted if job.shifts else None
        moved = after.index, after.composite, after.stats, after.finished, shifted
        return Lanes(*moved, range_, carry, sums), total

    state = lanes, total
    if tiling.turns:
        state = jax.lax.fori_loop(0, tiling.turns, lambda _, state: advance(state), state)
    else:

        def going(state: tuple[Lanes, PyTree]) -> Bool[Array, ""]:
            return jnp.sum(living(state[0]).astype(jnp.float32)) > keep.astype(jnp.float32)

        state = jax.lax.while_loop(going, advance, state)
    lanes, total = state
    return packed.put(rows, lanes), total, living(lanes)


def finish_blind(skips: Skips | None, at: Progress) -> Progress:
    """Finishes the rays of beams without visible cells."""
    if skips is None:
        return at
    groups = at.finished.shape[0]
    visible = jnp.broadcast_to(skips.any_visible(), (groups // GROUPS_OF_BEAM,))
    return with_fields(at, finished=at.finished | ~jnp.repeat(visible, GROUPS_OF_BEAM)[:, None])


def into_range(scene: Scene, rays: Ray, at: Progress, range_: CellRange, *, shifts: bool = False) -> Progress:
    """Moves rays over transparent cells to the first cell of their range, and limits them to its last one."""
    first, until = range_
    at = eqx.tree_at(lambda at: at.track.until, at, jnp.minimum(until, at.track.until))
    # `first` of an empty range is no index
    steps = jnp.where(first < until, jnp.maximum(first - at.index, 0), 0)
    return vmap_rays(partial(_moved, scene.march, transparent=_clear(shifts)))(rays, at, steps)


def _clear(shifts: bool) -> Bool[Array, ""] | None:
    """The argument `transparent` of `move`, for transparent cells."""
    return jnp.ones((), bool) if shifts else None


def _moved(march: Any, ray: Ray, at: Progress, steps: Int[Array, ""], *, transparent: PyTree) -> Progress:
    """Moves a ray over `steps` transparent cells. `transparent`: as for `move`."""
    moved = move(march, ray, at, transparent, steps)
    return jax.tree.map(lambda a, b: jnp.where((steps > 0) & ~at.finished, a, b), moved, at)


def to_next_cell(job: Job, beam: Int[Array, " rays"], rays: Ray, at: Progress) -> Progress:
    """Moves rays to their next cell that is not proven empty."""
    if job.skips is None:
        return at
    steps = _leap(job.rules, partial(job.skips.skip_to, beam), rays, at)
    return jax.vmap(partial(_moved, job.rules, transparent=_clear(job.shifts)))(rays, at, steps)


def _leap(march: CellRules, skip_to: Callable[..., Array], rays: Ray, at: Progress) -> Int[Array, " rays"]:
    """Number of steps to the first cell that is not proven empty, or past the exit without one."""
    depth = jax.vmap(partial(front, march))(rays, at)
    target = jnp.minimum(skip_to(rays, depth), rays.length + march.step)
    if march.grows:
        inside = jnp.minimum(target, rays.length)
        target = jax.vmap(march.distance)(inside, rays) + (target - inside)
        depth = jax.vmap(lambda at: at.track.distance(at.index, march.step))(at)
    steps = jnp.floor((target - depth) / march.step - 1e-3)
    limit = jnp.maximum(at.track.until - at.index, 0)
    # clipped as a float, since it may exceed the range of integers
    return jnp.minimum(jnp.clip(steps, 0, limit.astype(steps.dtype)).astype(limit.dtype), limit)
