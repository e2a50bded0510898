"""A plot beside the controls: how often each value occurs, and what opacity it has; an SVG for both faces."""

import math
from dataclasses import dataclass

import numpy as np

from ...scene.volume import Volume
from ..automatic.histogram import sampled
from .curve import Curve
from .look import Color, Ranged


BINS = 128

WIDTH, HEIGHT, FOOT = 320, 84, 14
"""Of the plot, in its own units; `FOOT` is for the numbers under it."""

RADIUS = 4
"""Of a point."""


@dataclass(frozen=True)
class Histogram:
    """Of a volume's values, of which every n-th is looked at in a large volume.

    - `low`, `high`: the least and the greatest value.
    - `heights`: of `BINS` columns, in [0, 1]: log(1 + count), the highest 1, so that what is rare is seen
      beside the air around it.
    """

    low: float
    high: float
    heights: tuple[float, ...]

    @property
    def width(self) -> float:
        """Of its range of values, above 0."""
        return self.high - self.low

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

    def plot(self, look: Ranged) -> str:
        """An SVG of the histogram, grey, behind a look: a curve's points at the square root of their opacity,
        so that thin ones can be told apart; of other looks, the ends of their range."""
        marks = self._curve(look) if isinstance(look, Curve) else self._ends(look)
        columns = " ".join(
            f"{WIDTH * (column + side) / BINS:.1f},{self._up(height):.1f}"
            for column, height in enumerate(self.heights)
            for side in (0, 1)
        )
        numbers = "".join(
            f'<text x="{x}" y="{HEIGHT + FOOT - 3}" text-anchor="{anchor}" font-size="10" '
            f'fill="currentColor">{value:.4g}</text>'
            for x, anchor, value in ((0, "start", self.low), (WIDTH, "end", self.high))
        )
        return (
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT + FOOT}" width="100%" xmlns="http://www.w3.org/2000/svg" '
            'style="display: block; font-family: sans-serif">'
            "<title>grey: how often each value occurs (logarithmic); line: square root of the opacity</title>"
            f'<polygon points="0,{HEIGHT} {columns} {WIDTH},{HEIGHT}" fill="#8888" />{marks}{numbers}</svg>'
        )

    def _across(self, value: float) -> float:
        return WIDTH * min(max((value - self.low) / self.width, 0), 1)

    def _up(self, part: float) -> float:
        """Room is left for a point at the top."""
        return HEIGHT - (HEIGHT - RADIUS - 1) * part

    def _curve(self, curve: Curve) -> str:
        # the extinction is linear between points, the opacity is not
        at = np.linspace(self.low, self.high, 2 * BINS + 1)
        every = np.sort(np.concatenate([at, np.clip(curve.values, self.low, self.high)]))
        extinction = np.interp(every, curve.values, curve.extinctions)
        opacity = -np.expm1(-extinction * curve.unit_distance)
        line = " ".join(
            f"{self._across(value):.1f},{self._up(math.sqrt(part)):.1f}"
            for value, part in zip(every.tolist(), opacity.tolist(), strict=True)
        )
        points = "".join(
            f'<circle cx="{self._across(value):.1f}" cy="{self._up(math.sqrt(curve.opacity(index))):.1f}" '
            f'r="{RADIUS}" fill="{hex_of(curve.display_color(index))}" stroke="currentColor" />'
            for index, value in enumerate(curve.values)
            if curve.editable and self.low <= value <= self.high
        )
        return f'<polyline points="{line}" fill="none" stroke="currentColor" />{points}'

    def _ends(self, look: Ranged) -> str:
        return "".join(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{HEIGHT}" stroke="currentColor" />'
            for x in map(self._across, (look.values[0], look.values[-1]))
        )


def hex_of(color: Color) -> str:
    """`#rrggbb` of an sRGB colour in [0, 1]."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in color)
