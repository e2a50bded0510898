"""The `vessels` phantom: a branching tree.

Its branches feed points scattered in a crown above the root. A branch covers part of the way to the points
it feeds and splits them between two children, whose radii follow Murray's law.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from .canvas import Canvas
from .shapes import capsule


TRUNK, THINNEST = 0.12, 0.02  # radii
GENERATIONS = 8


def draw(canvas: Canvas, rng: np.random.Generator) -> None:
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
    """Join a branch to the field, and its children."""
    # the last branch reaches the centroid of its points, the others go half of the way
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
