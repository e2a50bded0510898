"""Path regeneration: walks of a queue begin in idle lanes; the last walks are compacted into fewer lanes."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .walks import Walk, WalkResult


BUSY = 0.75
"""New walks wait while more than this share of the lanes is busy."""

FEWER = 8
"""Divisor of the number of lanes once the queue is empty."""

Index: TypeAlias = Int[Array, " lanes"]
"""Index in the queue of the walk in each lane."""


class _Lanes(NamedTuple):
    """Walks in their lanes, their indices in the queue, the number of walks begun, and the results so far."""

    walks: Walk
    queue_index: Index
    begun: Int[Array, ""]
    results: WalkResult


def walk_all(
    begin: Callable[[Index], Walk], step: Callable[[Walk], Walk], count: int, lanes: int
) -> WalkResult:
    """Results of `count` walks. `begin`: walks by index, not alive from `count` on; `step`: advances all."""
    lanes = min(lanes, count)
    fewer = -(-lanes // FEWER)
    none = jnp.full(lanes, count, jnp.int32)
    idle = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(begin, none))
    state = _Lanes(idle, none, jnp.zeros((), jnp.int32), WalkResult.zeros((count,)))

    def refill_and_step(state: _Lanes) -> _Lanes:
        free = ~state.walks.alive
        results = _stored(state, jnp.where(free, state.queue_index, count))
        queued = state.begun + jnp.cumsum(free, dtype=jnp.int32) - 1
        queue_index = jnp.where(free, jnp.minimum(queued, count), state.queue_index)
        walks = jax.tree.map(lambda new, old: jnp.where(free, new, old), begin(queue_index), state.walks)
        begun = jnp.minimum(state.begun + jnp.sum(free, dtype=jnp.int32), count)
        keep = jnp.where(begun < count, int(BUSY * lanes), fewer)
        return _step_until(step, _Lanes(walks, queue_index, begun, results), keep)

    state = jax.lax.while_loop(lambda state: state.begun < count, refill_and_step, state)
    state = _step_until(step, _compact(state, fewer, count), jnp.zeros((), jnp.int32))
    return _stored(state, state.queue_index)


def _stored(state: _Lanes, index: Index) -> WalkResult:
    """The results after storing those of the lanes at `index`; an index past the end stores nothing."""
    return jax.tree.map(
        lambda results, lanes: results.at[index].set(lanes, mode="drop"), state.results, state.walks.result
    )


def _step_until(step: Callable[[Walk], Walk], state: _Lanes, keep: Int[Array, ""]) -> _Lanes:
    """Step until at most `keep` walks are alive."""

    def busy(walks: Walk) -> Bool[Array, ""]:
        return jnp.sum(walks.alive, dtype=jnp.int32) > keep

    return state._replace(walks=jax.lax.while_loop(busy, step, state.walks))


def _compact(state: _Lanes, lanes: int, count: int) -> _Lanes:
    """Compact the walks that are alive into `lanes` lanes, and store the results of the others."""
    alive = state.walks.alive
    results = _stored(state, jnp.where(alive, count, state.queue_index))
    indices = jnp.nonzero(alive, size=lanes, fill_value=alive.shape[0])[0]
    queue_index = state.queue_index.at[indices].get(mode="fill", fill_value=count)
    walks = jax.tree.map(lambda leaf: leaf.at[indices].get(mode="fill", fill_value=0), state.walks)
    return _Lanes(walks, queue_index, state.begun, results)
