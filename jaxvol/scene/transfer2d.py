"""Transfer functions of the value and the magnitude of its gradient."""

from collections.abc import Callable, Sequence
from typing import ClassVar

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
    """Colour and extinction by value and gradient magnitude, which separates boundaries from materials: a
    table, bilinear between its lines and constant beyond them.

    Args:
        values: (n,) increasing, in value units; n ≥ 2.
        magnitudes: (m,) increasing, in value units per world length; m ≥ 2. Two equal neighbours make a step.
            Values and magnitudes have no gradient.
        colors: (n, m, 3) linear RGB, not premultiplied; usually in [0, 1].
        extinction: (n, m), in 1/length, ≥ 0; negative values count as 0, without a gradient.

    The gradient is taken in the volume's grid, also under a `ToroidalMap`, which bends the grid: choose a
    meaningful spacing. Where the gradient is 0, the derivative of its magnitude is taken as 0.
    `quadrature="preintegrated"` and `"average"` are refused.

    Raises:
        ValueError: for fewer than two lines, lines that do not increase, three equal lines, negative
            extinction, NaN or infinity, or shapes that do not fit together.

    Sources: Levoy, "Display of Surfaces from Volume Data", 1988; Kniss et al., "Multidimensional Transfer
    Functions for Interactive Volume Rendering", 2002.
    """

    bands = 3
    subclass_instead: ClassVar[str] = "jaxvol.Transfer instead"

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
        points: Sequence[tuple[Arrayable, Arrayable, Arrayable, Arrayable, Arrayable]],
        unit_distance: Arrayable = 1.0,
    ) -> "TransferFunction2D":
        """A sum of tents in the plot of magnitude against value, one for each material.

        Args:
            points: `(value, magnitude, (r, g, b), opacity, (reach, magnitude_reach))`. The extinction of a
                point is that of its opacity, times 1 - |value - the point's| / reach, and likewise for the
                magnitude.
            unit_distance: thickness of a layer with these opacities, world length.

        Where points overlap, extinctions are added; colours are means weighted by extinction on the lines
        through centers and sides of the tents, and bilinear in between.

        Raises:
            ValueError: for no points, malformed points, an opacity outside [0, 1], reaches that are not
                positive, and traced values, magnitudes or reaches: lines carry no gradient.

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
            """Lines, the tent of each point on the lines, and their distances from it, in reaches."""
            ends = np.stack([place - reach, place, place + reach], axis=1)
            lines = np.unique(ends)
            tents = np.stack([np.interp(lines, end, (0, 1, 0)) for end in ends])  # exactly 0 on the sides
            return lines, tents, np.abs(lines - place[:, None]) / reach[:, None]

        axes = map(axis, map(np.asarray, places), np.asarray(reach).T)
        (rows, row_tents, row_distance), (columns, column_tents, column_distance) = axes
        tents = row_tents[:, :, None] * column_tents[:, None]  # (points, values, magnitudes)
        extinctions = extinction_of(opacities, unit_distance)[:, None, None] * tents
        extinction = jnp.sum(extinctions, axis=0)
        rgb, visible = finite_array("colors", colors, (count, 3)), (extinction > 0)[..., None]
        mean = jnp.einsum("pnm,pc->nmc", extinctions, rgb) / jnp.where(visible, extinction[..., None], 1)
        # the colour of the nearest point where nothing is visible, so that it reaches the sides of its tent
        nearest = rgb[np.argmin(np.maximum(row_distance[:, :, None], column_distance[:, None]), axis=0)]
        return cls(rows, columns, jnp.where(visible, mean, nearest), extinction)

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
            i, u = bilinear.between_lines(self.values, value)
            j, v = bilinear.between_lines(self.magnitudes, magnitude)
            return i * (self.magnitudes.shape[0] - 1) + j, u, v

        return search

    def classifier(self) -> Classify:
        rows = self.rows()

        def classify(measured: Measured) -> tuple[Vec3, Scalar]:
            _, _, cell, u, v = measured
            r, g, b, extinction = bilinear.interpolate_corners(table_row(rows, cell), u, v)
            return (r, g, b), extinction

        return classify

    def vjp(
        self, measured: Measured, color: Color, extinction: Scalar, *, integrated: bool = False
    ) -> tuple[Transfer, Measured]:
        # One scatter of rows; JAX's transpose would scatter each entry of a row by itself.
        value, magnitude, cell, u, v = measured
        rows, pull_rows = jax.vjp(lambda transfer: transfer.rows(), self)
        row = table_row(rows, cell)
        _, pull = jax.vjp(bilinear.interpolate_corners, row, u, v)
        of_row, of_u, of_v = pull((*color, extinction))
        (transfer,) = pull_rows(row_sums(len(rows), cell, jnp.stack(of_row, axis=-1)))
        i, j = jnp.divmod(cell, self.magnitudes.shape[0] - 1)
        of_value = of_u * bilinear.slope_between_lines(self.values, value, i)
        return transfer, (of_value, of_v * bilinear.slope_between_lines(self.magnitudes, magnitude, j))

    def rows(self) -> Float[Array, "cells 16"]:
        """One row for each cell between lines: colour and extinction of its four corners."""
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
        """Ranges of the table's values and magnitudes on which blocks depend."""
        values, magnitudes = jax.lax.stop_gradient((self.values, self.magnitudes))
        return points_around(values, blocks.low, blocks.high), points_around(magnitudes, *blocks.magnitudes)
