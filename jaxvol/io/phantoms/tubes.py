"""Phantoms `colon`, a winding tube with folds and polyps, and `vessels`, a tree that supplies random points:
a branch covers part of the way, and splits the points between two children (radii by Murray's law)."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from ..._util.checks import integer
from .canvas import Canvas, plane_waves
from .shapes import ball, box, capsule, lengths, to_segment


def colon_path(points: int = 400) -> Float[np.ndarray, "points 3"]:
    """Compute evenly spaced points of the centre line of the `colon` lumen, end to end.

    The line is a path for a fly-through camera, the same for every seed and resolution.

    Args:
        points: number of points.

    Returns:
        The points, in world coordinates.

    Raises:
        ValueError: for fewer than 2 points.
    """
    from scipy.interpolate import CubicSpline  # slow to import

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


def draw_colon(canvas: Canvas, rng: np.random.Generator) -> None:
    wall, deepest, bend = 0.035, 0.2, colon_path(161)
    length = float(lengths(bend)[-1])
    tissue, uneven = plane_waves(rng, 0.15, 0.6), plane_waves(rng, 0.25, 0.5)
    polyps = []
    for place in np.linspace(0.08, 0.94, 7) + rng.uniform(-0.04, 0.04, 7):
        random_vector, i = rng.normal(size=3), int(place * 160)
        normal = np.cross(bend[i + 1] - bend[i - 1], random_vector)
        center = bend[i] + 0.155 * (normal / np.linalg.norm(normal))
        polyps.append(ball(tuple(center.tolist()), float(rng.uniform(0.035, 0.06))))

    def lumen(field: Canvas) -> None:
        arc_length = np.zeros_like(field.values)
        for i, (a, b) in enumerate(pairwise(bend.tolist())):
            stretch = capsule(a, b, deepest)
            for index, points in field.slabs(stretch.low, stretch.high, wall + 2 * field.spacing):
                distance, t = to_segment(*points, a, b)
                nearer = distance < field.values[index]
                np.copyto(field.values[index], distance, where=nearer)
                np.copyto(arc_length[index], (i + t) * (length / 160), where=nearer)
        for index, points in field.slabs():
            distance, s = field.values[index], arc_length[index]
            if distance.min() < 1:
                # pouches between crescent folds, 0.17 apart, deeper on one side than on the other
                fold = np.exp(-((np.abs(np.sin(np.pi * s / 0.17)) / 0.42) ** 2))
                bumps = uneven(*points)
                radius = 0.165 + 0.012 * bumps - fold * np.clip(0.045 + 0.035 * bumps, 0, 0.09)
                distance -= np.clip(radius, 0.07, deepest)
        field.carve(polyps, 0.03)

    inside = canvas.field(lumen)
    canvas.paint(lambda x, y, z, d: 180 + 5 * tissue(x, y, z), box((0, 0, 0), (0.94,) * 3, 0.15))
    canvas.paint(220, inside, grown=wall)
    canvas.paint(0, inside)


TRUNK, THINNEST = 0.12, 0.02  # radii
GENERATIONS = 8


def draw_vessels(canvas: Canvas, rng: np.random.Generator) -> None:
    cloud = rng.normal(size=(4000, 3))
    cloud *= 0.95 * rng.uniform(0, 1, (4000, 1)) ** (1 / 3) / np.linalg.norm(cloud, axis=1, keepdims=True)
    crown = cloud[cloud[:, 2] > 0.5 * np.linalg.norm(cloud[:, :2], axis=1) - 0.5]
    root, up = np.array([0, 0, -1.0]), np.array([0, 0, 1.0])
    canvas.paint(230, canvas.field(lambda field: _grow(field, rng, root, up, TRUNK, crown)))


def _grow(
    field: Canvas,
    rng: np.random.Generator,
    start: Float[np.ndarray, "3"],
    heading: Float[np.ndarray, "3"],
    radius: float,
    cloud: Float[np.ndarray, "points 3"],
    generation: int = 1,
) -> None:
    """Join a branch and its children to the field."""
    # the last generation reaches the centroid of its points, the others go half of the way
    middle = cloud.mean(axis=0)
    end = start + (middle - start) * (0.5 if generation < GENERATIONS else 1)
    bend = start + heading * (0.45 * np.linalg.norm(end - start))
    longest = np.linalg.eigh((cloud - middle).T @ (cloud - middle))[1][:, -1]
    across = (cloud - middle) @ (longest + rng.normal(0, 0.25, 3))
    share = rng.uniform(0.3, 0.7)
    first = across < np.quantile(across, share)
    shares = ((cloud[first], share), (cloud[~first], 1 - share))
    radii = [max(THINNEST, radius * part ** (1 / 3)) for _, part in shares]  # Murray's law
    t = np.linspace(0, 1, 5)[:, None]
    line = ((1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * end).tolist()
    wide = np.linspace(radius, max(radii), 5).tolist()
    for (a, b), (broad, narrow) in zip(pairwise(line), pairwise(wide), strict=True):
        field.join(capsule(a, b, broad, narrow))
    if generation < GENERATIONS:
        ahead = (end - bend) / np.linalg.norm(end - bend)
        for (part, _), child in zip(shares, radii, strict=True):
            if len(part) > 1:
                _grow(field, rng, end, ahead, child, part, generation + 1)
