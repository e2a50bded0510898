"""A plot beside the controls: how often each value occurs, and what opacity it has; an SVG for both faces."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...scene.transfer import TransferFunction
from ...scene.volume import Volume
from ..automatic.histogram import sampled


BINS = 128

WIDTH, HEIGHT = 320, 84


@dataclass(frozen=True)
class Histogram:
    """Of a volume's values, of which every n-th is looked at in a large volume.

    - `low`, `high`: the least and the greatest value. `heights`: of the bins, log(1 + count), 1 at most.
    """

    low: float
    high: float
    heights: Float[np.ndarray, " bins"]

    @classmethod
    def of(cls, volume: Volume) -> "Histogram":
        """Of a volume."""
        values = sampled(volume).ravel().astype(np.float64)
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
        high = high if high > low else low + max(abs(low), 1.0)
        counts = np.log1p(np.histogram(values, BINS, (low, high))[0])
        return cls(low, high, counts / max(counts.max(), 1))

    def plot(self, transfer: TransferFunction, unit_distance: float) -> str:
        """An SVG of the histogram, grey, behind the square root of the opacity, so that thin materials can be
        told apart."""
        values = np.linspace(self.low, self.high, 4 * BINS)
        extinction = np.interp(values, np.asarray(transfer.values), np.asarray(transfer.extinction))
        line = _points(np.sqrt(-np.expm1(-extinction * unit_distance)))
        return (
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="100%" xmlns="http://www.w3.org/2000/svg">'
            f'<polygon points="0,{HEIGHT} {_points(self.heights)} {WIDTH},{HEIGHT}" fill="#8888" />'
            f'<polyline points="{line}" fill="none" stroke="currentColor" /></svg>'
            f'<div style="display: flex; justify-content: space-between; font-size: 10px">'
            f"<span>{self.low:.4g}</span><span>{self.high:.4g}</span></div>"
        )


def _points(heights: Float[np.ndarray, " n"]) -> str:
    """Points of an SVG's line from the left to the right. `heights`: in [0, 1]."""
    across, down = np.linspace(0, WIDTH, len(heights)), HEIGHT - (HEIGHT - 2) * heights
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
