"""Which walks go on side by side? As many as there are lanes; a walk that ends makes room for the next.

Walks differ in length by orders of magnitude. A lane whose walk has ended would idle until the longest has.
So walks are a queue: once a quarter of the lanes is idle, what their walks have brought is put away, and the
next ones of the queue begin. When the queue is empty, what is left moves together into fewer lanes.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .walks import Walk


BUSY = 0.75
"""The share of lanes that must be busy for new walks to wait."""

FEWER = 8
"""By this the number of lanes is divided once the queue is empty."""

Number: TypeAlias = Int[Array, " lanes"]


class PathResults(NamedTuple):
    """What the walks of a queue have brought, one entry for each."""

    red: Float[Array, " walks"]
    green: Float[Array, " walks"]
    blue: Float[Array, " walks"]
    met: Bool[Array, " walks"]
    scatterings: Int[Array, " walks"]
    exhausted: Bool[Array, " walks"]

    @classmethod
    def nothing(cls, count: int) -> "PathResults":
        dark, no = jnp.zeros(count, jnp.float32), jnp.zeros(count, bool)
        return cls(dark, dark, dark, no, jnp.zeros(count, jnp.int32), no)

    def putting(self, number: Number, walks: Walk) -> "PathResults":
        """With what these walks have brought; a number past the last one stands for none."""
        new = PathResults(*walks.radiance, walks.met, walks.scatterings, walks.exhausted)
        return jax.tree.map(lambda all_, some: all_.at[number].set(some, mode="drop"), self, new)


class _Crowd(NamedTuple):
    """Walks in their lanes, and their numbers in the queue; how many have begun."""

    walks: Walk
    number: Number
    begun: Int[Array, ""]
    brought: PathResults


def walk_all(
    begin: Callable[[Number], Walk], step: Callable[[Walk], Walk], count: int, lanes: int
) -> PathResults:
    """What all walks of a queue bring.

    - `begin`: the walks of these numbers, from 0 to `count`. Those past the last must not be alive.
    - `step`: the next step of all walks side by side.
    """
    lanes = min(lanes, count)
    fewer = -(-lanes // FEWER)
    none = jnp.full(lanes, count, jnp.int32)
    idle = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(begin, none))
    crowd = _Crowd(idle, none, jnp.zeros((), jnp.int32), PathResults.nothing(count))

    def refilled(crowd: _Crowd) -> _Crowd:
        free = ~crowd.walks.alive
        brought = crowd.brought.putting(jnp.where(free, crowd.number, count), crowd.walks)
        queued = crowd.begun + jnp.cumsum(free, dtype=jnp.int32) - 1
        number = jnp.where(free, jnp.minimum(queued, count), crowd.number)
        walks = jax.tree.map(lambda new, old: jnp.where(free, new, old), begin(number), crowd.walks)
        begun = jnp.minimum(crowd.begun + jnp.sum(free, dtype=jnp.int32), count)
        return _Crowd(walks, number, begun, brought)

    def turn(crowd: _Crowd) -> _Crowd:
        crowd = refilled(crowd)
        return _stepped(step, crowd, jnp.where(crowd.begun < count, int(BUSY * lanes), fewer))

    crowd = jax.lax.while_loop(lambda crowd: crowd.begun < count, turn, crowd)
    crowd = _stepped(step, _together(crowd, fewer, count), jnp.zeros((), jnp.int32))
    return crowd.brought.putting(crowd.number, crowd.walks)


def _stepped(step: Callable[[Walk], Walk], crowd: _Crowd, keep: Int[Array, ""]) -> _Crowd:
    """On until no more than so many walks are alive."""

    def busy(walks: Walk) -> Bool[Array, ""]:
        return jnp.sum(walks.alive, dtype=jnp.int32) > keep

    return crowd._replace(walks=jax.lax.while_loop(busy, step, crowd.walks))


def _together(crowd: _Crowd, lanes: int, count: int) -> _Crowd:
    """Those alive, in so many lanes. What the others have brought is put away."""
    alive = crowd.walks.alive
    brought = crowd.brought.putting(jnp.where(alive, count, crowd.number), crowd.walks)
    place = jnp.nonzero(alive, size=lanes, fill_value=alive.shape[0])[0]
    number = crowd.number.at[place].get(mode="fill", fill_value=count)
    walks = jax.tree.map(lambda leaf: leaf.at[place].get(mode="fill", fill_value=0), crowd.walks)
    return _Crowd(walks, number, crowd.begun, brought)
