"""Woodcock tracking of collisions along a flight, block by block of a volume.

Within a block, collision candidates lie at exponentially distributed distances under the block's majorant.
The caller accepts a candidate with probability extinction / majorant, which samples a path (delta tracking);
or passes it with the weight 1 - extinction / majorant, and the product of these weights is an unbiased
estimate of the transmittance (ratio tracking). At the border of a block the distance is drawn again.

Sources: Woodcock et al. 1965; Novák et al., "Monte Carlo Methods for Volumetric Light Transport
Simulation", 2018; Amanatides and Woo 1987 (from block to block).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._util.vec3 import Scalar, Vec3, along
from ..scene.occupancy import BLOCK
from .likelihood import likelihood
from .medium import Block, Majorants


CROSSINGS = 2
"""Block borders that a flight may cross between two fetches of voxels."""

TINY = 1e-20
"""Rates below this (grid coordinates per world length) count as 0."""


class Flight(NamedTuple):
    """A straight segment through the grid.

    Attributes:
        start: grid coordinate.
        rate: change of the grid coordinate per world length; no component is 0.
        depth: world length flown so far.
        end: depth at which the flight ends.
        block: indices of the current block.
        entry: entry of the block in the table of majorants.
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
        """Flight over `distance` or to the grid's border. `direction`: unit, along the grid's axes."""
        x, y, z = (d / step for d, step in zip(direction, spacing, strict=True))
        x, y, z = (jnp.where(jnp.abs(rate) < TINY, TINY, rate) for rate in (x, y, z))
        end = distance
        for rate, at, last in zip((x, y, z), start, majorants.last, strict=True):
            end = jnp.minimum(end, (jnp.where(rate > 0, last, 0) - at) / rate)
        block = majorants.holding(start)
        return cls(start, (x, y, z), jnp.zeros_like(end), end, block, majorants.at(block))


class Candidate(NamedTuple):
    """Point where a flight stopped: a collision candidate (`hit`), its end (`ended`), or one on its way."""

    hit: Bool[Array, "..."]
    ended: Bool[Array, "..."]
    coordinate: Vec3
    majorant: Scalar


class Decision(NamedTuple):
    """Probability and weights of a collision at a candidate.

    Attributes:
        chance: probability with which a collision is drawn, a constant for derivatives.
        collided: weight of a path that collides.
        passed: weight of a path that passes.
        share: true probability of a collision.
    """

    chance: Scalar
    collided: Scalar
    passed: Scalar
    share: Scalar

    @classmethod
    def at(cls, majorants: Majorants, candidate: Candidate, extinction: Scalar) -> "Decision":
        share = extinction / jnp.maximum(candidate.majorant, jnp.finfo(extinction.dtype).tiny)
        if majorants.floor is None:
            return cls(jax.lax.stop_gradient(share), likelihood(share), likelihood(1 - share), share)
        chance = jax.lax.stop_gradient(jnp.maximum(share, majorants.floor / candidate.majorant))
        return cls(chance, share / chance, (1 - share) / (1 - chance), share)


def fly(majorants: Majorants, flight: Flight, uniform: Scalar) -> tuple[Flight, Candidate]:
    """Advance a flight to its next candidate, to its end, or across CROSSINGS block borders."""

    def cross(_: object, state: tuple[Flight, Scalar, Array, Array]) -> tuple[Flight, Scalar, Array, Array]:
        flight, optical, hit, ended = state
        moved, optical, collides, ends = _cross(majorants, flight, optical)
        done = hit | ended
        moved = jax.tree.map(lambda new, old: jnp.where(done, old, new), moved, flight)
        return moved, optical, hit | (~done & collides), ended | (~done & ends)

    no = jnp.zeros((), bool)
    start = flight, -jnp.log1p(-uniform), no, no
    flight, _, hit, ended = jax.lax.fori_loop(0, CROSSINGS, cross, start)
    coordinate = majorants.within(along(flight.start, flight.rate, flight.depth), flight.block)
    return flight, Candidate(hit, ended, coordinate, majorants.majorant(flight.entry))


def _cross(majorants: Majorants, flight: Flight, optical: Scalar) -> tuple[Flight, Scalar, Array, Array]:
    """The flight at its candidate, its end or the next border; the optical depth left; and which of these."""
    majorant, reach = majorants.majorant(flight.entry), jnp.maximum(-flight.entry - 1, 0).astype(jnp.int32)
    axes = list(zip(flight.start, flight.rate, flight.block, majorants.table.shape, strict=True))
    walls = [_wall(start, rate, index, reach, count) for start, rate, index, count in axes]
    border = jnp.minimum(jnp.minimum(walls[0], walls[1]), walls[2])
    stop = jnp.minimum(border, flight.end)
    thickness = majorant * jnp.maximum(stop - flight.depth, 0)
    collides, ends = optical < thickness, flight.end <= border
    collision = flight.depth + optical / jnp.where(collides, majorant, 1)
    depth = jnp.where(collides, jnp.minimum(collision, stop), jnp.maximum(stop, flight.depth))
    x, y, z = (
        jnp.where(
            collides | ends, index, _next(start + depth * rate, rate, index, reach, count, wall <= border)
        )
        for (start, rate, index, count), wall in zip(axes, walls, strict=True)
    )
    moved = flight._replace(depth=depth, block=(x, y, z), entry=majorants.at((x, y, z)))
    return moved, optical - thickness, collides, ~collides & ends


def _wall(start: Scalar, rate: Scalar, index: Array, reach: Array, count: int) -> Scalar:
    """Depth at which a flight reaches the box's side along one axis; infinite for the sides of the grid."""
    side = jnp.where(rate > 0, index + reach + 1, index - reach)
    inner = (side > 0) & (side < count)
    return jnp.where(inner, (BLOCK * side.astype(start.dtype) - start) / rate, jnp.inf)


def _next(coordinate: Scalar, rate: Scalar, index: Array, reach: Array, count: int, leaves: Array) -> Array:
    """Index of the next block along an axis; never back along the flight, so rounding cannot stall it."""
    ahead = rate > 0
    first, last = index - jnp.where(ahead, 0, reach), index + jnp.where(ahead, reach, 0)
    arrived = jnp.floor(coordinate / BLOCK).astype(jnp.int32)
    inside = jnp.clip(arrived, jnp.maximum(first, 0), jnp.minimum(last, count - 1))
    return jnp.where(leaves, jnp.where(ahead, last + 1, first - 1), inside)
