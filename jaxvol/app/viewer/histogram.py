"""A plot beside the controls: how often each value occurs, and what opacity it has; an SVG for both faces."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...scene.transfer import TransferFunction
from ...scene.transfer2d import TransferFunction2D
from ...scene.volume import Volume
from ..automatic.histogram import sampled
from .editing import has_editable_points, opacities, point_color


BINS = 128

WIDTH, HEIGHT, AXIS = 320, 84, 14
"""Of the plot, in its own units; `AXIS` is the height of the numbers under it."""

RADIUS = 4
"""Of a point."""


@dataclass(frozen=True)
class Histogram:
    """Of a volume's values, of which every n-th is looked at in a large volume.

    - `low`, `high`: the least and the greatest value.
    - `heights`: of `BINS` columns, in [0, 1]: log(1 + count), the highest 1, so that rare values are seen
      beside the air around them.
    """

    low: float
    high: float
    heights: tuple[float, ...]

    @classmethod
    def of(cls, volume: Volume) -> "Histogram":
        """Of a volume."""
        values = sampled(volume).ravel().astype(np.float64)
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
        high = high if high > low else low + max(abs(low), 1.0)
        counts, _ = np.histogram(values, BINS, (low, high))
        heights = np.log1p(counts) / np.log1p(max(int(counts.max()), 1))
        return cls(low, high, tuple(heights.tolist()))

    def plot(self, transfer: TransferFunction | TransferFunction2D, unit_distance: float) -> str:
        """An SVG of the histogram, grey, behind the square root of a transfer function's opacity, so that
        thin materials can be told apart; of a `TransferFunction2D`, the ends of its range."""
        marks = (
            self._curve(transfer, unit_distance)
            if isinstance(transfer, TransferFunction)
            else self._ends(transfer)
        )
        edges = np.linspace(self.low, self.high, BINS + 1).repeat(2)[1:-1]
        columns = self._path(edges, np.repeat(self.heights, 2))
        numbers = "".join(
            f'<text x="{x}" y="{HEIGHT + AXIS - 3}" text-anchor="{anchor}" font-size="10" '
            f'fill="currentColor">{value:.4g}</text>'
            for x, anchor, value in ((0, "start", self.low), (WIDTH, "end", self.high))
        )
        return (
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT + AXIS}" width="100%" xmlns="http://www.w3.org/2000/svg" '
            'style="display: block; font-family: sans-serif">'
            "<title>grey: how often each value occurs (logarithmic); line: square root of the opacity</title>"
            f'<polygon points="0,{HEIGHT} {columns} {WIDTH},{HEIGHT}" fill="#8888" />{marks}{numbers}</svg>'
        )

    def _curve(self, transfer: TransferFunction, unit_distance: float) -> str:
        # the extinction is linear between points, the opacity is not
        values = np.asarray(transfer.values, np.float64)
        between = np.linspace(self.low, self.high, 2 * BINS + 1)
        every = np.sort(np.concatenate([between, np.clip(values, self.low, self.high)]))
        extinction = np.interp(every, values, np.asarray(transfer.extinction))
        opacity = -np.expm1(-extinction * unit_distance)
        line = (
            f'<polyline points="{self._path(every, np.sqrt(opacity))}" fill="none" stroke="currentColor" />'
        )
        if not has_editable_points(transfer):
            return line
        x, y = self._x(values), _y(np.sqrt(opacities(transfer, unit_distance)))
        points = (
            f'<circle cx="{x[index]:.1f}" cy="{y[index]:.1f}" r="{RADIUS}" '
            f'fill="{point_color(transfer, index)}" stroke="currentColor" />'
            for index, value in enumerate(values)
            if self.low <= value <= self.high
        )
        return line + "".join(points)

    def _ends(self, transfer: TransferFunction2D) -> str:
        return "".join(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{HEIGHT}" stroke="currentColor" />'
            for x in self._x(np.asarray(transfer.values)[[0, -1]])
        )

    def _path(self, values: Float[np.ndarray, " n"], heights: Float[np.ndarray, " n"]) -> str:
        """Points of an SVG's line. `heights`: in [0, 1]."""
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(self._x(values), _y(heights), strict=True))

    def _x(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return WIDTH * np.clip((values - self.low) / (self.high - self.low), 0, 1)


def _y(heights: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return HEIGHT - (HEIGHT - RADIUS - 1) * heights  # leaves room for a point at the top
