"""Which colour and extinction has this value, where the volume is this steep?"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._util import bilinear
from .._util.checks import Arrayable, finite_array, increasing, require
from .._util.piecewise_linear import ROUNDING, Range, not_negative, points_around, table_row
from .._util.vec3 import Color, Scalar, Vec3, length
from ..xla.memory import row_sums
from ..xla.platform import is_traced
from .occupancy import Blocks
from .transfer import Classify, Measured, Transfer, extinction_of
from .volume import Volume


class TransferFunction2D(Transfer):
    """Colour and extinction by the value and the magnitude of its gradient, which tells boundaries from
    materials: a table, bilinear between its lines and constant beyond them.

    Args:
        values: (n,) increasing, in value units; n ≥ 2.
        magnitudes: (m,) increasing, in value units per world length; m ≥ 2. Two neighbours may be equal, and
            make a step. Values and magnitudes have no gradient.
        colors: (n, m, 3) linear RGB, not premultiplied; usually in [0, 1].
        extinction: (n, m), in 1/length, ≥ 0; below, it counts as 0, and has no gradient.

    The magnitude is that of the value's gradient in the volume's own grid, also under a `ToroidalMap`, which
    bends the grid: choose a spacing for which that has a meaning. Where the gradient is 0, the derivative of
    its magnitude is taken as 0. `quadrature="preintegrated"` and `"average"` are refused.

    Raises:
        ValueError: for fewer than two lines, lines that do not increase or of which three are equal,
            negative extinction, NaN or infinity, or shapes that do not fit together.

    Sources: Levoy, "Display of Surfaces from Volume Data", 1988; Kniss et al., "Multidimensional Transfer
    Functions for Interactive Volume Rendering", 2002.
    """

    bands = 3
    values: Float[Array, " n"]
    magnitudes: Float[Array, " m"]
    colors: Float[Array, "n m 3"]
    extinction: Float[Array, "n m"]

    def __init__(self, values: Arrayable, magnitudes: Arrayable, colors: Arrayable, extinction: Arrayable):
        self.values = increasing("values", values)
        self.magnitudes = increasing("magnitudes", magnitudes)
        shape = self.values.shape[0], self.magnitudes.shape[0]
        self.colors = finite_array("colors", colors, (*shape, 3))
        extinction = finite_array("extinction", extinction, shape)
        self.extinction = require(extinction, lambda e: e >= 0, "extinction must not be negative; got {got}.")

    @classmethod
    def from_points(
        cls,
        points: Sequence[tuple[float, float, Sequence[float], float, tuple[float, float]]] | Any,
        unit_distance: Arrayable = 1.0,
    ) -> "TransferFunction2D":
        """From places in the plot of magnitude against value, each with the material seen there.

        Args:
            points: `(value, magnitude, (r, g, b), opacity, (reach, magnitude_reach))`. The extinction of each
                is that of this opacity, times 1 - |value - the point's| / reach, and so by the magnitude.
            unit_distance: thickness of a layer that has these opacities, world length.

        Where points overlap, extinctions are added; colours are means weighted by them on the lines through
        points and sides, and bilinear between.

        Raises:
            ValueError: for no points or what is none, an opacity outside [0, 1], reaches that are not
                positive, and places that are traced: lines carry no gradient.

        Source: Kniss et al. 2002, whose widgets are such tents.
        """
        try:
            values, magnitudes, colors, opacities, reaches = zip(*points, strict=True)
        except (TypeError, ValueError) as fault:
            form = "(value, magnitude, (r, g, b), opacity, (reach, magnitude_reach))"
            raise ValueError(f"points must be one or more of {form}; got {points!r}.") from fault
        if is_traced(values, magnitudes, reaches):
            raise ValueError("values, magnitudes and reaches of points must be numbers; some are traced.")
        count = len(values)
        places = finite_array("values", values, (count,)), finite_array("magnitudes", magnitudes, (count,))
        reach = finite_array("reaches", reaches, (count, 2))
        reach = require(reach, lambda reach: reach > 0, "reaches must be positive; got {got}.")

        def axis(place: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Lines, the tent of each point on them, and how far they are from it, in reaches."""
            ends = np.stack([place - reach, place, place + reach], axis=1)
            lines = np.unique(ends)
            tents = np.stack([np.interp(lines, end, (0, 1, 0)) for end in ends])  # exactly 0 on the sides
            return lines, tents, np.abs(lines - place[:, None]) / reach[:, None]

        (lines, along, far), (others, across, away) = map(axis, map(np.asarray, places), np.asarray(reach).T)
        tents = along[:, :, None] * across[:, None]  # (points, values, magnitudes)
        each = extinction_of(opacities, unit_distance)[:, None, None] * tents
        extinction = jnp.sum(each, axis=0)
        rgb = finite_array("colors", colors, (count, 3))
        mean = jnp.einsum("pnm,pc->nmc", each, rgb) / jnp.where(extinction > 0, extinction, 1)[..., None]
        # where nothing is seen, the colour of the nearest point, so that it reaches to its sides
        nearest = rgb[np.argmin(np.maximum(far[:, :, None], away[:, None]), axis=0)]
        return cls(lines, others, jnp.where((extinction > 0)[..., None], mean, nearest), extinction)

    def __call__(self, value: Scalar, magnitude: Scalar) -> tuple[Color, Scalar]:
        """Colour (r, g, b) and extinction of a value and a magnitude of the gradient."""
        return self.classifier()((value, magnitude, *self.search()((value, magnitude))))

    @property
    def channels(self) -> int:
        return 1

    @property
    def valid(self) -> Bool[Array, ""]:
        return jnp.all(jnp.concatenate([jnp.diff(self.values), jnp.diff(self.magnitudes)]) >= 0)

    @property
    def reads_gradient(self) -> bool:
        return True

    def attributes(self, volume: Volume, coordinate: Vec3) -> Measured:
        return (length(volume.frame.gradient(volume.gradient(coordinate))),)

    def search(self) -> Callable[[Measured], Measured]:
        def search(measured: Measured) -> Measured:
            value, magnitude = measured
            i, along = bilinear.between_lines(self.values, value)
            j, across = bilinear.between_lines(self.magnitudes, magnitude)
            return i * (self.magnitudes.shape[0] - 1) + j, along, across

        return search

    def classifier(self) -> Classify:
        rows = self.rows()

        def classify(measured: Measured) -> tuple[Vec3, Scalar]:
            _, _, cell, along, across = measured
            r, g, b, extinction = bilinear.interpolate_corners(table_row(rows, cell), along, across)
            return (r, g, b), extinction

        return classify

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple[Transfer, Measured]:
        # One scatter of whole rows; JAX's transpose would scatter each entry of a row by itself.
        value, magnitude, cell, along, across = measured
        rows, pull_rows = jax.vjp(lambda transfer: transfer.rows(), self)
        row = table_row(rows, cell)
        _, pull = jax.vjp(bilinear.interpolate_corners, row, along, across)
        of_row, of_along, of_across = pull((*color, extinction))
        (transfer,) = pull_rows(row_sums(len(rows), cell, jnp.stack(of_row, axis=-1)))
        i, j = jnp.divmod(cell, self.magnitudes.shape[0] - 1)
        of_value = of_along * bilinear.slope_between_lines(self.values, value, i)
        return transfer, (of_value, of_across * bilinear.slope_between_lines(self.magnitudes, magnitude, j))

    def rows(self) -> Float[Array, "cells 16"]:
        """A table with one row for each cell between lines: colour and extinction of its four corners."""
        extinction = not_negative(self.extinction)
        return bilinear.corner_rows(jnp.concatenate([self.colors, extinction[..., None]], axis=-1))

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        extinction = jax.lax.stop_gradient(not_negative(self.extinction))
        values, magnitudes = self._lines(blocks)
        bound = bilinear.greatest_between(extinction, values, magnitudes) * (1 + ROUNDING)
        return jnp.where(self.visible(blocks), bound, 0)

    def visible(self, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        values, magnitudes = self._lines(blocks)
        return bilinear.any_between(self.extinction > 0, values, magnitudes)

    def _lines(self, blocks: Blocks) -> tuple[Range, Range]:
        """The values and magnitudes of the table on which blocks depend."""
        values, magnitudes = jax.lax.stop_gradient((self.values, self.magnitudes))
        return points_around(values, blocks.low, blocks.high), points_around(magnitudes, *blocks.magnitudes)
