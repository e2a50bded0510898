"""In which order are the rays of a tile marched? In batches of groups, refilled as rays finish.

- Rays are compacted in small *groups* of neighbours. A *batch* of groups, which fits into the cache, is
  marched segment by segment until too few of its groups are left (`Tiling.min_alive`); then batches are made
  up anew from the groups that are left. Idle lanes cost as much as working ones.
- On a GPU, to find out how many are left costs more than some idle lanes: a batch, of as many rays as keep it
  busy, is marched by a known number of segments (`Tiling.turns`), and made up anew after each.
- A ray that may still shift (`Transform.shift`) must stop at its next transparent cell. As soon as a batch
  has no such rays left, it takes whole segments without that test.
- Where empty space is known (`EmptySpaceIndex`), rays leap over it between two segments.

None of it shows in an image: cells, transforms and compositing are those of `reference`. (Measured on CPU.)
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..compositing.blending import Outputs, Weighting
from ..march.march import EmptySpaceIndex
from ..march.strides import steps_of
from ..reference import Pipeline, Progress, begin, is_sample, measure, move, opacity, pieces, with_stride
from ..scene.space import Ray
from ..xla.compaction import in_front
from ..xla.sharding import varying
from .batch import Beams, Job, State, finished_after, march_batch, over_transparent, with_fields
from .rays import vmap_rays
from .segment import SampleVisitor
from .tiling import Tiling


def march_rays(
    pipeline: Pipeline,
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
    march, rays = pipeline.march, beams.rays
    visible, prepared = rays.length > 0, None
    if index is not None:
        prepared = index.prepare(beams.box, tiling.cells * march.step)
        seen = jnp.broadcast_to(index.any_visible(prepared), (beams.count,))
        visible &= jnp.repeat(seen, beams.groups // beams.count)[:, None]
    job = Job(pipeline, beams, tiling, visitor, index, prepared, resumed is not None, exact)
    if resumed is None:
        at = vmap_rays(lambda ray: begin(pipeline, ray, outputs))(rays)
        at = with_fields(at, finished=~visible)
    else:
        at = resumed
    # Rays that may shift begin behind a transparent first cell. Not for a `Selection`, to which such cells
    # may matter; not where rays leap, since a leap shifts them, too; not for a visitor, which must see every
    # sample.
    weighs = isinstance(pipeline.compositing, Weighting)
    if march.may_shift and weighs and index is None and visitor is None and resumed is None:
        at = _past_first_cell(pipeline, rays, at)
    if beams.range is not None:
        over = vmap_rays(partial(over_transparent, pipeline))
        first, until = beams.range
        if resumed is not None:
            first = jnp.where(visible, first, until)
        # `first` is not a valid index for rays that see nothing: these are finished before, and so not moved.
        at = over(rays, finished_after(beams.range, at), jnp.maximum(first - at.index, 0))
        at = finished_after(beams.range, at)
    visited = (None, None, None) if visitor is None else (visitor.carry, visitor.sums, visitor.total)
    state: State = varying((at, visited), rays)
    return _marched(job, state)


def _marched(job: Job, state: State) -> State:
    """Marches groups for as long as any of their rays is alive, in rounds of batches."""
    size = min(job.tiling.batch, job.beams.groups)
    enough = int(job.tiling.min_alive * size)

    def round_(state: tuple[State, Bool[Array, " groups"]]) -> tuple[State, Bool[Array, " groups"]]:
        rows, count = in_front(state[1]), jnp.sum(state[1], dtype=jnp.int32)
        # only full batches, as long as there are any: what remains joins those of the next round
        batches = 1 if job.tiling.turns else jnp.maximum(count // size, 1)
        keep = jnp.where(count > size, enough, 0)

        def one(i: Int[Array, ""], state: tuple[State, Array]) -> tuple[State, Array]:
            some = jax.lax.dynamic_slice_in_dim(rows, i * size, size)
            after, going = march_batch(job, some, state[0], keep)
            return after, state[1].at[some].set(going, mode="drop")

        return jax.lax.fori_loop(0, batches, one, state)

    going = jnp.any(job.alive(state[0]), axis=-1)
    return jax.lax.while_loop(lambda state: jnp.any(state[1]), round_, (state, going))[0]


def _past_first_cell(pipeline: Pipeline, ray: Ray, at: Progress) -> Progress:
    """Moves rays past their first cell where it is transparent. Most rays begin in empty space and would
    shift there, and so use one cell of their first segment only."""

    march = pipeline.march

    def one(ray: Ray, at: Progress) -> Progress:
        begun, _ = with_stride(pipeline, ray, at)
        cut = pieces(pipeline, ray, begun)
        alphas = [opacity(pipeline, ray, piece, measure(pipeline, ray, piece)) for piece in cut]
        moves = jnp.all(jnp.stack(alphas) == 0) & ~at.finished
        moved = move(march, ray, begun, jnp.ones((), bool), steps_of(begun.strides))
        if moved.stats is not None:
            taken = jnp.sum(jnp.stack([is_sample(march, ray, piece, alone=len(cut) == 1) for piece in cut]))
            samples = moved.stats.samples + taken.astype(moved.stats.samples.dtype)
            moved = eqx.tree_at(lambda moved: moved.stats.samples, moved, samples)
        return jax.tree.map(lambda a, b: jnp.where(moves, a, b), moved, at)

    return vmap_rays(one)(ray, at)
