"""Marches the rays of a tile to their ends, in batches of groups that are refilled as rays finish.

- Rays are compacted in small *groups* of neighbours. A *batch* of groups, which fits into the cache, is
  marched segment by segment until too few of its groups are left (`Tiling.min_alive`); then batches are
  refilled from the groups that are left. Idle lanes cost as much as working ones.
- On a GPU, to find out how many are left costs more than some idle lanes: a batch, of as many rays as keep it
  busy, is marched by a known number of segments (`Tiling.turns`), and refilled after each.
- The segment of a ray that may still shift (`Transform.shift`) ends at its next transparent cell. As soon as
  a batch has no such rays left, it takes whole segments without that test.
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

from ..compositing.blending import Outputs, Weighting
from ..march.beams import Box, EmptySpaceIndex
from ..march.march import March
from ..ray import Progress, Scene, begin, front, is_sample, measure, move, opacity, pieces
from ..scene.occupancy import Occupancy
from ..scene.space import Ray
from ..xla.compaction import in_front
from ..xla.memory import gather
from ..xla.sharding import varying
from ..xla.trees import PyTree
from .rays import RayTiles, vmap_rays
from .segment import Samples, SampleVisitor, march_segment, regular_from_here
from .tiling import Tiling


State: TypeAlias = tuple[Progress, tuple[PyTree, PyTree, PyTree]]
"""Where all rays are, and a visitor's `carry`, `sums` and `total`."""


class CellRange(NamedTuple):
    """Indices of steps: all visible cells of a ray begin at `first` or later, and before `until`."""

    first: Int[Array, "*rays"]
    until: Int[Array, "*rays"]


class VisibleRangeRecorder(SampleVisitor):
    """Records each ray's first and last visible cell, over rays of this shape. A ray without any has
    `until` = 0, and a `first` that is not one of its cells."""

    given = sums = total = None
    carry: CellRange

    def __init__(self, shape: tuple[int, ...]):
        self.carry = CellRange(
            jnp.full(shape, jnp.iinfo(jnp.int32).max, jnp.int32), jnp.zeros(shape, jnp.int32)
        )

    def visit(
        self, ray: Ray, at: Progress, samples: Samples, given: None, carry: CellRange, total: None
    ) -> tuple[CellRange, None, None]:
        begin = at.index[None] + jnp.arange(samples.number, dtype=at.index.dtype)[:, None]
        visible = jnp.any(jnp.stack(samples.opacity) > 0, axis=0) & ~at.finished[None]
        first = jnp.min(jnp.where(visible, begin, carry.first[None]), axis=0)
        until = jnp.max(jnp.where(visible, begin + 1, carry.until[None]), axis=0)
        return CellRange(jnp.minimum(carry.first, first), until), None, None


class Beams(eqx.Module):
    """Rays that are marched together, in groups, of which equally many in a row make up a beam.

    Attributes:
        rays: of shape (groups, rays in a group).
        count: number of beams.
        box: the boxes around the beams.
        range: where known, the cells outside of which a ray sees nothing, and is not marched.
    """

    rays: Ray
    count: int = eqx.field(static=True)
    box: Callable[[Occupancy], Box] = eqx.field(static=True)
    range: CellRange | None = None

    @classmethod
    def of(
        cls, tiles: RayTiles, source: Any, rays: Ray, tile: Int[Array, ""], range: CellRange | None = None
    ) -> "Beams":
        """The rays of a tile."""
        return cls(rays, tiles.beam_count, tiles.box(source, rays, tile), range)

    @property
    def groups(self) -> int:
        return self.rays.length.shape[0]


class Job(NamedTuple):
    """What does not change while the rays of a tile are marched.

    Attributes:
        skip_to: of the `EmptySpaceIndex`, asked about these beams; None where no empty space is known.
        resumable: whether rays that are finished stay where they are, so that they can go on from there; and
            `exact`: whether they take no cell behind the last one of their range.
    """

    scene: Scene
    beams: Beams
    tiling: Tiling
    visitor: SampleVisitor | None
    skip_to: Callable[..., Array] | None
    resumable: bool = False
    exact: bool = False

    def alive(self, at: Progress) -> Bool[Array, "*rays"]:
        """Rays that are not finished, and may take more samples."""
        return ~at.finished & (at.index < self.scene.march.most_samples)

    def shifts(self, at: Progress) -> Bool[Array, "*rays"]:
        """Rays that are alive and still have a shift ahead."""
        return self.alive(at) & ~regular_from_here(at)


def march_rays(
    scene: Scene,
    index: EmptySpaceIndex | None,
    beams: Beams,
    tiling: Tiling,
    outputs: Outputs | None = "all",
    visitor: SampleVisitor | None = None,
    resumed: Progress | None = None,
    exact: bool = False,
) -> State:
    """Marches all rays to their ends. Returns where they end, of shape (groups, rays in a group), with these
    outputs or nothing but opacity; and the visitor's `carry`, `sums` and `total`.

    `resumed`: where rays have come to, if not at their entries. Then `beams.range` says which of their cells
    are marched, and `index` is asked about these alone; a ray ends where they do, or up to a segment behind,
    and is `finished` there; or, if `exact`, just where they do."""
    march, rays = scene.march, beams.rays
    visible, skip_to = rays.length > 0, None
    if index is not None:
        prepared = index.prepare(beams.box, tiling.cells * march.step)
        seen = jnp.broadcast_to(index.any_visible(prepared), (beams.count,))
        visible &= jnp.repeat(seen, beams.groups // beams.count)[:, None]
        skip_to = partial(index.skip_to, prepared)
    if resumed is None:
        at = vmap_rays(lambda ray: begin(scene, ray, outputs))(rays)
        at = with_fields(at, finished=~visible)
    else:
        at = resumed
    # A shortcut: a ray with a shift ahead is put behind its first cell if that is transparent. Not for a
    # `Selection`, to which such cells may matter; not where rays leap, since a leap shifts them, too; not for
    # a visitor, which must see every sample.
    weighs = isinstance(scene.compositing, Weighting)
    if march.may_shift and weighs and index is None and visitor is None and resumed is None:
        at = vmap_rays(partial(_past_first_cell, scene))(rays, at)
    if beams.range is not None:
        first, until = beams.range
        if resumed is not None:
            first = jnp.where(visible, first, until)
        # `first` is not a valid index for rays that see nothing: these are finished before, and so not moved.
        at = finished_after(beams.range, at)
        at = vmap_rays(partial(_moved, march))(rays, at, jnp.maximum(first - at.index, 0))
        at = finished_after(beams.range, at)
    visited = (None, None, None) if visitor is None else (visitor.carry, visitor.sums, visitor.total)
    state: State = varying((at, visited), rays)
    return _march_all(Job(scene, beams, tiling, visitor, skip_to, resumed is not None, exact), state)


def _march_all(job: Job, state: State) -> State:
    """Marches groups for as long as any of their rays is alive, in rounds of batches."""
    size = job.tiling.batch_of(job.beams.groups)
    enough = int(job.tiling.min_alive * size)

    def round_(state: tuple[State, Bool[Array, " groups"]]) -> tuple[State, Bool[Array, " groups"]]:
        rows, count = in_front(state[1]), jnp.sum(state[1], dtype=jnp.int32)
        # only full batches, as long as there are any: what remains joins those of the next round
        batches = 1 if job.tiling.turns else jnp.maximum(count // size, 1)
        keep = jnp.where(count > size, enough, 0)

        def one(i: Int[Array, ""], state: tuple[State, Array]) -> tuple[State, Array]:
            some = jax.lax.dynamic_slice_in_dim(rows, i * size, size)
            after, going = _march_batch(job, some, state[0], keep)
            return after, state[1].at[some].set(going, mode="drop")

        return jax.lax.fori_loop(0, batches, one, state)

    going = jnp.any(job.alive(state[0]), axis=-1)
    return jax.lax.while_loop(lambda state: jnp.any(state[1]), round_, (state, going))[0]


def _march_batch(
    job: Job, rows: Int[Array, " batch"], state: State, keep: Int[Array, ""]
) -> tuple[State, Bool[Array, " batch"]]:
    """Marches the groups in these rows by `Tiling.turns` segments, or else while more than `keep` of them are
    alive, and tells which still are. A row past the last one stands for no group."""
    tiling, beams, visitor = job.tiling, job.beams, job.visitor
    size, group = rows.size, tiling.group
    known = jnp.minimum(rows, beams.groups - 1)
    beam = jnp.repeat(known // (beams.groups // beams.count), group)

    def take(leaf: Array) -> Array:
        # flat, so that the loop changes it in place: a reshape in there would copy it
        return gather(leaf, known).reshape(-1, *leaf.shape[2:])

    def grouped(part: Array) -> Array:
        return part.reshape(size, group, *part.shape[1:])

    def scatter(leaf: Array, part: Array) -> Array:
        return leaf.at[rows].set(grouped(part), mode="drop")

    def scatter_add(leaf: Array, part: Array) -> Array:
        return leaf.at[rows].add(grouped(part), mode="drop")

    at, (carry, sums, total) = state
    given = None if visitor is None else visitor.given
    rays, here, range_, given, carried = jax.tree.map(take, (beams.rays, at, beams.range, given, carry))
    here = with_fields(here, finished=here.finished | jnp.repeat(rows >= beams.groups, group))
    added = jax.tree.map(lambda leaf: jnp.zeros((size * group, *leaf.shape[2:]), leaf.dtype), sums)
    added = varying(added, rays)

    def groups(rays: Bool[Array, " rays"]) -> Bool[Array, " batch"]:
        # XLA finds the maximum of floats with SIMD, but looks at one truth value after the other
        return jnp.max(grouped(rays.astype(jnp.float32)), axis=-1) > 0

    def enough(here: Progress) -> Bool[Array, ""]:
        return jnp.sum(groups(job.alive(here))) > keep

    def advance(state: State, *, regular: bool) -> State:
        here, (carried, added, total) = state
        here = finished_after(range_, _to_next_cell(job, beam, rays, here, range_))
        until = range_.until if job.exact and range_ is not None else None
        after, samples = march_segment(job.scene, tiling, rays, here, regular=regular, until=until)
        if job.resumable:
            after = _staying(here, after)
        if visitor is not None:
            carried, found, total = visitor.visit(rays, here, samples, given, carried, total)
            added = jax.tree.map(jnp.add, added, found)
        return finished_after(range_, after), (carried, added, total)

    def turn(_: Int[Array, ""], state: State) -> State:
        here, visited = state
        over = ~job.alive(here)  # those out of samples, too: they must not take more
        after, visited = advance((with_fields(here, finished=over), visited), regular=not may_end)
        return with_fields(after, finished=jnp.where(over, here.finished, after.finished)), visited

    # segments in which a ray may shift, or run out of samples, cost a tenth more: so as few as possible
    limited = job.scene.march.max_samples is not None or job.exact
    may_end = limited or job.scene.march.may_shift
    marched: State = here, (carried, added, total)
    if tiling.turns:
        marched = jax.lax.fori_loop(0, tiling.turns, turn, marched)
    else:
        if may_end:
            marched = jax.lax.while_loop(
                lambda state: enough(state[0]) & (limited | jnp.any(job.shifts(state[0]))),
                partial(advance, regular=False),
                marched,
            )
        if not limited:
            marched = jax.lax.while_loop(
                lambda state: enough(state[0]), partial(advance, regular=True), marched
            )
    here, (carried, added, total) = marched
    visited = jax.tree.map(scatter, carry, carried), jax.tree.map(scatter_add, sums, added), total
    return (jax.tree.map(scatter, at, here), visited), groups(job.alive(here))


def with_fields(at: Progress, **changes: PyTree) -> Progress:
    """`at` with other values for these fields, of many rays (`dataclasses.replace` would check the shapes of
    one)."""
    return eqx.tree_at(lambda at: [getattr(at, name) for name in changes], at, list(changes.values()))


def finished_after(range_: CellRange | None, at: Progress) -> Progress:
    """Finishes rays that have passed the end of their range."""
    return at if range_ is None else with_fields(at, finished=at.finished | (at.index >= range_.until))


def _staying(here: Progress, after: Progress) -> Progress:
    """`after`, but rays that were finished before keep their position."""
    names = "index", "offset", "shift"
    there, moved = ({n: getattr(at, n) for n in names if getattr(at, n) is not None} for at in (here, after))
    return with_fields(after, **jax.tree.map(partial(jnp.where, here.finished), there, moved))


def _past_first_cell(scene: Scene, ray: Ray, at: Progress) -> Progress:
    """Moves a ray past its first cell if that is transparent. Most rays begin in empty space and would shift
    there, and so use one cell of their first segment only."""
    march, cut = scene.march, pieces(scene, ray, at)
    alphas = [opacity(scene, ray, piece, measure(scene, ray, piece)) for piece in cut]
    moves = jnp.all(jnp.stack(alphas) == 0) & ~at.finished
    moved = move(march, ray, at, jnp.ones((), bool), 1)
    if moved.stats is not None:
        count = jnp.sum(jnp.stack([is_sample(march, ray, piece, divided=len(cut) > 1) for piece in cut]))
        samples = moved.stats.samples + count.astype(moved.stats.samples.dtype)
        moved = eqx.tree_at(lambda moved: moved.stats.samples, moved, samples)
    return jax.tree.map(lambda a, b: jnp.where(moves, a, b), moved, at)


def _moved(march: March, ray: Ray, at: Progress, steps: Int[Array, ""]) -> Progress:
    """Moves a ray on by so many steps, whose cells are all transparent."""
    moved = move(march, ray, at, jnp.ones((), bool), steps)
    return jax.tree.map(lambda a, b: jnp.where((steps > 0) & ~at.finished, a, b), moved, at)


def _to_next_cell(
    job: Job, beam: Int[Array, " rays"], rays: Ray, at: Progress, range_: CellRange | None
) -> Progress:
    """Moves rays to their next cell that is not proven empty."""
    if job.skip_to is None:
        return at
    steps = _leap(job.scene.march, partial(job.skip_to, beam), rays, at)
    if range_ is not None:  # behind it, nothing is known
        steps = jnp.minimum(steps, jnp.maximum(range_.until - at.index, 0))
    return jax.vmap(partial(_moved, job.scene.march))(rays, at, steps)


def _leap(march: March, skip_to: Callable[..., Array], rays: Ray, at: Progress) -> Int[Array, " rays"]:
    """Steps to the first cell that is not proven empty. Where there is none, they end past the exit."""
    here = front(march, at)
    there = skip_to(rays, here)
    whole = jnp.floor((jnp.minimum(there, rays.length + march.step) - here) / march.step - 1e-3)
    # clipped before it becomes an integer, whose range it may exceed
    steps = jnp.clip(whole, 0, march.most_samples).astype(at.index.dtype)
    return jnp.minimum(steps, march.most_samples - at.index)
