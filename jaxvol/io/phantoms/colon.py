"""The `colon` phantom: its centre line, folds and polyps."""

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from ..._util.checks import integer
from .canvas import Canvas, plane_waves
from .shapes import ball, box, capsule, lengths, to_segment


def colon_path(points: int | Any = 400) -> Float[np.ndarray, "points 3"]:
    """World points evenly spaced along the centre line of the `colon` lumen, end to end.

    The path for a fly-through camera. It is the same for every seed and resolution.

    **Arguments:** `points`: their number.

    **Returns:** the points, in world coordinates.

    **Raises:** `ValueError` for fewer than 2 points.
    """
    from scipy.interpolate import CubicSpline  # here, so that a first image does not wait for it

    points = integer("points", points, 2)
    turns = [(-0.6, -0.6, -0.66), (-0.64, -0.5, -0.1), (-0.6, -0.55, 0.45), (-0.3, -0.3, 0.68)]
    turns += [(0.1, -0.5, 0.45), (0.52, -0.55, 0.6), (0.66, -0.1, 0.35), (0.6, 0.1, -0.2), (0.45, -0.3, -0.6)]
    turns += [(0.0, -0.1, -0.66), (-0.3, 0.3, -0.6), (-0.6, 0.6, -0.3), (-0.5, 0.6, 0.3), (0.0, 0.6, 0.5)]
    turns += [(0.4, 0.62, 0.1), (0.4, 0.62, -0.5)]
    curve = CubicSpline(np.arange(len(turns)), np.array(turns))
    fine = curve(np.linspace(0, len(turns) - 1, 4000))
    length = lengths(fine)
    even = np.linspace(0, length[-1], points)
    return np.stack([np.interp(even, length, fine[:, axis]) for axis in range(3)], axis=1)


def draw(canvas: Canvas, rng: np.random.Generator) -> None:
    wall, deepest, bend = 0.035, 0.2, colon_path(161)
    length = float(lengths(bend)[-1])
    tissue, uneven = plane_waves(rng, 0.15, 0.6), plane_waves(rng, 0.25, 0.5)
    polyps = []
    for place in np.linspace(0.08, 0.94, 7) + rng.uniform(-0.04, 0.04, 7):
        along, out, i = rng.normal(size=3), 0.155, int(place * 160)
        ahead = bend[i + 1] - bend[i - 1]
        out *= np.cross(ahead, along) / np.linalg.norm(np.cross(ahead, along))
        polyps.append(ball(tuple((bend[i] + out).tolist()), float(rng.uniform(0.035, 0.06))))

    def lumen(field: Canvas) -> None:
        along = np.zeros_like(field.values)
        for i, (a, b) in enumerate(pairwise(bend.tolist())):
            stretch = capsule(a, b, deepest)
            for where, at in field.slabs(stretch.low, stretch.high, wall + 2 * field.spacing):
                away, t = to_segment(*at, a, b)
                nearer = away < field.values[where]
                np.copyto(field.values[where], away, where=nearer)
                np.copyto(along[where], (i + t) * (length / 160), where=nearer)
        for where, at in field.slabs():
            away, s = field.values[where], along[where]
            if away.min() < 1:
                # pouches between crescent folds, 0.17 apart, deeper on one side than on the other
                fold = np.exp(-((np.abs(np.sin(np.pi * s / 0.17)) / 0.42) ** 2))
                bumps = uneven(*at)
                radius = 0.165 + 0.012 * bumps - fold * np.clip(0.045 + 0.035 * bumps, 0, 0.09)
                away -= np.clip(radius, 0.07, deepest)
        field.carve(polyps, 0.03)

    inside = canvas.field(lumen)
    canvas.paint(lambda x, y, z, d: 180 + 5 * tissue(x, y, z), box((0, 0, 0), (0.94,) * 3, 0.15))
    canvas.paint(220, inside, grown=wall)
    canvas.paint(0, inside)
