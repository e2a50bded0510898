"""Piecewise linear functions of one variable: tables with one row per point, look-ups, and bounds."""

from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..xla.memory import gather
from ..xla.platform import gathers_are_fast, on_gpu
from .vec3 import Scalar, Vec3


FEW = 8
"""Maximum number of control points for which a row is chosen by comparisons rather than by a look-up."""

COMPARED = 16
"""Number of control points up to which comparing a value with all of them costs less than a search."""

ROUNDING = 32 * float(jnp.finfo(jnp.float32).eps)
"""Amount by which an interpolated extinction may exceed its bound, relative to the table's maximum."""


def few() -> int:
    """Maximum number of points that are compared one by one: `COMPARED` if gathers are fast, else `FEW`."""
    return COMPARED if gathers_are_fast() and not on_gpu() else FEW


AnyArray: TypeAlias = Array | np.ndarray  # results are of the same library

Row: TypeAlias = tuple[Scalar, ...]
"""One row of a table."""

Range: TypeAlias = tuple[Any, Any]
"""Indices (blocks) of the first and the last control point of a range, inclusive."""


def clip_below(value: Scalar, minimum: Scalar) -> Scalar:
    """Maximum of a value and `minimum`; NaN stays NaN. A comparison takes less time than `jnp.maximum`."""
    return jnp.where(value < minimum, minimum, value)


def not_negative(extinction: Array) -> Array:
    """Extinction clipped at 0 (after an optimiser's step), with derivative 0 below 0. NaN stays NaN."""
    return jnp.where(extinction < 0, 0, extinction)


def points_below(
    values: Float[Array, " n"], value: Float[Array, "*batch"], *, strictly: bool = False
) -> Int[Array, "*batch"]:
    """Number of control points at or below a value, or strictly below it."""
    values, last = jax.lax.stop_gradient(values), values.shape[0] - 1

    def search(value: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        # one fused kernel that compares with all points is faster while they are few
        method = "compare_all" if last < 2 * COMPARED else "scan_unrolled"
        side = "left" if strictly else "right"
        return jnp.searchsorted(values, value, side=side, method=method).astype(jnp.int32)

    if last < COMPARED or on_gpu():  # on a GPU, a branch costs more
        return search(value)
    first, step = values[0], (values[-1] - values[0]) / last

    def divide(value: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        """Number of evenly spaced points, by a division that may be off by one."""
        guess = jnp.clip(((value - first) / step).astype(jnp.int32), 0, last - 1)
        points = gather(values, guess), gather(values, guess + 1)
        reached = (value > point if strictly else value >= point for point in points)
        return guess + sum(is_reached.astype(jnp.int32) for is_reached in reached)

    # compare positions rather than gaps: small deviations of gaps would add up
    even_values = first + step * jnp.arange(last + 1, dtype=values.dtype)
    is_even = jnp.all(jnp.abs(values - even_values) < 0.4 * step)
    return jax.lax.cond(is_even, divide, search, value)


def points_around(values: AnyArray, low: AnyArray, high: AnyArray) -> Range:
    """Control points from `low` to `high` and one more on either side; NumPy arrays stay in NumPy."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    xp: Any = np if isinstance(values, np.ndarray) else jnp

    def below(value: Any, strictly: bool = False) -> Any:
        if isinstance(values, np.ndarray):
            return np.searchsorted(values, value, side="left" if strictly else "right")
        return points_below(values, value, strictly=strictly)

    first = xp.maximum(below(low) - 1, 0)
    # the first point at or above `high`; the second of two points at `high`
    last = xp.maximum(below(high, strictly=True), below(high) - 1)
    return first, xp.minimum(last, values.shape[0] - 1)


def table_row(rows: Float[Array, "points columns"], point: Int[Array, "..."]) -> Row:
    """One row of a table. Columns are gathered one by one, so that batched entries are contiguous arrays."""
    point = jnp.clip(point, 0, rows.shape[0] - 1)
    return tuple(gather(rows[:, i], point) for i in range(rows.shape[1]))


def interpolate_row(row: Row, past: Scalar) -> tuple[Vec3, Scalar]:
    """Colour and extinction of a value at the distance `past` beyond the point of this row."""
    r, g, b, extinction = (start + past * slope for start, slope in zip(row[1:5], row[5:9], strict=True))
    return (r, g, b), not_negative(extinction)


def positive_between(values: AnyArray, extinction: AnyArray, low: AnyArray, high: AnyArray) -> Any:
    """Test whether the extinction is positive anywhere from `low` to `high`; NumPy arrays stay in NumPy."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    positive, n = extinction > 0, values.shape[0]
    if n > COMPARED:  # counting by look-up costs less than comparing with each point
        before = xp.concatenate([xp.zeros(1, np.int32), xp.cumsum(positive, dtype=np.int32)])
        # between two points the extinction is positive wherever it is at one of the two
        first, last = points_around(values, low, high)
        return before[last + 1] > before[first]
    result = xp.zeros(low.shape, bool)
    for point in range(n):
        # a point's extinction reaches from the point before it to the one behind it
        reached = xp.full(low.shape, positive[point])
        if point > 0:
            reached &= (high > values[point - 1]) | (high >= values[point])
        if point < n - 1:
            reached &= low < values[point + 1]
        result |= reached
    return result


def upper_bound_between(
    values: Float[Array, " n"],
    extinction: Float[Array, " n"],
    low: Float[Array, "*blocks"],
    high: Float[Array, "*blocks"],
) -> Float[Array, "*blocks"]:
    """Upper bound of the extinction from `low` to `high`: its maximum there, plus rounding."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    ends = jnp.maximum(jnp.interp(low, values, extinction), jnp.interp(high, values, extinction))
    first, end = points_below(values, low, strictly=True), points_below(values, high)
    table = jnp.stack(run_maxima(extinction, 0))
    begin = jnp.minimum(first, extinction.shape[0] - 1)
    level, (head, tail) = covering_runs((begin, jnp.maximum(end - 1, begin)), len(table))
    inside = jnp.where(end > first, jnp.maximum(table[level, head], table[level, tail]), 0)
    return jnp.maximum(ends, inside) + ROUNDING * extinction.max()


def covering_runs(entries: Range, levels: int) -> tuple[Int[Array, "*blocks"], Range]:
    """Two runs of 2**k entries that cover a range of entries: k, and the first entry of both runs."""
    first, last = entries
    reached = ((last - first + 1 >= 2**k).astype(jnp.int32) for k in range(1, levels))
    level = sum(reached, jnp.zeros_like(first))
    return level, (first, last + 1 - 2**level)


def run_maxima(table: Float[Array, "..."], axis: int) -> list[Float[Array, "..."]]:
    """Maxima of runs of 1, 2, 4, … entries along an axis, by the first entry of the run."""
    runs, length, n = [table], 1, table.shape[axis]
    while 2 * length <= n:
        later = jax.lax.slice_in_dim(runs[-1], length, None, axis=axis)
        # padding: runs that would end beyond the last entry are never looked up
        tail = jax.lax.slice_in_dim(runs[-1], n - length, None, axis=axis)
        runs.append(jnp.maximum(runs[-1], jnp.concatenate([later, tail], axis)))
        length *= 2
    return runs
