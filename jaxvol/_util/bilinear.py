"""Piecewise bilinear functions on a grid of lines (two equal ones make a step), constant beyond it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..xla.memory import gather
from .piecewise_linear import Range, covering_runs, points_below, run_maxima
from .vec3 import Scalar


def between_lines(lines: Float[Array, " n"], value: Scalar) -> tuple[Int[Array, "..."], Scalar]:
    """Index of the interval that contains a value, and the fraction of it below the value. NaN stays NaN."""
    lines = jax.lax.stop_gradient(lines)
    index = jnp.clip(points_below(lines, value) - 1, 0, lines.shape[0] - 2)
    start, end = gather(lines, index), gather(lines, index + 1)
    gap = end - start
    # a quotient of a smaller and a larger number never exceeds 1, unlike a product with 1 / gap
    fraction = (value - start) / jnp.where(gap > 0, gap, 1)
    return index, jnp.where(value < lines[0], 0, jnp.where(value >= lines[-1], 1, fraction))


def slope_between_lines(lines: Float[Array, " n"], value: Scalar, index: Int[Array, "..."]) -> Scalar:
    """Derivative of the fraction that `between_lines` returns with respect to the value."""
    gap = gather(lines, index + 1) - gather(lines, index)
    inside = (value >= lines[0]) & (value < lines[-1]) & (gap > 0)
    return jnp.where(inside, 1 / jnp.where(gap > 0, gap, 1), 0)


def corner_rows(table: Float[Array, "n m columns"]) -> Float[Array, "cells corners"]:
    """Table with one row per cell of the grid, in row-major order: the entries of its four corners."""
    corners = [table[i : i - 1 or None, j : j - 1 or None] for i in (0, 1) for j in (0, 1)]
    return jnp.concatenate(corners, axis=-1).reshape(-1, 4 * table.shape[2])


def interpolate_corners(row: tuple[Scalar, ...], u: Scalar, v: Scalar) -> tuple[Scalar, ...]:
    """Entries at the fractions (u, v) of a cell: 0 between zeros, and positive between positive numbers."""

    def mix(t: Scalar, a: tuple[Scalar, ...], b: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
        return tuple(p * (1 - t) + q * t for p, q in zip(a, b, strict=True))

    n = len(row) // 4
    first, second = (mix(v, row[at : at + n], row[at + n : at + 2 * n]) for at in (0, 2 * n))
    return mix(u, first, second)


def any_between(marked: Bool[Array, "n m"], rows: Range, columns: Range) -> Bool[Array, "*blocks"]:
    """Test whether any crossing of ranges of rows and columns is marked, by a summed-area table."""
    table = jnp.pad(marked.astype(jnp.int32), ((1, 0), (1, 0)))
    table = jnp.cumsum(jnp.cumsum(table, axis=0, dtype=jnp.int32), axis=1, dtype=jnp.int32)
    flat = table.reshape(-1)

    def below(row: Int[Array, "*blocks"]) -> Int[Array, "*blocks"]:
        """Number of marked crossings of the columns with the rows before `row`."""
        start = row * table.shape[1]
        return gather(flat, start + columns[1] + 1) - gather(flat, start + columns[0])

    return below(rows[1] + 1) > below(rows[0])


def greatest_between(table: Float[Array, "n m"], rows: Range, columns: Range) -> Float[Array, "*blocks"]:
    """Maximum over ranges of rows and columns, by maxima of all rectangles with sides of powers of two."""
    maxima = jnp.stack([jnp.stack(run_maxima(rows_maxima, 1)) for rows_maxima in run_maxima(table, 0)])
    height, tops = covering_runs(rows, maxima.shape[0])
    width, lefts = covering_runs(columns, maxima.shape[1])
    return jnp.max(jnp.stack([maxima[height, width, i, j] for i in tops for j in lefts]), axis=0)
