"""Which colour and extinction has this value?"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .checks import Arrayable, finite_array, number, require, unit_interval
from .triple import Scalar, Triple
from .volume import Volume


Classify: TypeAlias = Callable[[Triple], tuple[Triple, Scalar]]
"""From a grid coordinate to colour (r, g, b) and extinction (1/length)."""


class Transfer(eqx.Module):
    """What a renderer asks of a transfer function, of whatever kind."""

    @abstractmethod
    def over(self, volume: Volume) -> Classify:
        """Classification of grid coordinates of this volume. What does not depend on the coordinate is
        computed here, once, outside the march's loop."""


class TransferFunction(Transfer):
    """Colour and extinction, piecewise linear in the volume's value and constant beyond the ends.

    **Arguments:**

    - `values`: (n,) increasing control points, in value units; n ≥ 2. They carry no gradient.
    - `colors`: (n, 3) linear RGB at the points. Not premultiplied; usually in [0, 1].
    - `extinction`: (n,) at the points, in 1/length, ≥ 0. A cell of width w has opacity
      `1 - exp(-extinction w)`.

    Extinction is what is interpolated. VTK interpolates opacity; the two agree at the points, and
    differ between points where the opacity of a unit distance is high.

    **Raises:** `ValueError` for fewer than two points, points that do not increase, negative
    extinction, NaN or infinity, or lengths that differ.
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
            lambda v: v[1:] > v[:-1],
            "values must increase from point to point; got {got}. Sort them, and move equal ones apart.",
        )
        self.colors = finite_array("colors", colors, (n, 3))
        extinction = finite_array("extinction", extinction, (n,))
        self.extinction = require(extinction, lambda e: e >= 0, "extinction must not be negative; got {got}.")

    @classmethod
    def from_points(
        cls,
        points: Sequence[tuple[float, tuple[float, float, float], float]],
        unit_distance: float = 1.0,
    ) -> "TransferFunction":
        """From control points `(value, (r, g, b), opacity)`, as one draws them in a viewer.

        **Arguments:**

        - `points`: in increasing order of value. `opacity` in [0, 1] is that of a layer of thickness
          `unit_distance`, and becomes the extinction `-ln(1 - opacity) / unit_distance` exactly.
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

    def __call__(self, value: Scalar) -> tuple[Triple, Scalar]:
        """Colour (r, g, b) and extinction of a value."""
        return self._look_up()(value)

    def over(self, volume: Volume) -> Classify:
        """Classification of grid coordinates of this volume."""
        look_up = self._look_up()
        return lambda coordinate: look_up(volume.value(coordinate))

    def opacity(self, unit_distance: float = 1.0) -> Float[Array, " n"]:
        """Opacity at the control points of a layer of thickness `unit_distance`."""
        return -jnp.expm1(-self.extinction * number("unit_distance", unit_distance, above=0))

    def _look_up(self) -> Callable[[Scalar], tuple[Triple, Scalar]]:
        rows, last = self.rows(), self.values.shape[0] - 2

        def look_up(value: Scalar) -> tuple[Triple, Scalar]:
            row = rows.at[jnp.clip(points_below(self.values, value) - 1, 0, last)].get(
                mode="promise_in_bounds"
            )
            return interpolated(row, value)

        return look_up

    def rows(self) -> Float[Array, "intervals 10"]:
        """A table with one row for each interval between points: all that a sample there needs, so that it
        costs one gather. Start, inverse width, channels at the start, and how much they rise."""
        values = jax.lax.stop_gradient(self.values)
        channels = jnp.concatenate([self.colors, self.extinction[:, None]], axis=1)
        inverse = 1 / (values[1:] - values[:-1])
        columns = [values[:-1, None], inverse[:, None], channels[:-1], channels[1:] - channels[:-1]]
        return jnp.concatenate(columns, axis=1)


def points_below(values: Float[Array, " n"], value: Scalar) -> Int[Array, ""]:
    """How many control points lie at or below a value."""
    # Comparing with every point is one fused kernel, the faster one while there are few points.
    search = "compare_all" if values.shape[0] <= 32 else "scan_unrolled"
    values = jax.lax.stop_gradient(values)
    return jnp.searchsorted(values, value, side="right", method=search).astype(jnp.int32)


def interpolated(row: Float[Array, "10"], value: Scalar) -> tuple[Triple, Scalar]:
    """Colour and extinction of a value, from the row of its interval."""
    f = jnp.clip((value - row[0]) * row[1], 0, 1)
    return (row[2] + f * row[6], row[3] + f * row[7], row[4] + f * row[8]), row[5] + f * row[9]


def extinction_of(opacity: Arrayable, unit_distance: Arrayable = 1.0) -> Float[Array, " n"]:
    """The extinction (1/length) under which a layer of thickness `unit_distance` has this opacity.

    Inverse of `1 - exp(-extinction unit_distance)`; an opacity above 1 - 2⁻²⁴ counts as that, the
    largest float32 below 1. **Raises** `ValueError` for an opacity outside [0, 1].
    """
    unit_distance = number("unit_distance", unit_distance, above=0)
    opacity = unit_interval("opacity", opacity, (None,))
    return -jnp.log1p(-jnp.minimum(opacity, 1 - 2.0**-24)) / unit_distance
