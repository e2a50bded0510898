"""Where does a camera stand on an orbit?"""

import argparse

from ..camera import Camera
from .scene import Scene, axis_of, turned


PLANNED_VIEWS = 4
"""Views of an orbit, evenly spaced, for which its march is planned."""


def angles_of(degrees: float, frames: int) -> list[float]:
    """Angles of the frames: evenly spaced from 0 on, to `degrees`; or, where that ends at the beginning, to
    one frame before it."""
    closed = degrees % 360 == 0
    return [degrees * i / max(frames if closed else frames - 1, 1) for i in range(frames)]


def views_of(options: argparse.Namespace, scene: Scene, degrees: float) -> list[Camera]:
    """Views for which an orbit is planned: the same for all of its frames."""
    return [turned(scene.camera, angle, axis_of(options)) for angle in angles_of(degrees, PLANNED_VIEWS)]
