"""Which colour and extinction has this value?"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._util.checks import Arrayable, finite_array, number, require, unit_interval
from ._util.vec3 import Scalar, Vec3
from .occupancy import Blocks
from .volume import Volume


FEW = 16
"""Up to so many control points, a sample's interval is chosen by comparing with each of them, which costs
less than looking its entries up."""

Row: TypeAlias = tuple[Scalar, ...]
"""What a sample between two control points needs: see `TransferFunction.rows`."""

Measured: TypeAlias = tuple[Array, ...]
"""What a transfer function wants to know of a place: the value, and whatever else it goes by."""

Classify: TypeAlias = Callable[[Measured], tuple[Vec3, Scalar]]
"""From what was measured to colour (r, g, b) and extinction (1/length)."""


class Classification(NamedTuple):
    """What a transfer function makes of the places of one volume: measured first, then classified.

    The two are apart for engines to stand between them: what is measured is fetched from memory, and used
    many times over.
    """

    measure: Callable[[Vec3], Measured]
    classify: Classify
    search: Callable[[Measured], Measured] | None = None
    """What is worth finding once, for all that `classify` makes of it. It comes after what was measured."""
    light: Callable[[Any], Vec3] | None = None
    """From a sample (`lighting.seam.Sample`) to its colour as lit. None where colours are as classified."""

    def searched(self, measured: Measured) -> Measured:
        """What was measured, and after it what is found of that."""
        return measured if self.search is None else (*measured, *self.search(measured))


class Transfer(eqx.Module):
    """What a renderer asks of a transfer function, of whatever kind."""

    def measured(self, volume: Volume, coordinate: Vec3) -> Measured:
        """What is read from the volume at a grid coordinate, of which the value comes first: by default, it
        alone."""
        return (volume.value(coordinate),)

    @abstractmethod
    def classifier(self) -> Classify:
        """From what was measured to colour and extinction. What does not depend on it is computed here, once,
        outside the march's loop."""

    def search(self) -> Callable[[Measured], Measured] | None:
        """What the classifier wants to be found of what was measured, and given after it: nothing."""
        return None

    def over(self, volume: Volume) -> Classification:
        """Measuring and classifying the grid coordinates of this volume."""
        return Classification(
            lambda coordinate: self.measured(volume, coordinate), self.classifier(), self.search()
        )

    def pull(self, measured: Measured, color: Vec3, extinction: Scalar) -> tuple["Transfer", Measured]:
        """The transposed derivative of classifying many samples, arrays of any one shape: what the transfer
        function, and what was measured, get of these cotangents of colour and extinction. None where there
        is no derivative. `measured` ends in what `search` has found."""

        def classified(given: tuple[Transfer, Measured]) -> tuple[Vec3, Scalar]:
            transfer, measured = given
            classify = transfer.classifier()
            for _ in range(extinction.ndim):
                classify = jax.vmap(classify)
            return classify(measured)

        _, pull = eqx.filter_vjp(classified, (self, measured))
        return pull((color, extinction))[0]

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """In which blocks of a volume anything may be seen: False is a proof that the extinction is 0
        wherever the value lies in the block's range. It carries no gradient. By default nothing is proven."""
        return jnp.ones(blocks.low.shape, bool)


class TransferFunction(Transfer):
    """Colour and extinction, piecewise linear in the volume's value and constant beyond the ends.

    **Arguments:**

    - `values`: (n,) increasing control points, in value units; n ≥ 2. Two of them may be equal, and make a
      step: what lies below takes the first one's colour and extinction, what lies there or above the
      second's. They carry no gradient.
    - `colors`: (n, 3) linear RGB at the points. Not premultiplied; usually in [0, 1].
    - `extinction`: (n,) at the points, in 1/length, ≥ 0. A cell of width w has opacity
      `1 - exp(-extinction w)`.

    Extinction is what is interpolated. VTK interpolates opacity; the two agree at the points, and
    differ between points where the opacity of a unit distance is high.

    Put a step between values of the data rather than at one: interpolation may round a value to either side.

    **Raises:** `ValueError` for fewer than two points, points that do not increase or of which three are
    equal, negative extinction, NaN or infinity, or lengths that differ.
    """

    values: Float[Array, " n"]
    colors: Float[Array, "n 3"]
    extinction: Float[Array, " n"]

    def __init__(self, values: Arrayable, colors: Arrayable, extinction: Arrayable):
        values = finite_array("values", values, (None,))
        n = values.shape[0]
        if n < 2:
            raise ValueError(f"values must hold at least 2 control points; got {n}.")
        self.values = require(
            values,
            lambda v: (v[1:] >= v[:-1]).all() & (v[2:] > v[:-2]).all(),
            "values must increase from point to point, but for two equal ones that make a step; got {got}. "
            "Sort them, and let no three be equal.",
        )
        self.colors = finite_array("colors", colors, (n, 3))
        extinction = finite_array("extinction", extinction, (n,))
        self.extinction = require(extinction, lambda e: e >= 0, "extinction must not be negative; got {got}.")

    @classmethod
    def from_points(
        cls,
        points: Sequence[tuple[float, Sequence[float], float]] | Any,
        unit_distance: Arrayable = 1.0,
    ) -> "TransferFunction":
        """From control points `(value, (r, g, b), opacity)`, as one draws them in a viewer.

        **Arguments:**

        - `points`: in increasing order of value; two of one value make a step. `opacity` in [0, 1] is that
          of a layer of thickness `unit_distance`, and becomes the extinction
          `-ln(1 - opacity) / unit_distance` exactly.
          An opacity of 1, whose extinction would be infinite, is taken as 1 - 2⁻²⁴.
        - `unit_distance`: world length. VTK's `ScalarOpacityUnitDistance`.

        **Raises:** `ValueError` as the class does, and for an opacity outside [0, 1].
        """
        try:
            values, colors, opacities = zip(*points, strict=True)
        except (TypeError, ValueError) as fault:
            raise ValueError(
                f"points must be triples (value, (r, g, b), opacity); got {points!r}."
            ) from fault
        return cls(values, colors, extinction_of(opacities, unit_distance))

    def __call__(self, value: Scalar) -> tuple[Vec3, Scalar]:
        """Colour (r, g, b) and extinction of a value."""
        search, measured = self.search(), (value,)
        return self.classifier()(measured if search is None else (*measured, *search(measured)))

    def opacity(self, unit_distance: float = 1.0) -> Float[Array, " n"]:
        """Opacity at the control points of a layer of thickness `unit_distance`."""
        return -jnp.expm1(-self.extinction * number("unit_distance", unit_distance, above=0))

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Which blocks of a volume hold a value of which something is seen."""
        values, extinction = jax.lax.stop_gradient((self.values, self.extinction))
        return seen_between(values, extinction, blocks.low, blocks.high)

    def search(self) -> Callable[[Measured], Measured] | None:
        values, last = jax.lax.stop_gradient(self.values), self.values.shape[0] - 1
        if last < FEW:
            return None

        def search(measured: Measured) -> Measured:
            interval = jnp.clip(points_below(values, measured[0]) - 1, 0, last)
            return interval, at_least(measured[0] - _at(values, interval), jnp.zeros_like(values[0]))

        return search

    def classifier(self) -> Classify:
        """Look-up of colour and extinction."""
        rows, values = self.rows(), jax.lax.stop_gradient(self.values)

        def looked_up(measured: Measured) -> tuple[Vec3, Scalar]:
            _, interval, past = measured
            return interpolated(row_of(rows, interval), past)

        def chosen(measured: Measured) -> tuple[Vec3, Scalar]:
            (value,) = measured
            row = tuple(rows[0])
            for start, following in zip(values[1:], rows[1:], strict=True):
                row = tuple(jnp.where(value >= start, b, a) for a, b in zip(row, following, strict=True))
            return interpolated(row, at_least(value - row[0], jnp.zeros_like(row[0])))

        return chosen if values.shape[0] <= FEW else looked_up

    def pull(self, measured: Measured, color: Vec3, extinction: Scalar) -> tuple["Transfer", Measured]:
        own = (TransferFunction.classifier, TransferFunction.rows)
        if any(getattr(type(self), method.__name__) is not method for method in own):
            transfer, (of_value, *found) = super().pull(measured, color, extinction)
            if found:  # how far past its point a value lies changes with the value
                of_value = of_value + jnp.where(measured[0] < self.values[0], 0, found[1])
            return transfer, (of_value,)
        # By one scatter of whole rows, where JAX would sum up for every entry of a row apart.
        rows, value = jax.lax.stop_gradient(self.rows()), measured[0]
        if self.values.shape[0] <= FEW:
            interval = jnp.maximum(points_below(self.values, value) - 1, 0)
            past = at_least(value - row_of(rows, interval)[0], jnp.zeros_like(value))
        else:
            _, interval, past = measured
        *_, r, g, b, slope, inverse = row_of(rows, interval)
        part = past * inverse
        parts = jnp.stack([*color, extinction], axis=-1)
        shared = jnp.concatenate([parts * (1 - part)[..., None], parts * part[..., None]], axis=-1)
        sums = jnp.zeros((rows.shape[0], 8), shared.dtype).at[interval].add(shared, mode="promise_in_bounds")
        at_points = sums[:, :4] + jnp.pad(sums[:-1, 4:], ((1, 0), (0, 0)))
        leaves = jnp.zeros_like(self.values), at_points[:, :3], at_points[:, 3]
        none = jax.tree.map(jnp.zeros_like, eqx.filter(self, eqx.is_inexact_array))
        transfer = eqx.tree_at(lambda t: (t.values, t.colors, t.extinction), none, leaves)
        of_value = color[0] * r + color[1] * g + color[2] * b + extinction * slope
        return transfer, (jnp.where(value < self.values[0], 0, of_value),)

    def rows(self) -> Float[Array, "points 10"]:
        """A table with one row for each point: all that a sample needs which lies past it, but not past the
        next one, so that it finds them side by side. Value, colour, extinction; the slopes of colour and
        extinction; and 1 over the way to the next point. Past the last one all slopes are 0, and past the
        first of two equal ones, where no value lies."""
        values = jax.lax.stop_gradient(self.values)
        gap = (values[1:] - values[:-1])[:, None]
        inverse = jnp.where(gap > 0, 1 / jnp.where(gap > 0, gap, 1), 0)
        at_points = jnp.concatenate([self.colors, self.extinction[:, None]], axis=1)
        slopes = jnp.concatenate([(at_points[1:] - at_points[:-1]) * inverse, inverse], axis=1)
        return jnp.concatenate([values[:, None], at_points, jnp.pad(slopes, ((0, 1), (0, 0)))], axis=1)


def at_least(value: Scalar, least: Scalar) -> Scalar:
    """The larger of the two; NaN stays NaN."""
    # by comparing, which takes less time than a maximum
    return jnp.where(value < least, least, value)


def points_below(
    values: Float[Array, " n"], value: Float[Array, "*batch"], *, strictly: bool = False
) -> Int[Array, "*batch"]:
    """How many control points lie at or below a value, or strictly below it."""
    values, last = jax.lax.stop_gradient(values), values.shape[0] - 1

    def searched(value: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        # Comparing with every point is one fused kernel, the faster one while there are few points.
        how, side = "compare_all" if last < 2 * FEW else "scan_unrolled", "left" if strictly else "right"
        return jnp.searchsorted(values, value, side=side, method=how).astype(jnp.int32)

    if last < FEW:
        return searched(value)
    first, step = values[0], (values[-1] - values[0]) / last

    def counted(value: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        """For points that lie evenly: by a division, which may be off by one."""
        guess = jnp.clip(((value - first) / step).astype(jnp.int32), 0, last - 1)
        reached = [
            value > at if strictly else value >= at for at in (_at(values, guess), _at(values, guess + 1))
        ]
        return guess + sum(each.astype(jnp.int32) for each in reached)

    # by their places: small deviations of each from the one before would add up
    places = first + step * jnp.arange(last + 1, dtype=values.dtype)
    even = jnp.all(jnp.abs(values - places) < 0.4 * step)
    return jax.lax.cond(even, counted, searched, value)


def _at(values: Float[Array, " n"], point: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    return values.at[point].get(mode="promise_in_bounds", wrap_negative_indices=False)


def row_of(rows: Float[Array, "points 10"], point: Int[Array, "..."]) -> Row:
    """One row, by a look-up for each of its entries: batched, they are whole arrays from the start."""
    point = jnp.clip(point, 0, rows.shape[0] - 1)
    return tuple(
        rows[:, i].at[point].get(mode="promise_in_bounds", wrap_negative_indices=False)
        for i in range(rows.shape[1])
    )


def interpolated(row: Row, past: Scalar) -> tuple[Vec3, Scalar]:
    """Colour and extinction of a value so far past a point, from its row."""
    r, g, b, extinction = (at + past * slope for at, slope in zip(row[1:5], row[5:9], strict=True))
    # where it falls to 0 it may be rounded to less; NaN stays NaN
    return (r, g, b), jnp.where(extinction < 0, 0, extinction)


def seen_between(
    values: Float[Array, " n"],
    extinction: Float[Array, " n"],
    low: Float[Array, "*blocks"],
    high: Float[Array, "*blocks"],
) -> Bool[Array, "*blocks"]:
    """Whether the extinction is positive anywhere from `low` to `high`."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    positive, n = extinction > 0, values.shape[0]
    if n > FEW:  # comparing with each point would cost more than looking up how many lie below
        before = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(positive, dtype=jnp.int32)])
        # between two points there is something to see wherever one of the two has extinction
        from_point = jnp.maximum(points_below(values, low) - 1, 0)
        # the first point at `high` or above, or the second, where two stand at `high`
        to_point = jnp.maximum(points_below(values, high, strictly=True), points_below(values, high) - 1)
        to_point = jnp.minimum(to_point, n - 1)
        return before[to_point + 1] > before[from_point]
    seen = jnp.zeros(low.shape, bool)
    for point in range(n):
        # a point's extinction is seen from the point before it to the one behind it
        reached = jnp.full(low.shape, positive[point])
        if point > 0:
            reached &= (high > values[point - 1]) | (high >= values[point])
        if point < n - 1:
            reached &= low < values[point + 1]
        seen |= reached
    return seen


def extinction_of(opacity: Arrayable, unit_distance: Arrayable = 1.0) -> Float[Array, " n"]:
    """The extinction (1/length) under which a layer of thickness `unit_distance` has this opacity.

    Inverse of `1 - exp(-extinction unit_distance)`; an opacity above 1 - 2⁻²⁴ counts as that, the
    largest float32 below 1. **Raises** `ValueError` for an opacity outside [0, 1].
    """
    unit_distance = number("unit_distance", unit_distance, above=0)
    opacity = unit_interval("opacity", opacity, (None,))
    return _extinction(opacity, unit_distance)


@jax.jit
def _extinction(opacity: Float[Array, " n"], unit_distance: Float[Array, ""]) -> Float[Array, " n"]:
    return -jnp.log1p(-jnp.minimum(opacity, 1 - 2.0**-24)) / unit_distance
