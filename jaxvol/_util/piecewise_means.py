"""Means of piecewise linear functions over all values between two: of the extinction, and of the colour,
weighted by it. n control points divide all values into n + 1 spans."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .piecewise_linear import Row, table_row
from .vec3 import Scalar, Vec3


class Span(NamedTuple):
    """One row of `span_rows`: start and end value; colour (r, g, b) and extinction at the start, and their
    slopes; integrals of emission and extinction from the first point on, with what rounding lost."""

    start: Scalar
    end: Scalar
    from_start: Row
    slopes: Row
    to_start: Row
    to_end: Row

    @classmethod
    def of(cls, row: Row) -> "Span":
        return cls(row[0], row[1], row[2:6], row[6:10], row[10:18], row[18:26])

    def at(self, value: Scalar) -> Row:
        """Colour and extinction of a value."""
        past = value - self.start
        return tuple(at + past * slope for at, slope in zip(self.from_start, self.slopes, strict=True))


def span_rows(values: Float[Array, " n"], at_points: Float[Array, "n 4"]) -> Float[Array, "spans 26"]:
    """A table with one row for each span. `at_points`: colour (r, g, b) and extinction at the points."""
    gap = (values[1:] - values[:-1])[:, None]
    rise, middle = at_points[1:] - at_points[:-1], (at_points[1:] + at_points[:-1]) / 2
    slopes = jnp.pad(jnp.where(gap > 0, rise / jnp.where(gap > 0, gap, 1), 0), ((1, 1), (0, 0)))
    whole = gap * jnp.stack(_linear_means(tuple(middle.T), tuple(rise.T)), axis=-1)
    integrals = jnp.pad(_exact_sums(whole), ((1, 0), (0, 0)))
    points = jnp.concatenate([values[:, None], at_points, integrals], axis=1)
    start, end = jnp.concatenate([points[:1], points]), jnp.concatenate([points, points[-1:]])
    return jnp.concatenate(
        [start[:, :1], end[:, :1], start[:, 1:5], slopes, start[:, 5:], end[:, 5:]], axis=1
    )


def _exact_sums(terms: Float[Array, "n 4"]) -> Float[Array, "n 8"]:
    """Cumulative sums, and behind them what is lost when they are rounded."""

    def add(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
        (high, low), (more, rest) = a, b
        total = high + more
        part = total - high
        lost = (high - (total - part)) + (more - part) + low + rest
        whole = total + lost
        return whole, lost - (whole - total)

    fixed = jax.lax.stop_gradient(terms)
    high, low = jax.lax.associative_scan(add, (fixed, jnp.zeros_like(fixed)))
    plain = jnp.cumsum(terms, axis=0)  # it has the derivatives
    return jnp.concatenate([high + (plain - jax.lax.stop_gradient(plain)), low], axis=1)


def span_index(rows: Float[Array, "spans 26"], value: Array) -> Int[Array, "..."]:
    """The span in which a value lies, by comparison with all."""
    index = jnp.zeros(jnp.shape(value), jnp.int32)
    for start in rows[1:, 0]:
        index = index + (value >= start).astype(jnp.int32)
    return index


def mean_by_rows(
    a: Row, b: Row, front: Scalar, back: Scalar, same: Bool[Array, "..."]
) -> tuple[Vec3, Scalar]:
    """Mean colour and extinction between two values in the spans of rows `a` and `b`, maybe the `same`;
    rounded by some 1e-7 of the greatest extinction between the two, times the number of spans."""
    here, there = Span.of(a), Span.of(b)
    at_front, at_back = here.at(front), there.at(back)
    rise = tuple(v - u for u, v in zip(at_front, at_back, strict=True))
    middle = tuple((u + v) / 2 for u, v in zip(at_front, at_back, strict=True))
    # where they lie apart: to the end of the one span, over whole ones, and from the start of the other
    up = back > front
    first = jnp.where(up, here.end, here.start) - front
    last = back - jnp.where(up, there.start, there.end)
    before, behind = (tuple(slope * d for slope in span.slopes) for span, d in ((here, first), (there, last)))
    head = _linear_means(tuple(u + d / 2 for u, d in zip(at_front, before, strict=True)), before)
    tail = _linear_means(tuple(v - d / 2 for v, d in zip(at_back, behind, strict=True)), behind)
    sums = [
        jnp.where(up, to_start - to_end, to_end_there - to_start_here)
        for to_start, to_end, to_end_there, to_start_here in zip(
            there.to_start, here.to_end, there.to_end, here.to_start, strict=True
        )
    ]
    between = (high + low for high, low in zip(sums[:4], sums[4:], strict=True))
    whole = jnp.where(same, 1, back - front)
    # weights of neighbouring spans sum to 1 whatever is rounded: see `mean_by_spans`
    part, rest = first / whole, last / whole
    rest = jnp.where(jnp.where(up, there.start == here.end, there.end == here.start), 1 - part, rest)
    apart = (part * u + over / whole + rest * v for u, over, v in zip(head, between, tail, strict=True))
    means = (jnp.where(same, u, v) for u, v in zip(_linear_means(middle, rise), apart, strict=True))
    return _classified(tuple(means), middle)


@jax.custom_jvp
def mean_by_spans(rows: Float[Array, "spans 26"], front: Scalar, back: Scalar) -> tuple[Vec3, Scalar]:
    """The same by a sum over all spans, faster for few; derivatives are those of `mean_by_rows`."""
    spans = [Span.of(tuple(row)) for row in rows]
    up = back > front
    low, high = jnp.where(up, front, back), jnp.where(up, back, front)
    rise = high - low
    inverse = 1 / jnp.where(rise > 0, rise, 1)
    # How far from one value to the other each span begins. The weights sum to 1 whatever is rounded: XLA may
    # compute a value twice, rounded differently, so that no sum may be divided by a difference.
    begins = [
        jnp.where(span.start <= low, 0, jnp.where(span.start >= high, 1, (span.start - low) * inverse))
        for span in spans[1:]
    ]
    begins = [jnp.zeros_like(front), *begins, jnp.ones_like(front)]
    sums: list[Scalar] = [jnp.zeros_like(front)] * 7
    for span, begin, end in zip(spans, begins, begins[1:], strict=False):
        width = end - begin
        *colors, extinction = span.at(low + (begin + end) / 2 * rise)
        means = _linear_means((*colors, extinction), tuple(slope * (width * rise) for slope in span.slopes))
        sums = [total + width * part for total, part in zip(sums, (*means, *colors), strict=True)]
    return _classified(tuple(sums[:4]), tuple(sums[4:]))


@mean_by_spans.defjvp
def _(primals: tuple[Array, Scalar, Scalar], tangents: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    rows, *ends = primals
    i, j = (span_index(rows, end) for end in ends)

    def mean(rows: Array, front: Scalar, back: Scalar) -> tuple[Vec3, Scalar]:
        return mean_by_rows(table_row(rows, i), table_row(rows, j), front, back, i == j)

    return mean_by_spans(*primals), jax.jvp(mean, primals, tangents)[1]


def _linear_means(middle: Sequence[Array], rise: Sequence[Array]) -> tuple[Array, ...]:
    """Mean emission and extinction of linear colour and extinction, by their middle and rise."""
    *colors, extinction = middle
    *of_colors, of_extinction = rise
    emission = (extinction * c + of_extinction * d / 12 for c, d in zip(colors, of_colors, strict=True))
    return (*emission, extinction)


def _classified(means: Row, plain: Row) -> tuple[Vec3, Scalar]:
    """Colour and extinction of these means; where that is 0, a plain mean of the colours."""
    *emission, extinction = means
    # where it is 0, rounding may make it negative; NaN stays NaN
    extinction = jnp.where(extinction < 0, 0, extinction)
    emits = extinction > float(jnp.finfo(extinction.dtype).tiny)
    r, g, b = (
        jnp.where(emits, part / jnp.where(emits, extinction, 1), color)
        for part, color in zip(emission, plain, strict=False)
    )
    return (r, g, b), extinction
