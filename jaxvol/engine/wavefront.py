"""Marches the rays of a tile to their ends, in batches of groups that are refilled as rays finish.

- Rays are compacted in small *groups* of neighbours. A *batch* of groups, which fits into the cache, is
  marched segment by segment until too few of its groups are left (`Tiling.min_alive`); then batches are
  refilled from the groups that are left. Idle lanes cost as much as working ones.
- On a GPU, to find out how many are left costs more than some idle lanes: a batch, of as many rays as keep it
  busy, is marched by a known number of segments (`Tiling.turns`), and refilled after each.
- Where a ray shifts (`Transform.shift`) is found before it is marched (`shifts`), so that all of its cells
  are known. Through bricks, whose voxels are not there before, it is found on the way, cell by cell.
- Where empty space is known (`EmptySpaceIndex`), rays leap over it between two segments.

None of it shows in an image: cells, transforms and compositing are those of `ray`. (Measured on CPU.)
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
    """Indices of steps: all visible cells of a ray begin at `first` or later, and before `until`."""

    first: Int[Array, "*rays"]
    until: Int[Array, "*rays"]

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> "CellRange":
        """Those of rays without any visible cell."""
        return cls(jnp.full(shape, NEVER, jnp.int32), jnp.zeros(shape, jnp.int32))

    def widened(self, at: Progress, samples: Samples) -> "CellRange":
        """The range with those cells of a segment that are visible."""
        number = at.index[None] + jnp.arange(samples.number, dtype=at.index.dtype)[:, None]
        visible = jnp.any(jnp.stack(samples.opacity) > 0, axis=0) & ~at.finished[None]
        first = jnp.min(jnp.where(visible, number, NEVER), axis=0)
        until = jnp.max(jnp.where(visible, number + 1, 0), axis=0)
        return CellRange(jnp.minimum(self.first, first), jnp.maximum(self.until, until))


class Recorded(NamedTuple):
    """What the first march of rays leaves for the second.

    Attributes:
        range: of their visible cells, where rays leap.
        shifted: where they shift, where they do.
        rays: of an image of a single tile, which need not be made again for what they do not depend on.
        skips: where these see nothing.
    """

    range: CellRange | None
    shifted: Int[Array, "*rays"] | None
    rays: Ray | None = None
    skips: Skips | None = None

    def with_rays(self, rays: Ray, skips: Skips | None) -> "Recorded":
        """The same of a single tile, with its rays."""
        # other skips are for beams without ranges
        return self._replace(rays=rays, skips=skips if isinstance(skips, Stretches) else None)


class Marched(NamedTuple):
    """What marching a tile's rays found, of shape (groups, rays in a group)."""

    lanes: Packed
    track: Track
    total: PyTree
    """Of the visitor."""

    @property
    def at(self) -> Progress:
        """Where the rays end."""
        return vmap_rays(_progress)(self.lanes.tree, self.track)

    @property
    def range(self) -> CellRange | None:
        """The range of each ray's visible cells, if it was asked for."""
        return self.lanes.tree.range

    @property
    def visited(self) -> Visited:
        """What the visitor did."""
        lanes = self.lanes.tree
        return lanes.carry, lanes.sums, self.total


class Lanes(eqx.Module):
    """What of rays changes while they are marched."""

    index: Int[Array, "*rays"]
    composite: PyTree
    stats: Any
    finished: Bool[Array, "*rays"]
    shifted: Int[Array, "*rays"] | None
    range: CellRange | None
    carry: PyTree
    sums: PyTree


class Job(NamedTuple):
    """What does not change while the rays of a tile are marched.

    Attributes:
        fixed: what does not change of rays: `Ray`, `Track`, and the visitor's `given`.
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
        """Those of the march."""
        rules: Any = self.scene.march
        return rules


def alive(at: Progress) -> Bool[Array, "*rays"]:
    """Rays that are not finished, and may take more samples."""
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
        scene: prepared, with the `rules` of its march in the march's place.
        rays: of shape (groups, rays in a group); equally many groups in a row make up a beam.
        start: where they are.
        skips: where their beams see nothing, if that is known.
        record: whether to record the range of each ray's visible cells.
        shifts: whether rays find on their way where they shift.
    """
    if shifts:  # a cell at a time, since those behind a transparent one lie elsewhere
        tiling = tiling._replace(cells=1)
    given, carry, sums, total = None, None, None, None
    if visitor is not None:
        given, carry, sums, total = visitor.given, visitor.carry, visitor.sums, visitor.total
    track, shifted = start.track, None
    if shifts:
        track, shifted = with_fields(track, shifted=None), track.shifted
    range_ = CellRange.none(start.index.shape) if record else None
    fixed = rays, track, given
    lanes = Lanes(start.index, start.composite, start.stats, start.finished, shifted, range_, carry, sums)
    lanes, total = varying((lanes, total), rays)
    job = Job(scene, tiling, fixed, visitor, skips, shifts)
    going = jnp.any(alive(start), axis=-1)
    packed, total = _march_all(job, Layout.of(lanes).pack(lanes), total, going)
    return Marched(packed, track, total)


def _progress(lanes: Lanes, track: Track) -> Progress:
    """Where one ray is."""
    if lanes.shifted is not None:
        track = with_fields(track, shifted=lanes.shifted)
    return Progress(lanes.index, lanes.composite, lanes.stats, lanes.finished, track)


def _march_all(
    job: Job, lanes: Packed, total: PyTree, going: Bool[Array, " groups"]
) -> tuple[Packed, PyTree]:
    """Marches groups for as long as any of their rays is alive, in rounds of batches."""
    size = job.tiling.batch_of(job.groups)
    enough = int(job.tiling.min_alive * size)

    def round_(state: Any) -> Any:
        # of floats, which XLA adds with SIMD
        rows, count = in_front(state[2]), jnp.sum(state[2].astype(jnp.float32)).astype(jnp.int32)
        # only full batches, as long as there are any: what remains joins those of the next round
        batches = 1 if job.tiling.turns else jnp.maximum(count // size, 1)
        keep = jnp.where(count > size, enough, 0)

        def one(i: Int[Array, ""], state: Any) -> Any:
            packed, total, going = state
            some = jax.lax.dynamic_slice_in_dim(rows, i * size, size)
            packed, total, living = _march_batch(job, some, packed, total, keep)
            return packed, total, going.at[some].set(living, mode="drop", unique_indices=True)

        return jax.lax.fori_loop(0, batches, one, state)

    start = lanes, total, going
    packed, total, _ = jax.lax.while_loop(lambda state: jnp.any(state[2]), round_, start)
    return packed, total


def _march_batch(
    job: Job, rows: Int[Array, " batch"], packed: Packed, total: PyTree, keep: Int[Array, ""]
) -> tuple[Packed, PyTree, Bool[Array, " batch"]]:
    """Marches the groups in these rows by `Tiling.turns` segments, or else while more than `keep` of them are
    alive, and tells which still are. A row past the last one stands for no group."""
    tiling, group = job.tiling, job.tiling.group
    known = jnp.minimum(rows, job.groups - 1)
    beam = jnp.repeat(known // GROUPS_OF_BEAM, group)
    lanes = packed.take(known).tree

    def take(leaf: Array) -> Array:
        # from each array by itself: to join those of all rays would take longer
        return gather(leaf, known).reshape(-1, *leaf.shape[2:])

    taken = jax.tree.map(take, job.fixed)
    none = jnp.repeat(rows >= job.groups, group)
    lanes = with_fields(lanes, finished=lanes.finished | none)

    def living(lanes: Lanes) -> Bool[Array, " batch"]:
        _, track, _ = taken
        rays = ~lanes.finished & (lanes.index < track.until)
        # XLA finds the maximum of floats with SIMD, but looks at one truth value after the other
        return jnp.max(rays.astype(jnp.float32).reshape(-1, group), axis=-1) > 0

    def advance(state: tuple[Lanes, PyTree]) -> tuple[Lanes, PyTree]:
        lanes, total = state
        rays, track, given = taken
        here = _to_next_cell(job, beam, rays, jax.vmap(_progress)(lanes, track))
        after, samples = march_segment(job.scene, tiling, rays, here, shifts=job.shifts)
        carry, sums = lanes.carry, lanes.sums
        if job.visitor is not None:
            carry, found, total = job.visitor.visit(samples.ray, here, samples, given, carry, total)
            sums = jax.tree.map(jnp.add, sums, found)
        range_ = None if lanes.range is None else lanes.range.widened(here, samples)
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


def blinded(skips: Skips | None, at: Progress) -> Progress:
    """Finishes the rays of beams along which nothing is visible."""
    if skips is None:
        return at
    groups = at.finished.shape[0]
    seen = jnp.broadcast_to(skips.any_visible(), (groups // GROUPS_OF_BEAM,))
    return with_fields(at, finished=at.finished | ~jnp.repeat(seen, GROUPS_OF_BEAM)[:, None])


def into_range(scene: Scene, rays: Ray, at: Progress, range_: CellRange, *, shifts: bool = False) -> Progress:
    """Moves rays to the first cell of their range, in front of which all cells are transparent. They take no
    cell behind its last one."""
    first, until = range_
    at = eqx.tree_at(lambda at: at.track.until, at, jnp.minimum(until, at.track.until))
    # of rays that see nothing, `first` is no index
    steps = jnp.where(first < until, jnp.maximum(first - at.index, 0), 0)
    return vmap_rays(partial(_moved, scene.march, transparent=_clear(shifts)))(rays, at, steps)


def _clear(shifts: bool) -> Bool[Array, ""] | None:
    """What `move` is told of transparent cells."""
    return jnp.ones((), bool) if shifts else None


def _moved(march: Any, ray: Ray, at: Progress, steps: Int[Array, ""], *, transparent: Any) -> Progress:
    """Moves a ray on by so many steps, whose cells are all transparent. `transparent`: as for `move`."""
    moved = move(march, ray, at, transparent, steps)
    return jax.tree.map(lambda a, b: jnp.where((steps > 0) & ~at.finished, a, b), moved, at)


def _to_next_cell(job: Job, beam: Int[Array, " rays"], rays: Ray, at: Progress) -> Progress:
    """Moves rays to their next cell that is not proven empty."""
    if job.skips is None:
        return at
    steps = _leap(job.rules, partial(job.skips.skip_to, beam), rays, at)
    return jax.vmap(partial(_moved, job.rules, transparent=_clear(job.shifts)))(rays, at, steps)


def _leap(march: CellRules, skip_to: Callable[..., Array], rays: Ray, at: Progress) -> Int[Array, " rays"]:
    """Steps to the first cell that is not proven empty. Where there is none, they end past the exit."""
    here = front(march, at)
    there = skip_to(rays, here)
    whole = jnp.floor((jnp.minimum(there, rays.length + march.step) - here) / march.step - 1e-3)
    left = jnp.maximum(at.track.until - at.index, 0)
    # clipped before it becomes an integer, whose range it may exceed
    steps = jnp.clip(whole, 0, left.astype(whole.dtype)).astype(left.dtype)
    return jnp.minimum(steps, left)
