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

from ..occupancy import BLOCK
from ..triple import Scalar, Triple, along
from .majorants import Block, Majorants


CROSSINGS = 4
"""Borders that a flight may cross before the next look into memory: those who arrive earlier wait."""


class Flight(eqx.Module):
    """A straight way through the grid.

    - `start`: grid coordinate. `rate`: its change per world length.
    - `depth`: world length past the start, so far. `end`: that at which the flight is over; infinite where
      it ends at the border of the grid.
    - `block`: where it is.
    """

    start: Triple
    rate: Triple
    depth: Scalar
    end: Scalar
    block: Block

    @classmethod
    def between(
        cls, majorants: Majorants, start: Triple, direction: Triple, spacing: Triple, end: Scalar
    ) -> "Flight":
        """From a grid coordinate in a world direction."""
        x, y, z = (d / step for d, step in zip(direction, spacing, strict=True))
        return cls(start, (x, y, z), jnp.zeros_like(end), end, majorants.block(start))


class Candidate(eqx.Module):
    """Where a flight has come to.

    - `found`: at a candidate for a collision, at the grid coordinate `place`, under this `majorant`.
    - `over`: at its end. Neither of the two: on its way.
    """

    found: Bool[Array, ""]
    over: Bool[Array, ""]
    place: Triple
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
    return flight, Candidate(found, over, place, majorants.at(flight.block)[0])


def _cross(majorants: Majorants, flight: Flight, optical: Scalar) -> tuple[Flight, Scalar, Array, Array]:
    """To where a flight has come through this optical depth, or to the border of the box in which the
    majorant holds. With what is left of the optical depth; whether it is spent; and whether the flight is
    over."""
    majorant, reach = majorants.at(flight.block)
    walls = [
        _wall(start, rate, block, reach, last)
        for start, rate, block, last in zip(
            flight.start, flight.rate, flight.block, majorants.last, strict=True
        )
    ]
    border = jnp.minimum(jnp.minimum(*walls[:2]), walls[2])
    stop = jnp.minimum(border, flight.end)
    thickness = majorant * jnp.maximum(stop - flight.depth, 0)
    collides = optical < thickness
    on = flight.depth + optical / jnp.where(collides, majorant, 1)
    depth = jnp.where(collides, jnp.minimum(on, stop), jnp.maximum(stop, flight.depth))
    arrived = majorants.block(along(flight.start, flight.rate, depth))
    x, y, z = (
        _next(rate, block, reach, wall <= border, to)
        for rate, block, wall, to in zip(flight.rate, flight.block, walls, arrived, strict=True)
    )
    leaves = _outside((x, y, z), majorants.shape) | (flight.end <= border)
    x, y, z = (
        jnp.where(collides | leaves, old, new) for new, old in zip((x, y, z), flight.block, strict=True)
    )
    there = Flight(flight.start, flight.rate, depth, flight.end, (x, y, z))
    return there, optical - thickness, collides, ~collides & leaves


def _wall(start: Scalar, rate: Scalar, block: Array, reach: Array, last: Scalar) -> Scalar:
    """The depth at which a flight meets the side of the box around its block, along one axis."""
    low = jnp.maximum(BLOCK * (block - reach).astype(start.dtype), 0)
    high = jnp.minimum(BLOCK * (block + reach + 1).astype(start.dtype), last)
    distance = jnp.where(rate > 0, high - start, low - start)
    return jnp.where(rate == 0, jnp.inf, distance / jnp.where(rate == 0, 1, rate))


def _next(rate: Scalar, block: Array, reach: Array, leaves: Array, arrived: Array) -> Array:
    """The block behind the side of the box, along one axis; or, where another side is nearer, the one in
    which the flight has arrived. It never turns back, so that rounding cannot keep it where it is."""
    forward = rate > 0
    behind = jnp.where(forward, block + reach + 1, block - reach - 1)
    inside = jnp.where(
        forward, jnp.clip(arrived, block, block + reach), jnp.clip(arrived, block - reach, block)
    )
    return jnp.where(leaves, behind, inside)


def _outside(block: Block, shape: tuple[int, int, int]) -> Bool[Array, ""]:
    out = jnp.zeros((), bool)
    for b, n in zip(block, shape, strict=True):
        out |= (b < 0) | (b >= n)
    return out
