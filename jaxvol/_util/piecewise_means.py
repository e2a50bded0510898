"""Means of piecewise linear functions over an interval: extinction, and colour weighted by extinction.
n control points divide the values into n + 1 spans."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .piecewise_linear import Row, not_negative, table_row
from .vec3 import Scalar, Vec3


class Span(NamedTuple):
    """One row of `span_rows`: start and end value; colour (r, g, b) and extinction at the start, and their
    slopes; integrals of emission and extinction from the first point on, and their rounding errors."""

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
        return tuple(start + past * slope for start, slope in zip(self.from_start, self.slopes, strict=True))


def span_rows(values: Float[Array, " n"], at_points: Float[Array, "n 4"]) -> Float[Array, "spans 26"]:
    """Table with one row per span. `at_points`: colour (r, g, b) and extinction at the control points."""
    gap = (values[1:] - values[:-1])[:, None]
    rise, middle = at_points[1:] - at_points[:-1], (at_points[1:] + at_points[:-1]) / 2
    slopes = jnp.pad(jnp.where(gap > 0, rise / jnp.where(gap > 0, gap, 1), 0), ((1, 1), (0, 0)))
    span_integrals = gap * jnp.stack(_linear_means(tuple(middle.T), tuple(rise.T)), axis=-1)
    integrals = jnp.pad(_exact_sums(span_integrals), ((1, 0), (0, 0)))
    points = jnp.concatenate([values[:, None], at_points, integrals], axis=1)
    start, end = jnp.concatenate([points[:1], points]), jnp.concatenate([points, points[-1:]])
    return jnp.concatenate(
        [start[:, :1], end[:, :1], start[:, 1:5], slopes, start[:, 5:], end[:, 5:]], axis=1
    )


def _exact_sums(terms: Float[Array, "n 4"]) -> Float[Array, "n 8"]:
    """Cumulative sums, followed by their rounding errors."""

    def add(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
        (high, low), (added_high, added_low) = a, b
        total = high + added_high
        part = total - high
        lost = (high - (total - part)) + (added_high - part) + low + added_low
        rounded = total + lost
        return rounded, lost - (rounded - total)

    fixed = jax.lax.stop_gradient(terms)
    high, low = jax.lax.associative_scan(add, (fixed, jnp.zeros_like(fixed)))
    plain = jnp.cumsum(terms, axis=0)  # it has the derivatives
    return jnp.concatenate([high + (plain - jax.lax.stop_gradient(plain)), low], axis=1)


def span_index(rows: Float[Array, "spans 26"], value: Array) -> Int[Array, "..."]:
    """Index of the span that contains a value, by comparison with all spans."""
    index = jnp.zeros(jnp.shape(value), jnp.int32)
    for start in rows[1:, 0]:
        index = index + (value >= start).astype(jnp.int32)
    return index


def mean_by_rows(
    a: Row, b: Row, front: Scalar, back: Scalar, same: Bool[Array, "..."]
) -> tuple[Vec3, Scalar]:
    """Mean colour and extinction from `front`, in the span of row `a`, to `back`, in that of `b` (`same`: in
    one span). Rounding error: 1e-7 of the maximum extinction between them, times the number of spans."""
    span_a, span_b = Span.of(a), Span.of(b)
    at_front, at_back = span_a.at(front), span_b.at(back)
    rise = tuple(v - u for u, v in zip(at_front, at_back, strict=True))
    middle = tuple((u + v) / 2 for u, v in zip(at_front, at_back, strict=True))
    # two spans: from `front` to the end of a's, over those between, from the start of b's to `back`
    up = back > front
    width_a = jnp.where(up, span_a.end, span_a.start) - front
    width_b = back - jnp.where(up, span_b.start, span_b.end)
    rise_a, rise_b = tuple(s * width_a for s in span_a.slopes), tuple(s * width_b for s in span_b.slopes)
    head = _linear_means(tuple(u + d / 2 for u, d in zip(at_front, rise_a, strict=True)), rise_a)
    tail = _linear_means(tuple(v - d / 2 for v, d in zip(at_back, rise_b, strict=True)), rise_b)
    ends = span_a.to_start, span_a.to_end, span_b.to_start, span_b.to_end
    sums = [
        jnp.where(up, start_b - end_a, end_b - start_a)
        for start_a, end_a, start_b, end_b in zip(*ends, strict=True)
    ]
    between = (high + low for high, low in zip(sums[:4], sums[4:], strict=True))
    total = jnp.where(same, 1, back - front)
    # weights of neighbouring spans sum to 1 whatever is rounded: see `mean_by_spans`
    share_a, share_b = width_a / total, width_b / total
    are_neighbours = jnp.where(up, span_b.start == span_a.end, span_b.end == span_a.start)
    share_b = jnp.where(are_neighbours, 1 - share_a, share_b)
    mixed = (share_a * u + over / total + share_b * v for u, over, v in zip(head, between, tail, strict=True))
    means = (jnp.where(same, u, v) for u, v in zip(_linear_means(middle, rise), mixed, strict=True))
    return _classified(tuple(means), middle)


@jax.custom_jvp
def mean_by_spans(rows: Float[Array, "spans 26"], front: Scalar, back: Scalar) -> tuple[Vec3, Scalar]:
    """Mean colour and extinction by a sum over all spans, faster for few; derivatives: `mean_by_rows`."""
    spans = [Span.of(tuple(row)) for row in rows]
    up = back > front
    low, high = jnp.where(up, front, back), jnp.where(up, back, front)
    rise = high - low
    inverse = 1 / jnp.where(rise > 0, rise, 1)
    # Starts of spans as fractions of the way from `low` to `high`. Weights sum to 1 whatever is rounded: XLA
    # may compute a value twice, rounded differently, so that no sum may be divided by a difference.
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
    """Mean emission and extinction of linear colour and extinction, from their mid values and rises."""
    *colors, extinction = middle
    *color_rises, extinction_rise = rise
    emission = (extinction * c + extinction_rise * d / 12 for c, d in zip(colors, color_rises, strict=True))
    return (*emission, extinction)


def _classified(means: Row, plain: Row) -> tuple[Vec3, Scalar]:
    """Colour and extinction from mean emission and extinction; the `plain` mean colour at extinction 0."""
    *emission, extinction = means
    extinction = not_negative(extinction)
    emits = extinction > float(jnp.finfo(extinction.dtype).tiny)
    r, g, b = (
        jnp.where(emits, part / jnp.where(emits, extinction, 1), color)
        for part, color in zip(emission, plain, strict=False)
    )
    return (r, g, b), extinction
