"""The `labels` phantom: a frog, and which of its organs each node belongs to.

The frog faces -y with its back towards +z, so its right side is towards -x.
"""

import numpy as np

from .canvas import Canvas
from .shapes import Point, Shape, ball, capsule, ellipsoid, pair, tube


SOFT = 0.06  # world units over which an intensity blends into its neighbour's
ORGANS = (  # label, intensity, shape
    (2, 95, ellipsoid((-0.15, -0.15, 0.06), (0.17, 0.21, 0.13))),  # right lung
    (3, 95, ellipsoid((0.15, -0.15, 0.06), (0.17, 0.21, 0.13))),  # left lung
    (4, 170, ellipsoid((-0.1, 0.15, -0.04), (0.25, 0.24, 0.17))),  # liver
    (5, 215, ellipsoid((0.2, 0.22, 0.0), (0.17, 0.26, 0.16))),  # stomach
)


def draw(canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    body = canvas.field(_body)
    canvas.paint(120, body, SOFT)
    labels = (body.values < 0).astype(np.uint8)
    deepest = np.zeros_like(body.values)
    for label, value, organ in ORGANS:
        canvas.paint(value, organ, SOFT)
        for where, at in canvas.slabs(organ.low, organ.high):
            # a node belongs to the organ it is deepest in, so overlapping organs meet in a smooth face
            distance = organ.distance(*at)
            nearer = distance < deepest[where]
            np.copyto(labels[where], label, where=nearer)
            np.copyto(deepest[where], distance, where=nearer)
    return labels


def _body(body: Canvas) -> None:
    body.join(ellipsoid((0, 0.05, 0), (0.42, 0.6, 0.3)), 0.15)
    body.join(ellipsoid((0, -0.50, 0.04), (0.40, 0.38, 0.21)), 0.15)  # head
    body.join(pair(ball((0.2, -0.56, 0.21), 0.115)), 0.04)  # eyes
    lips = [(0.0, -0.88, 0.0), (0.2, -0.815, 0.0), (0.33, -0.68, 0.01), (0.385, -0.54, 0.03)]
    body.carve(pair(*tube(lips, 0.015)), 0.03)
    hip, knee, heel, foot = (0.26, 0.48, -0.02), (0.73, 0.20, -0.08), (0.48, 0.70, -0.17), (0.72, 0.74, -0.22)
    leg = [capsule(hip, knee, 0.15, 0.10), capsule(knee, heel, 0.115, 0.065), capsule(heel, foot, 0.06, 0.05)]
    hind = _toes(foot, [(0.83, 0.53), (0.91, 0.66), (0.92, 0.80), (0.83, 0.92)])
    shoulder, elbow, wrist = (0.33, -0.28, -0.08), (0.63, -0.22, -0.14), (0.66, -0.54, -0.22)
    arm = [capsule(shoulder, elbow, 0.10, 0.075), capsule(elbow, wrist, 0.08, 0.05)]
    fore = _toes(wrist, [(0.54, -0.68), (0.65, -0.74), (0.76, -0.70), (0.83, -0.60)])
    body.join(pair(*leg, *arm), 0.08)
    body.join(pair(*hind, *fore), 0.03)


def _toes(root: Point, tips: list[tuple[float, float]]) -> list[Shape]:
    """Toes from a foot to tips (x, y) in its plane, each with a pad."""
    ends = [(*tip, root[2]) for tip in tips]
    return [part for end in ends for part in (capsule(root, end, 0.035, 0.025), ball(end, 0.036))]
