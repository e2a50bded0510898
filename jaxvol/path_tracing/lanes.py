"""Path regeneration: walks of a queue begin in idle lanes; the last walks are compacted into fewer lanes."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..xla.trees import PyTree


BUSY = 0.75
"""New walks wait while more than this share of the lanes is busy."""

FEWER = 8
"""Divisor of the number of lanes once the queue is empty."""

Index: TypeAlias = Int[Array, " lanes"]
"""Index in the queue of the walk in each lane."""


class _Lanes(NamedTuple):
    """Walks in their lanes, their indices in the queue, the number of walks begun, the results so far, and
    sums over all steps so far."""

    walks: Any
    queue_index: Index
    begun: Int[Array, ""]
    results: PyTree
    sums: PyTree


Step: TypeAlias = Callable[[Any, PyTree], tuple[Any, PyTree]]
"""`step(walks, sums)` advances all walks, and adds to the sums."""


def walk_all(
    begin: Callable[[Index], Any], step: Step, count: int, lanes: int, sums: PyTree = ()
) -> tuple[PyTree, PyTree]:
    """Results of `count` walks, and the sums after their last step.

    Args:
        begin: walks by index, not alive from `count` on. Walks have the attributes `alive` and `result`.
        step: advances all walks.
        count: number of walks.
        lanes: number of walks that run side by side.
        sums: the sums before the first step.
    """
    lanes = min(lanes, count)
    fewer = -(-lanes // FEWER)
    none = jnp.full(lanes, count, jnp.int32)
    idle = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(begin, none))
    results = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape[1:]), leaf.dtype), idle.result)
    state = _Lanes(idle, none, jnp.zeros((), jnp.int32), results, sums)

    def refill_and_step(state: _Lanes) -> _Lanes:
        free = ~state.walks.alive
        results = _stored(state, jnp.where(free, state.queue_index, count))
        queued = state.begun + jnp.cumsum(free, dtype=jnp.int32) - 1
        queue_index = jnp.where(free, jnp.minimum(queued, count), state.queue_index)
        walks = jax.tree.map(lambda new, old: jnp.where(free, new, old), begin(queue_index), state.walks)
        begun = jnp.minimum(state.begun + jnp.sum(free, dtype=jnp.int32), count)
        keep = jnp.where(begun < count, int(BUSY * lanes), fewer)
        return _step_until(step, _Lanes(walks, queue_index, begun, results, state.sums), keep)

    state = jax.lax.while_loop(lambda state: state.begun < count, refill_and_step, state)
    state = _step_until(step, _compact(state, fewer, count), jnp.zeros((), jnp.int32))
    return _stored(state, state.queue_index), state.sums


def _stored(state: _Lanes, index: Index) -> PyTree:
    """The results after storing those of the lanes at `index`; an index past the end stores nothing."""
    return jax.tree.map(
        lambda results, lanes: results.at[index].set(lanes, mode="drop"), state.results, state.walks.result
    )


def _step_until(step: Step, state: _Lanes, keep: Int[Array, ""]) -> _Lanes:
    """Step until at most `keep` walks are alive."""

    def busy(moving: tuple[Any, PyTree]) -> Bool[Array, ""]:
        return jnp.sum(moving[0].alive, dtype=jnp.int32) > keep

    moving = state.walks, state.sums
    walks, sums = jax.lax.while_loop(busy, lambda moving: step(*moving), moving)
    return state._replace(walks=walks, sums=sums)


def _compact(state: _Lanes, lanes: int, count: int) -> _Lanes:
    """Compact the walks that are alive into `lanes` lanes, and store the results of the others."""
    alive = state.walks.alive
    results = _stored(state, jnp.where(alive, count, state.queue_index))
    indices = jnp.nonzero(alive, size=lanes, fill_value=alive.shape[0])[0]
    queue_index = state.queue_index.at[indices].get(mode="fill", fill_value=count)
    walks = jax.tree.map(lambda leaf: leaf.at[indices].get(mode="fill", fill_value=0), state.walks)
    return _Lanes(walks, queue_index, state.begun, results, state.sums)
