"""Cells of each ray in a brick: those that begin there before any jitter.

A straight ray meets a brick once. A curved one may come back: bricks are visited in turn, and a ray continues
while it is in the current brick or an earlier one, whose cells are read with it (the overlap of Kim, Kwon and
Shin 2008).
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Vec3
from ..engine.rays import vmap_rays
from ..engine.wavefront import CellRange
from ..march.march import March
from ..ray import Progress
from ..scene.space import Ray, Straight, slab_interval
from .grid import SLACK, BrickGrid


CHUNK = 8  # cells of a ray that are tested at a time

Visit: TypeAlias = tuple[Int[Array, ""], Bool[Array, " bricks"], Bool[Array, " bricks"]]
"""A brick; mask of the bricks through which rays continue from it, itself included; mask of empty bricks."""

CurvedRays: TypeAlias = tuple[Ray, Progress, Int[Array, "*rays"]]
"""Rays; their progress at the entry, with the current `finished`; the cell up to which bricks are known."""


class BrickCells(NamedTuple):
    """Cells of rays in a brick; the cell of each ray up to which bricks are then known; a box of grid
    coordinates that holds all points of these cells; and whether there are any."""

    cells: CellRange
    reached: Int[Array, "*rays"]
    low: Float[Array, "3"]
    high: Float[Array, "3"]
    any: Bool[Array, ""]


@jax.jit
def padded(cells: CellRange) -> CellRange:
    """The cells, and their neighbours whose samples may be shifted into them."""
    nonempty = cells.until > cells.first
    first, until = jnp.maximum(cells.first - SLACK, 0), cells.until + SLACK
    return CellRange(jnp.where(nonempty, first, 0), jnp.where(nonempty, until, 0))


def straight_cells(
    grid: BrickGrid, march: March, rays: Ray, alive: Bool[Array, "*rays"], brick: Int[Array, ""]
) -> CellRange:
    """The cells of `alive` straight rays in a brick, and the neighbours whose samples may shift into it."""
    near, far, hit = _within(grid, march, rays, brick)
    first, until = jnp.ceil(near).astype(jnp.int32) - SLACK, jnp.floor(far).astype(jnp.int32) + 1 + SLACK
    hit &= alive
    return CellRange(jnp.where(hit, jnp.maximum(first, 0), 0), jnp.where(hit, until, 0))


def first_behind(
    grid: BrickGrid, march: March, rays: Ray, order: Int[Array, " bricks"], number: Int[Array, ""]
) -> Int[Array, "*rays"]:
    """First cell of straight rays behind the first `number` bricks of a front-to-back order."""

    def more(i: Int[Array, ""], index: Int[Array, "*rays"]) -> Int[Array, "*rays"]:
        _, far, hit = _within(grid, march, rays, order[i])
        return jnp.maximum(index, jnp.where(hit, jnp.ceil(far).astype(jnp.int32), 0))

    return jax.lax.fori_loop(0, number, more, jnp.zeros(rays.length.shape, jnp.int32))


def _within(
    grid: BrickGrid, march: March, rays: Ray, brick: Int[Array, ""]
) -> tuple[Float[Array, "*rays"], Float[Array, "*rays"], Bool[Array, "*rays"]]:
    """Entry and exit of straight rays in a brick, in steps past the ray's entry, and which rays meet it."""
    path = rays.path
    assert isinstance(path, Straight)
    index = jnp.unravel_index(brick, grid.counts)
    low, high = [], []
    for i, size, count in zip(index, grid.size, grid.counts, strict=True):
        # what lies outside of the grid belongs to the bricks at its faces
        low.append(jnp.where(i == 0, -jnp.inf, (i * size).astype(rays.length.dtype)))
        high.append(jnp.where(i == count - 1, jnp.inf, ((i + 1) * size).astype(rays.length.dtype)))
    near, far = slab_interval(path.start, path.rate, (low[0], low[1], low[2]), (high[0], high[1], high[2]))
    hit = (near <= far) & (far >= 0) & (near < rays.length)
    # clipped before it becomes an integer, whose range it may exceed; no march has 2**30 cells
    last = jnp.minimum(rays.length / march.step + 1, 2.0**30)
    return jnp.clip(near / march.step, 0, last), jnp.clip(far / march.step, 0, last), hit


def curved_cells(grid: BrickGrid, march: March, curved: CurvedRays, visit: Visit, beyond: int) -> BrickCells:
    """The cells of curved rays, of shape (groups, rays in a group), by a search along each ray. The box also
    holds `beyond` steps before and behind them."""
    rays, at, reached = curved
    brick, passable, empty = visit
    # Samples lie at multiples of a step past the entry, or half-way between two, and later ones may be
    # shifted. All of these points count, since a ray may be in a brick for less than a step.
    track = at.track
    fronts = [track.offset] if track.shift is None else [track.offset, track.offset + track.shift]
    offsets = fronts if march.quadrature == "left" else [o + half for o in fronts for half in (0, 0.5)]
    # A ray may also come back into the volume and leave it again between two of these points.
    returns = [(back, _located(rays, back)) for _, back in rays.gaps]
    returns = jax.tree.map(lambda leaf: leaf[None, None], returns)
    number = jnp.arange(CHUNK, dtype=jnp.int32)[:, None, None]

    def depths(index: Int[Array, "cells *rays"]) -> Float[Array, "points cells *rays"]:
        return jnp.stack([(offset[None] + index.astype(offset.dtype)) * march.step for offset in offsets])

    def points(index: Int[Array, "cells *rays"]) -> tuple[Vec3, Bool[Array, "points cells *rays"]]:
        depth, end = depths(index), depths(index + 1)
        samples = jax.vmap(jax.vmap(_located, in_axes=(None, 0)), in_axes=(None, 0))(rays, depth)
        parts = [samples]
        for back, located in returns:
            within = (depth <= back) & (back < end)
            parts += [jax.tree.map(lambda a, b, within=within: jnp.where(within, a, b), located, samples)]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)

    def bricks(index: Int[Array, "cells *rays"]) -> Int[Array, "points cells *rays"]:
        coordinate, inside = points(index)
        return jnp.where(inside, grid.brick_of(coordinate), grid.number)

    def ahead(index: Int[Array, "cells *rays"]) -> Bool[Array, "cells *rays"]:
        front = index.astype(rays.length.dtype) * march.step
        return (front < (rays.length + march.step)[None]) & (index < march.most_samples)

    def while_in(allowed: Bool[Array, " bricks"], index: Array, active: Array) -> tuple[Array, Array]:
        """First cell of each ray outside of the allowed bricks, and the end of its last non-empty cell."""

        def more(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            index, last, active = state
            at = bricks(index[None] + number)
            stays = jnp.all(allowed[at], axis=0) & ahead(index[None] + number)
            passed = jnp.cumprod(stays.astype(jnp.int32), axis=0) > 0
            occupied = passed & jnp.any(~empty[at], axis=0) & active[None]
            last = jnp.maximum(last, jnp.max(jnp.where(occupied, index[None] + number + 1, 0), axis=0))
            steps = jnp.sum(passed, axis=0, dtype=index.dtype)
            return index + jnp.where(active, steps, 0), last, active & (steps == CHUNK)

        start = index, jnp.zeros_like(index), active
        index, last, _ = jax.lax.while_loop(lambda state: jnp.any(state[2]), more, start)
        return index, last

    first, _ = while_in(empty, reached, ~at.finished)
    in_brick = jnp.any(bricks(first[None])[:, 0] == brick, axis=0)
    # a cell whose points lie in several bricks belongs to the first brick that is visited
    enters = ~at.finished & in_brick & ahead(first[None])[0]
    _, until = while_in(passable, first + 1, enters)
    until = jnp.maximum(until, first + 1)

    def widen(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        start, low, high = state
        index = start[None] + number
        coordinate, inside = points(index)
        counts = inside & (enters[None] & (index <= (until + beyond)[None]) & (index >= 0))[None]
        point, axes = jnp.stack(coordinate), tuple(range(1, counts.ndim + 1))
        low = jnp.minimum(low, jnp.min(jnp.where(counts[None], point, jnp.inf), axis=axes))
        high = jnp.maximum(high, jnp.max(jnp.where(counts[None], point, -jnp.inf), axis=axes))
        return start + CHUNK, low, high

    infinite = jnp.full(3, jnp.inf, rays.length.dtype)
    _, low, high = jax.lax.while_loop(
        lambda state: jnp.any(enters & (state[0] <= until + beyond)),
        widen,
        (first - beyond, infinite, -infinite),
    )
    cells = CellRange(jnp.where(enters, first, 0), jnp.where(enters, until, 0))
    return BrickCells(cells, jnp.where(enters, until, first), low, high, jnp.any(enters))


def _located(rays: Ray, depth: Float[Array, "*rays"]) -> tuple[Vec3, Bool[Array, "*rays"]]:
    """Grid coordinates of points on rays, and whether the points lie in the volume."""
    return vmap_rays(lambda ray, s: (ray.path(s), ray.contains(s)))(rays, depth)
