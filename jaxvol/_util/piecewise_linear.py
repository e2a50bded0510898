"""Piecewise linear functions of one variable: tables of a row for each point, look-ups, and bounds."""

from typing import Any, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..xla.memory import gather
from ..xla.platform import gathers_are_fast, on_gpu
from .vec3 import Scalar, Vec3


FEW = 8
"""Most control points among which a row is chosen by comparisons; of more, it is looked up."""

COMPARED = 16
"""Up to so many control points, comparing a value with each costs less than a search."""

ROUNDING = 32 * float(jnp.finfo(jnp.float32).eps)
"""By how much an interpolated extinction may exceed its bound, relative to the greatest of its table."""


def few() -> int:
    """Most points that are compared one by one: `COMPARED` where gathers are fast, else `FEW`."""
    return COMPARED if gathers_are_fast() and not on_gpu() else FEW


Row: TypeAlias = tuple[Scalar, ...]
"""One row of a table."""

Range: TypeAlias = tuple[Any, Any]
"""Indices (blocks) of the first and the last of some control points, inclusive."""


def clip_below(value: Scalar, least: Scalar) -> Scalar:
    """The larger of the two. NaN stays NaN. A comparison takes less time than a maximum."""
    return jnp.where(value < least, least, value)


def not_negative(extinction: Array) -> Array:
    """The extinction, or 0 below 0 (after an optimiser's step), without derivative there. NaN stays NaN."""
    return jnp.where(extinction < 0, 0, extinction)


def points_below(
    values: Float[Array, " n"], value: Float[Array, "*batch"], *, strictly: bool = False
) -> Int[Array, "*batch"]:
    """Number of control points at or below a value, or strictly below it."""
    values, last = jax.lax.stop_gradient(values), values.shape[0] - 1

    def searched(value: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        # While there are few points, comparing with all of them, one fused kernel, is faster.
        how, side = "compare_all" if last < 2 * COMPARED else "scan_unrolled", "left" if strictly else "right"
        return jnp.searchsorted(values, value, side=side, method=how).astype(jnp.int32)

    if last < COMPARED or on_gpu():  # there, a branch costs more
        return searched(value)
    first, step = values[0], (values[-1] - values[0]) / last

    def counted(value: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        """Of evenly spaced points, by a division, which may be off by one."""
        guess = jnp.clip(((value - first) / step).astype(jnp.int32), 0, last - 1)
        reached = [
            value > at if strictly else value >= at
            for at in (gather(values, guess), gather(values, guess + 1))
        ]
        return guess + sum(each.astype(jnp.int32) for each in reached)

    # compare positions rather than gaps: small deviations of gaps would add up
    evenly = first + step * jnp.arange(last + 1, dtype=values.dtype)
    even = jnp.all(jnp.abs(values - evenly) < 0.4 * step)
    return jax.lax.cond(even, counted, searched, value)


def points_around(values: Any, low: Any, high: Any) -> Range:
    """The control points from `low` to `high`, and the next ones around; in NumPy, of NumPy arrays."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    known = isinstance(values, np.ndarray)
    xp, below = np if known else jnp, cast(Any, _points_below if known else points_below)
    first = xp.maximum(below(values, low) - 1, 0)
    # the first point at or above `high`; the second of two points at `high`
    last = xp.maximum(below(values, high, strictly=True), below(values, high) - 1)
    return first, xp.minimum(last, values.shape[0] - 1)


def _points_below(values: np.ndarray, value: np.ndarray, *, strictly: bool = False) -> np.ndarray:
    """As `points_below`, in NumPy."""
    return np.searchsorted(values, value, side="left" if strictly else "right")


def table_row(rows: Float[Array, "points columns"], point: Int[Array, "..."]) -> Row:
    """One row. Each entry is looked up by itself, so that batched entries are whole arrays from the start."""
    point = jnp.clip(point, 0, rows.shape[0] - 1)
    return tuple(gather(rows[:, i], point) for i in range(rows.shape[1]))


def interpolate_row(row: Row, past: Scalar) -> tuple[Vec3, Scalar]:
    """Colour and extinction of a value at the distance `past` beyond the point of this row."""
    r, g, b, extinction = (at + past * slope for at, slope in zip(row[1:5], row[5:9], strict=True))
    # where it falls to 0, rounding may make it negative; NaN stays NaN
    return (r, g, b), jnp.where(extinction < 0, 0, extinction)


def positive_between(values: Any, extinction: Any, low: Any, high: Any) -> Any:
    """Whether the extinction is positive anywhere from `low` to `high`; of NumPy arrays, in NumPy."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    positive, n, xp = extinction > 0, values.shape[0], np if isinstance(values, np.ndarray) else jnp
    if n > COMPARED:  # counting by look-up costs less than comparing with each point
        before = xp.concatenate([xp.zeros(1, np.int32), xp.cumsum(positive, dtype=np.int32)])
        # between two points the extinction is positive wherever it is at one of the two
        first, last = points_around(values, low, high)
        return before[last + 1] > before[first]
    seen = xp.zeros(low.shape, bool)
    for point in range(n):
        # a point's extinction reaches from the point before it to the one behind it
        reached = xp.full(low.shape, positive[point])
        if point > 0:
            reached &= (high > values[point - 1]) | (high >= values[point])
        if point < n - 1:
            reached &= low < values[point + 1]
        seen |= reached
    return seen


def upper_bound_between(
    values: Float[Array, " n"],
    extinction: Float[Array, " n"],
    low: Float[Array, "*blocks"],
    high: Float[Array, "*blocks"],
) -> Float[Array, "*blocks"]:
    """Upper bound of the extinction from `low` to `high`: at the ends or a point between, plus rounding."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    ends = jnp.maximum(jnp.interp(low, values, extinction), jnp.interp(high, values, extinction))
    first, end = points_below(values, low, strictly=True), points_below(values, high)
    inside = _maximum_of_range(extinction, first, end)
    return jnp.maximum(ends, inside) + ROUNDING * extinction.max()


def _maximum_of_range(
    entries: Float[Array, " n"], first: Int[Array, "*batch"], end: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Maximum of the entries from `first` to before `end`; 0 where there are none."""
    table = jnp.stack(run_maxima(entries, 0))
    begin = jnp.minimum(first, entries.shape[0] - 1)
    level, (left, right) = covering_runs((begin, jnp.maximum(end - 1, begin)), len(table))
    return jnp.where(end > first, jnp.maximum(table[level, left], table[level, right]), 0)


def covering_runs(
    entries: Range, levels: int
) -> tuple[Int[Array, "*blocks"], tuple[Int[Array, "*blocks"], Int[Array, "*blocks"]]]:
    """Two runs of 2**k entries that cover these ones: k, and where they begin."""
    first, last = entries
    reached = ((last - first + 1 >= 2**k).astype(jnp.int32) for k in range(1, levels))
    level = sum(reached, jnp.zeros_like(first))
    return level, (first, last + 1 - 2**level)


def run_maxima(table: Float[Array, "..."], axis: int) -> list[Float[Array, "..."]]:
    """The maxima of 1, 2, 4, … entries from each one on along an axis."""
    runs, length, n = [table], 1, table.shape[axis]
    while 2 * length <= n:
        later = jax.lax.slice_in_dim(runs[-1], length, None, axis=axis)
        # the last ones are never asked for
        rest = jax.lax.slice_in_dim(runs[-1], n - length, None, axis=axis)
        runs.append(jnp.maximum(runs[-1], jnp.concatenate([later, rest], axis)))
        length *= 2
    return runs
