"""Which samples are taken together? Several cells of each of many rays that are still alive.

What makes this fast was measured (on CPU, by XLA's rules), and is what this file is about:

- A *segment* is CELLS cells of a ray. All its samples are taken before any is blended, since only then XLA
  fetches each voxel once: it repeats a fetch for every use that it makes of it, unless a branch stands
  between, behind which values lie in memory. So measuring is one `lax.cond`, what a transfer function
  searches for in its table another, and the opacities a third.
- Rays come in small *groups* of neighbours. A *batch* of groups, which fits into the cache, is marched
  segment after segment until a quarter of its groups is finished; then batches are made up anew from the
  groups that are left. Lanes that idle cost as much as those that work.
- Rays that a transform may still move take a segment in part. Groups with such rays are marched first, by
  themselves, until none is left; what follows does not ask for them. But where most groups have them, all
  are marched so: apart from their neighbours, rays would find little of what they fetch in the cache.
- Where empty space is known (`EmptySpaceIndex`), rays leap over it between two segments, each as far as it
  can.

None of it shows in the result: cells, transforms and the blending are those of `reference`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from .._util.compaction import in_front
from .._util.sharding import varying
from .._util.vec3 import Scalar
from .._util.xla import in_memory
from ..beams import Box
from ..march import Cell, EmptySpaceIndex, March
from ..occupancy import Occupancy
from ..reference import Progress, begin, blend, counts, front, measure, move, opacity, pieces
from ..rendering import Found
from ..space import Ray
from ..transfer import Classification, Measured
from ..volume import Volume
from .shading import shaded_colors


CELLS = 8
"""Cells of a segment."""

GROUP = 16
"""Rays that live and die together as far as batches go: a quarter of a beam."""

BATCH = 520
"""Groups marched at a time. Not 512: rows of 8192 floats would lie 32 KiB apart, and all of them, of all
arrays, fall to the same few lines of the cache."""

KEPT = 0.75
"""The share of a batch's groups that must be alive for it to go on."""


_State: TypeAlias = tuple[Progress, Any]
"""Where all rays are, and what a follower remembers of them, adds up for them, and over all of them."""


class CellRange(NamedTuple):
    """Between which of its cells a ray sees anything: from `first` on, and before `until`."""

    first: Int[Array, "*rays"]
    until: Int[Array, "*rays"]


class Beams(eqx.Module):
    """Rays that are marched together, in groups of which some make up a beam.

    - `rays`: of shape (groups, GROUP).
    - `count`: how many beams. As many groups after each other make up each of them.
    - `box`: the boxes around the beams.
    - `span`: where that is known, no more of a ray is marched than its span.
    """

    rays: Ray
    count: int = eqx.field(static=True)
    box: Callable[[Occupancy], Box] = eqx.field(static=True)
    span: CellRange | None = None


class Samples(NamedTuple):
    """The pieces of the next cells of many rays: arrays (CELLS, rays), one of each kind for each piece that
    a cell may fall into. Those that a ray does not come to lie past its exit."""

    cells: list[Cell]
    measured: list[Measured]
    opacity: list[Scalar]


class SampleVisitor(ABC):
    """Something that goes along with a march, and looks at all samples.

    - `given`, `kept`, `sums`: what it knows of each ray, remembers, and adds up from 0: (groups, GROUP).
    - `total`: what it adds up over all rays.
    """

    given: PyTree
    kept: PyTree
    sums: PyTree
    total: PyTree

    @abstractmethod
    def follow(
        self, ray: Ray, at: Progress, samples: Samples, given: PyTree, kept: PyTree, total: PyTree
    ) -> tuple[PyTree, PyTree, PyTree]:
        """What it remembers behind the samples of some rays, what they add to the rays' sums, and the total
        with them."""


def march_rays(
    march: March,
    volume: Volume,
    seen: Classification,
    index: EmptySpaceIndex | None,
    beams: Beams,
    outputs: Found | None = "all",
    follower: SampleVisitor | None = None,
) -> tuple[Progress, tuple[Any, Any, Any]]:
    """Where the marches of all rays end, of shape (groups, GROUP), with these outputs or nothing but opacity;
    and what a follower who went along remembers of each ray, has added up for it, and over all of them."""
    rays, groups = beams.rays, beams.rays.length.shape[0]
    capped = march.max_samples is not None
    size = min(BATCH, groups)
    at = jax.vmap(jax.vmap(lambda ray: begin(march, ray, outputs)))(rays)
    finished = rays.length <= 0
    prepared = None
    if index is not None:
        prepared = index.prepare(beams.box, CELLS * march.step)
        hopeful = jnp.broadcast_to(index.any_visible(prepared), (beams.count,))
        finished |= ~jnp.repeat(hopeful, groups // beams.count)[:, None]
    at = _with(at, finished=finished)
    together = jnp.zeros((), bool)
    if march.may_shift and index is None and follower is None:
        at = _probe(march, volume, seen, rays, at)
        together = _mostly(_alive(march, at) & ~_regular(at), of=_alive(march, at))
    if beams.span is not None:
        over = jax.vmap(jax.vmap(partial(_over, march)))
        # those that see nothing are finished first, and so stay where they are: `first` is no index of theirs
        at = over(rays, _until(beams.span, at), beams.span.first)

    def wanted(at: Progress, whole: bool) -> Bool[Array, "*rays"]:
        """Which rays a pass is for: all, or first those that may still shift, unless they are most."""
        alive = _alive(march, at)
        return alive if whole or capped else alive & (together | ~_regular(at))

    def run(
        rows: Int[Array, " batch"], state: _State, keep: Int[Array, ""], whole: bool
    ) -> tuple[_State, Bool[Array, " batch"]]:
        """March the groups in these rows for a while, and tell which are to go on; a row past the last one
        stands for none."""
        known = jnp.minimum(rows, groups - 1)
        beam = jnp.repeat(known // (groups // beams.count), GROUP)

        def take(leaf: Array) -> Array:
            # side by side, so that each is changed where it lies: a reshape in the loop would copy it
            taken = leaf.at[known].get(mode="promise_in_bounds", wrap_negative_indices=False)
            return taken.reshape(-1, *leaf.shape[2:])

        def put(leaf: Array, part: Array) -> Array:
            return leaf.at[rows].set(part.reshape(size, GROUP, *part.shape[1:]), mode="drop")

        def add(leaf: Array, part: Array) -> Array:
            return leaf.at[rows].add(part.reshape(size, GROUP, *part.shape[1:]), mode="drop")

        at, (kept, sums, total) = state
        given = None if follower is None else follower.given
        some, here, span, given, mine = jax.tree.map(take, (rays, at, beams.span, given, kept))
        here = _with(here, finished=here.finished | jnp.repeat(rows >= groups, GROUP))
        more = jax.tree.map(lambda leaf: jnp.zeros((size * GROUP, *leaf.shape[2:]), leaf.dtype), sums)
        more = varying(more, some)

        def going(here: Progress) -> Bool[Array, " batch"]:
            # XLA finds the largest of several floats at once, but looks at one truth after the other
            return jnp.max(wanted(here, whole).astype(jnp.float32).reshape(size, GROUP), axis=-1) > 0

        def go(state: _State) -> _State:
            here, along = state
            here = here if index is None else _leap(march, index, prepared, beam, some, here)
            after, samples = _segment(march, volume, seen, some, here, whole=whole)
            if follower is not None:
                mine, more, total = along
                mine, found, total = follower.follow(some, here, samples, given, mine, total)
                along = mine, jax.tree.map(jnp.add, more, found), total
            return _until(span, after), along

        here, (mine, more, total) = jax.lax.while_loop(
            lambda state: jnp.sum(going(state[0])) > keep, go, (here, (mine, more, total))
        )
        along = jax.tree.map(put, kept, mine), jax.tree.map(add, sums, more), total
        return (jax.tree.map(put, at, here), along), going(here)

    def march_all(state: _State, *, whole: bool) -> _State:
        """March all groups for as long as they are wanted."""

        def round_(state: tuple[_State, Bool[Array, " groups"]]) -> tuple[_State, Bool[Array, " groups"]]:
            rows, count = in_front(state[1]), jnp.sum(state[1], dtype=jnp.int32)
            # only full batches, as long as there are any: what remains joins those of the next round
            batches = jnp.maximum(count // size, 1)
            keep = jnp.where(count > size, int(KEPT * size), 0)

            def one(i: Int[Array, ""], state: tuple[_State, Array]) -> tuple[_State, Array]:
                some = jax.lax.dynamic_slice_in_dim(rows, i * size, size)
                after, going = run(some, state[0], keep, whole)
                return after, state[1].at[some].set(going, mode="drop")

            return jax.lax.fori_loop(0, batches, one, state)

        going = jnp.any(wanted(state[0], whole), axis=-1)
        return jax.lax.while_loop(lambda state: jnp.any(state[1]), round_, (state, going))[0]

    along = (None, None, None) if follower is None else (follower.kept, follower.sums, follower.total)
    state: _State = varying((at, along), rays)
    if march.may_shift or capped:
        state = march_all(state, whole=False)
    if not capped:
        state = march_all(state, whole=True)
    return state


def _with(at: Progress, **changes: Array) -> Progress:
    """Other values for some fields of many rays at once."""
    return eqx.tree_at(lambda at: [getattr(at, name) for name in changes], at, list(changes.values()))


def _alive(march: March, at: Progress) -> Bool[Array, "*rays"]:
    return ~at.finished & (at.index < march.most_samples)


def vmap_cells(f: Any, of_cells: tuple[bool, ...] = (True,)) -> Any:
    """A function of one ray, of arrays (rays,) and, where `of_cells`, (CELLS, rays)."""
    return jax.vmap(jax.vmap(f), in_axes=tuple(0 if each else None for each in of_cells))


def _mostly(some: Bool[Array, "groups rays"], of: Bool[Array, "groups rays"]) -> Bool[Array, ""]:
    """Whether most groups with any ray of the one kind have one of the other."""
    return 2 * jnp.sum(jnp.any(some, axis=-1)) > jnp.sum(jnp.any(of, axis=-1))


def _regular(at: Progress) -> Bool[Array, "*rays"]:
    """Which rays advance by whole steps from here on."""
    return jnp.ones(at.finished.shape, bool) if at.shift is None else at.shift == 0


def _segment(
    march: March, volume: Volume, seen: Classification, ray: Ray, at: Progress, *, whole: bool
) -> tuple[Progress, Samples]:
    """The next cells of each ray, on to where it is finished, or has shifted off the places sampled here.
    `whole` tells that no ray shifts any more, so that each may take all the cells."""
    ahead = jnp.arange(CELLS, dtype=at.index.dtype)

    def every(at: Progress) -> tuple[Cell, ...]:
        def one(ray: Ray, at: Progress, k: Int[Array, ""]) -> tuple[Cell, ...]:
            return pieces(march, ray, volume, front(march, at, k))

        return jax.vmap(jax.vmap(one, in_axes=(0, 0, None)), in_axes=(None, None, 0))(ray, at, ahead)

    cut = every(at)
    divided = len(cut) > 1
    # To find where a cell is divided is work not to be done twice; a whole cell costs less than memory does.
    given = cut if divided else None

    def cells(at: Progress, given: Any) -> tuple[Cell, ...]:
        return given if divided else every(at)

    def measured(at: Progress, given: Any) -> list[Measured]:
        each = vmap_cells(lambda ray, piece: seen.measure(ray.path(march.sample(piece))), (False, True))
        return [each(ray, piece) for piece in cells(at, given)]

    def opacities(at: Progress, given: Any, values: list[Measured]) -> list[Scalar]:
        each = vmap_cells(
            lambda ray, piece, read: opacity(march, ray, seen, piece, read), (False, True, True)
        )
        return [each(ray, piece, read) for piece, read in zip(cells(at, given), values, strict=True)]

    # Always true, but opaque to XLA, so that the branches survive. An index grows by at most CELLS a segment,
    # finished or not, and there are no more segments in a pass than `march.most_samples`, which is at most
    # 2**24: it never overflows. Whether any ray is alive would take 1 % of a frame to find out each time.
    live = at.index[0] >= 0
    values = in_memory(live, measured, at, given)
    if seen.search is not None:
        found = in_memory(live, lambda values: [vmap_cells(seen.search)(v) for v in values], values)
        values = [(*read, *more) for read, more in zip(values, found, strict=True)]
    alphas = in_memory(live, opacities, at, given, values)
    samples = Samples(list(cells(at, given)), values, alphas)
    taken, moved = CELLS, None
    if not whole:
        taken, moved = _taken(march, at, alphas)
        # what is not taken is blended as if it lay past the exit
        takes = ahead[:, None] < taken[None]
        left_out = [
            eqx.tree_at(lambda cell: cell.front, cell, jnp.where(takes, cell.front, ray.length[None]))
            for cell in samples.cells
        ]
        samples = Samples(left_out, values, [jnp.where(takes, alpha, 0) for alpha in alphas])
    if seen.light is None:
        colors = [vmap_cells(seen.classify)(read)[0] for read in values]
    else:
        colors = shaded_colors(seen, march, ray, at, *samples)
    blended = jax.vmap(lambda ray, at, cell: blend(march, ray, at, cell))
    taken_cells = tuple(zip(samples.cells, colors, samples.opacity, strict=True))
    # unrolled, so that nothing between two cells is put in memory
    after, _ = jax.lax.scan(lambda at, cell: (blended(ray, at, cell), None), at, taken_cells, unroll=CELLS)
    if moved is None:
        after = jax.vmap(lambda ray, at: move(march, ray, at, None, CELLS))(ray, after)
    else:
        after = jax.vmap(lambda ray, at, *how: move(march, ray, at, *how))(ray, after, moved, taken)
    return after, samples


def _taken(
    march: March, at: Progress, alphas: list[Scalar]
) -> tuple[Int[Array, " rays"], Bool[Array, " rays"]]:
    """How many of a segment's cells a ray takes, and whether the last of them shifts it. A ray that may still
    shift goes no farther than its next transparent cell, behind which its samples lie elsewhere than here."""
    left = march.most_samples - at.index
    transparent = jnp.all(jnp.stack(alphas) == 0, axis=0)
    # not by argmax, which XLA compares pair by pair
    upto = jnp.arange(1, CELLS + 1, dtype=left.dtype)[:, None]
    first = jnp.min(jnp.where(transparent, upto, CELLS + 1), axis=0)
    moved = ~_regular(at) & (first <= jnp.minimum(left, CELLS))
    return jnp.minimum(jnp.where(moved, first, CELLS), left), moved


def _probe(march: March, volume: Volume, seen: Classification, ray: Ray, at: Progress) -> Progress:
    """Move on from a first cell that is transparent, as that of most rays is: one that is moved there would
    take no more than this cell of a segment."""

    def one(ray: Ray, at: Progress) -> Progress:
        cut = pieces(march, ray, volume, front(march, at))
        alphas = [opacity(march, ray, seen, piece, measure(march, ray, seen, piece)) for piece in cut]
        goes = jnp.all(jnp.stack(alphas) == 0) & ~at.finished
        gone = move(march, ray, at, jnp.ones((), bool))
        if gone.met is not None:
            taken = jnp.sum(jnp.stack([counts(march, ray, piece) for piece in cut]))
            samples = gone.met.samples + taken.astype(gone.met.samples.dtype)
            gone = eqx.tree_at(lambda gone: gone.met.samples, gone, samples)
        return jax.tree.map(lambda a, b: jnp.where(goes, a, b), gone, at)

    return jax.vmap(jax.vmap(one))(ray, at)


def _leap(
    march: March, index: EmptySpaceIndex, prepared: PyTree, beam: Int[Array, " rays"], rays: Ray, at: Progress
) -> Progress:
    """On to the first cell that reaches into what is not known to be empty. A ray that has nothing ahead of
    it is finished."""
    here = front(march, at)
    there = index.skip_to(prepared, beam, rays, here)
    whole = jnp.floor((jnp.minimum(there, rays.length + march.step) - here) / march.step - 1e-3)
    # limited before it becomes an integer, of which it may exceed the largest
    cells = jnp.minimum(
        jnp.clip(whole, 0, march.most_samples).astype(at.index.dtype), march.most_samples - at.index
    )
    return jax.vmap(partial(_over, march))(rays, at, cells)


def _over(march: March, ray: Ray, at: Progress, cells: Int[Array, ""]) -> Progress:
    """On over so many cells, all of which are transparent."""
    gone = move(march, ray, at, jnp.ones((), bool), cells)
    return jax.tree.map(lambda a, b: jnp.where((cells > 0) & ~at.finished, a, b), gone, at)


def _until(span: CellRange | None, at: Progress) -> Progress:
    """Finished where nothing more is seen."""
    return at if span is None else _with(at, finished=at.finished | (at.index >= span.until))
