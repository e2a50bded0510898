"""Marches one batch of rays, segment after segment, until too few of them are left."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..march.beams import Box
from ..march.march import EmptySpaceIndex, March
from ..reference import Pipeline, Progress, front, move, with_stride
from ..scene.occupancy import Occupancy
from ..scene.space import Ray
from ..xla.sharding import varying
from ..xla.trees import PyTree
from ..xla.xla import gather, in_memory
from .segment import Samples, SampleVisitor, always, begins, march_segment, regular_from_here
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
        begin = at.index[None] + begins(at, samples.number).reshape(samples.number, -1)
        visible = jnp.any(jnp.stack(samples.opacity) > 0, axis=0) & ~at.finished[None]
        first = jnp.min(jnp.where(visible, begin, carry.first[None]), axis=0)
        until = jnp.max(jnp.where(visible, begin + 1, carry.until[None]), axis=0)
        return CellRange(jnp.minimum(carry.first, first), until), None, None


class Beams(eqx.Module):
    """Rays that are marched together, in groups, of which equally many in a row make up a beam.

    - `rays`: of shape (groups, rays in a group).
    - `count`: number of beams.
    - `box`: the boxes around the beams.
    - `range`: where known, the cells outside of which a ray sees nothing, and is not marched.
    """

    rays: Ray
    count: int = eqx.field(static=True)
    box: Callable[[Occupancy], Box] = eqx.field(static=True)
    range: CellRange | None = None

    @property
    def groups(self) -> int:
        return self.rays.length.shape[0]


class Job(NamedTuple):
    """All that does not change while rays are marched.

    - `empty_space`: where it is known, and `prepared`, what it has found out about these beams.
    - `resumable`: whether rays that are finished stay where they are, so that they can go on from there;
      and `exact`: whether they take no cell behind the last one of their range.
    """

    pipeline: Pipeline
    beams: Beams
    tiling: Tiling
    visitor: SampleVisitor | None
    empty_space: EmptySpaceIndex | None
    prepared: PyTree
    resumable: bool = False
    exact: bool = False

    def alive(self, at: Progress) -> Bool[Array, "*rays"]:
        """Rays that are not finished, and may take more samples."""
        return ~at.finished & (at.index < self.pipeline.march.most_samples)

    def shifts(self, at: Progress) -> Bool[Array, "*rays"]:
        """Those of them that still have a shift ahead."""
        return self.alive(at) & ~regular_from_here(at)


def march_batch(
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
        taken = gather(leaf, known)
        return taken.reshape(-1, *leaf.shape[2:])

    def grouped(part: Array) -> Array:
        return part.reshape(size, group, *part.shape[1:])

    def scatter(leaf: Array, part: Array) -> Array:
        return leaf.at[rows].set(grouped(part), mode="drop")

    def scatter_add(leaf: Array, part: Array) -> Array:
        return leaf.at[rows].add(grouped(part), mode="drop")

    at, (carry, sums, total) = state
    given = None if visitor is None else visitor.given
    rays, here, range_, given, mine = jax.tree.map(take, (beams.rays, at, beams.range, given, carry))
    here = with_fields(here, finished=here.finished | jnp.repeat(rows >= beams.groups, group))
    more = jax.tree.map(lambda leaf: jnp.zeros((size * group, *leaf.shape[2:]), leaf.dtype), sums)
    more = varying(more, rays)

    def groups(rays: Bool[Array, " rays"]) -> Bool[Array, " batch"]:
        # XLA finds the maximum of floats with SIMD, but looks at one truth value after the other
        return jnp.max(grouped(rays.astype(jnp.float32)), axis=-1) > 0

    def enough(here: Progress) -> Bool[Array, ""]:
        return jnp.sum(groups(job.alive(here))) > keep

    def advance(state: State, *, regular: bool) -> State:
        here, (mine, more, total) = state
        here = finished_after(range_, _to_next_cell(job, beam, rays, here, range_))
        until = range_.until if job.exact and range_ is not None else None
        after, samples = march_segment(job.pipeline, tiling, rays, here, regular=regular, until=until)
        if job.resumable:
            after = _staying(here, after)
        if visitor is not None:
            mine, found, total = visitor.visit(rays, here, samples, given, mine, total)
            more = jax.tree.map(jnp.add, more, found)
        return finished_after(range_, after), (mine, more, total)

    def turn(_: Int[Array, ""], state: State) -> State:
        here, visited = state
        over = ~job.alive(here)  # those out of samples, too: they must not take more
        after, visited = advance((with_fields(here, finished=over), visited), regular=not may_end)
        return with_fields(after, finished=jnp.where(over, here.finished, after.finished)), visited

    # segments in which a ray may shift, or run out of samples, cost a tenth more: so as few as possible
    limited = job.pipeline.march.max_samples is not None or job.exact
    may_end = limited or job.pipeline.march.may_shift
    marched: State = here, (mine, more, total)
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
    here, (mine, more, total) = marched
    visited = jax.tree.map(scatter, carry, mine), jax.tree.map(scatter_add, sums, more), total
    return (jax.tree.map(scatter, at, here), visited), groups(job.alive(here))


def with_fields(at: Progress, **changes: PyTree) -> Progress:
    """`at` with other values for these fields, of many rays (`dataclasses.replace` would check the shapes of
    one)."""
    return eqx.tree_at(lambda at: [getattr(at, name) for name in changes], at, list(changes.values()))


def _staying(here: Progress, after: Progress) -> Progress:
    """`after`, but where rays were finished before, where they are."""
    names = "index", "offset", "shift", "strides"
    there, moved = ({n: getattr(at, n) for n in names if getattr(at, n) is not None} for at in (here, after))
    return with_fields(after, **jax.tree.map(partial(jnp.where, here.finished), there, moved))


def over_transparent(pipeline: Pipeline, ray: Ray, at: Progress, steps: Int[Array, ""]) -> Progress:
    """Moves a ray on by so many steps, over which all cells are transparent, or to where the cell begins
    that lies there."""
    return _moved(pipeline.march, ray, *with_stride(pipeline, ray, at, steps))


def _moved(march: March, ray: Ray, at: Progress, steps: Int[Array, ""] | int) -> Progress:
    moved = move(march, ray, at, jnp.ones((), bool), steps)
    return jax.tree.map(lambda a, b: jnp.where((steps > 0) & ~at.finished, a, b), moved, at)


def _to_next_cell(
    job: Job, beam: Int[Array, " rays"], rays: Ray, at: Progress, range_: CellRange | None
) -> Progress:
    """Moves rays to their next cell that is not proven empty, and decides its stride."""
    pipeline = job.pipeline
    steps = None if job.empty_space is None else _leap(job, job.empty_space, beam, rays, at)
    if steps is not None and range_ is not None:  # behind it, nothing is known
        steps = jnp.minimum(steps, jnp.maximum(range_.until - at.index, 0))
    if at.strides is not None:
        ahead = jnp.zeros_like(at.index) if steps is None else steps
        # in memory, since all that computes with cells would decide it again
        at, found = in_memory(always(at), jax.vmap(partial(with_stride, pipeline)), rays, at, ahead)
        steps = None if steps is None else found
    return at if steps is None else jax.vmap(partial(_moved, pipeline.march))(rays, at, steps)


def finished_after(range_: CellRange | None, at: Progress) -> Progress:
    """Finishes rays that have passed their last visible cell."""
    return at if range_ is None else with_fields(at, finished=at.finished | (at.index >= range_.until))


def _leap(
    job: Job, empty_space: EmptySpaceIndex, beam: Int[Array, " rays"], rays: Ray, at: Progress
) -> Int[Array, " rays"]:
    """Steps to the first cell that is not proven empty. Where there is none, they end past the exit."""
    march = job.pipeline.march
    here = front(march, at)
    there = empty_space.skip_to(job.prepared, beam, rays, here)
    whole = jnp.floor((jnp.minimum(there, rays.length + march.step) - here) / march.step - 1e-3)
    # clipped before it becomes an integer, whose range it may exceed
    steps = jnp.clip(whole, 0, march.most_samples).astype(at.index.dtype)
    return jnp.minimum(steps, march.most_samples - at.index)
