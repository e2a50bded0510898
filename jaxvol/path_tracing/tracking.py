"""Where does light meet something on its way? Woodcock tracking, from block to block of a volume.

Within a block, candidates for a collision lie at exponential distances under the block's majorant. A
candidate is one for the caller to decide: real with the probability extinction / majorant, by which a path
is sampled (delta tracking); or else to be passed with what is left, 1 - extinction / majorant, whose
product is an unbiased estimate of the transmittance (ratio tracking). At the border of a block the distance
is drawn anew: an exponential distribution has no memory. Blocks are counted in whole numbers, so that a
flight always arrives, however its coordinates are rounded.

Sources: Woodcock et al. 1965; Novák et al., "Monte Carlo Methods for Volumetric Light Transport
Simulation", 2018; Amanatides and Woo 1987 (from block to block).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._util.vec3 import Scalar, Vec3, along
from ..occupancy import BLOCK
from .majorants import Block, Majorants


CROSSINGS = 2
"""Borders that a flight may cross before the next look into memory: those who arrive earlier wait."""


TINY = 1e-20
"""Grid coordinates per world length that count as none."""


class Flight(eqx.Module):
    """A straight way through the grid.

    - `start`: grid coordinate. `rate`: its change per world length, nowhere 0.
    - `depth`: world length past the start, so far. `end`: that at which the flight is over.
    - `block`: where it is. `entry`: that block's in the table of majorants.
    """

    start: Vec3
    rate: Vec3
    depth: Scalar
    end: Scalar
    block: Block
    entry: Scalar

    @classmethod
    def to(
        cls, majorants: Majorants, start: Vec3, direction: Vec3, spacing: Vec3, distance: Scalar
    ) -> "Flight":
        """From a grid coordinate in a world direction, over this distance, or to the border of the grid."""
        x, y, z = (_not_0(d / step) for d, step in zip(direction, spacing, strict=True))
        end = distance
        for rate, at, last in zip((x, y, z), start, majorants.last, strict=True):
            end = jnp.minimum(end, (jnp.where(rate > 0, last, 0) - at) / rate)
        block = majorants.holding(start)
        return cls(start, (x, y, z), jnp.zeros_like(end), end, block, majorants.at(block))


class Candidate(eqx.Module):
    """Where a flight has come to.

    - `found`: at a candidate for a collision, at the grid coordinate `place`, under this `majorant`.
    - `over`: at its end. Neither of the two: on its way.
    """

    found: Bool[Array, "..."]
    over: Bool[Array, "..."]
    place: Vec3
    majorant: Scalar


def fly(majorants: Majorants, flight: Flight, uniform: Scalar) -> tuple[Flight, Candidate]:
    """On to the next candidate of a flight, to its end, or across CROSSINGS borders of blocks.

    `uniform`: a random number in [0, 1).
    """

    def cross(_: object, state: tuple[Flight, Scalar, Array, Array]) -> tuple[Flight, Scalar, Array, Array]:
        flight, optical, found, over = state
        there, optical, collides, ends = _cross(majorants, flight, optical)
        done = found | over
        there = jax.tree.map(lambda new, old: jnp.where(done, old, new), there, flight)
        return there, optical, found | (~done & collides), over | (~done & ends)

    no = jnp.zeros((), bool)
    start = flight, -jnp.log1p(-uniform), no, no
    flight, _, found, over = jax.lax.fori_loop(0, CROSSINGS, cross, start)
    place = majorants.within(along(flight.start, flight.rate, flight.depth), flight.block)
    return flight, Candidate(found, over, place, flight.entry)


def _cross(majorants: Majorants, flight: Flight, optical: Scalar) -> tuple[Flight, Scalar, Array, Array]:
    """To where a flight has come through this optical depth; or to the border of the box in which the
    majorant holds, a block's, or that of empty space around it. With what is left of the optical depth;
    whether it is spent; and whether the flight is over."""
    majorant, reach = jnp.maximum(flight.entry, 0), jnp.maximum(-flight.entry - 1, 0).astype(jnp.int32)
    axes = list(zip(flight.start, flight.rate, majorants.indices(flight.block), majorants.shape, strict=True))
    walls = [_wall(start, rate, index, reach, count) for start, rate, index, count in axes]
    border = jnp.minimum(jnp.minimum(walls[0], walls[1]), walls[2])
    stop = jnp.minimum(border, flight.end)
    thickness = majorant * jnp.maximum(stop - flight.depth, 0)
    collides, ends = optical < thickness, flight.end <= border
    on = flight.depth + optical / jnp.where(collides, majorant, 1)
    depth = jnp.where(collides, jnp.minimum(on, stop), jnp.maximum(stop, flight.depth))
    behind = majorants.block(
        *(
            _next(start + depth * rate, rate, index, reach, count, wall <= border)
            for (start, rate, index, count), wall in zip(axes, walls, strict=True)
        )
    )
    block = jnp.where(collides | ends, flight.block, behind)
    there = Flight(flight.start, flight.rate, depth, flight.end, block, majorants.at(block))
    return there, optical - thickness, collides, ~collides & ends


def _wall(start: Scalar, rate: Scalar, index: Array, reach: Array, count: int) -> Scalar:
    """The depth at which a flight meets the side of the box around its block, along one axis. The sides of
    the grid are none: there flights end."""
    side = jnp.where(rate > 0, index + reach + 1, index - reach)
    inner = (side > 0) & (side < count)
    return jnp.where(inner, (BLOCK * side.astype(start.dtype) - start) / rate, jnp.inf)


def _next(coordinate: Scalar, rate: Scalar, index: Array, reach: Array, count: int, leaves: Array) -> Array:
    """The index, along one axis, of the block behind the side of the box; or, where another side is nearer,
    of that in which the flight has arrived. It never turns back, so that rounding cannot keep it where it
    is."""
    ahead = rate > 0
    first, last = index - jnp.where(ahead, 0, reach), index + jnp.where(ahead, reach, 0)
    arrived = jnp.floor(coordinate / BLOCK).astype(jnp.int32)
    inside = jnp.clip(arrived, jnp.maximum(first, 0), jnp.minimum(last, count - 1))
    return jnp.where(leaves, jnp.where(ahead, last + 1, first - 1), inside)


def _not_0(rate: Scalar) -> Scalar:
    """The rate, or one too small to matter whose inverse is still a number."""
    return jnp.where(jnp.abs(rate) < TINY, TINY, rate)
