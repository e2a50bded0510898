"""What is drawn over a viewer's image: where the axes of the world point, and the point that was picked."""

import numpy as np
from PIL import Image, ImageDraw

from .state import State
from .tiles import Pixels


LEAST = 120
"""Pixels of a view's smaller side, from which on it has marks."""

LENGTH, MARGIN = 30, 44
"""Pixels of the view: of an axis, and from its foot to the left and the lower edge."""

AXES = (("x", (214, 48, 49)), ("y", (30, 150, 60)), ("z", (40, 90, 220)))
"""Names and colours."""

PICKED, OUTLINE = (255, 214, 0), (40, 40, 40)


def with_marks(pixels: Pixels, state: State) -> Pixels:
    """An image with the marks, which may have fewer pixels than the view; a small view has none."""
    width, height = state.size
    if min(width, height) < LEAST:
        return pixels
    image = Image.fromarray(pixels)
    drawing = ImageDraw.Draw(image)
    scale = np.array(image.size) / state.size

    def line(begin: np.ndarray, end: np.ndarray, color: tuple[int, int, int], width: float) -> None:
        drawing.line([*(scale * begin), *(scale * end)], color, max(1, round(width * scale.min())))

    right, up, forward = state.orbit.axes()
    foot = np.array([MARGIN, height - MARGIN])
    for axis in np.argsort(-forward):  # those that point to the viewer last
        name, color = AXES[axis]
        along = np.array([right[axis], -up[axis]])
        line(foot, foot + LENGTH * along, color, 3)
        if np.linalg.norm(along) > 0.2:
            at = foot + (LENGTH + 8) * along / max(np.linalg.norm(along), 0.6)
            drawing.text(tuple(scale * at), name, color, anchor="mm", font_size=max(7, 14 * scale.min()))
    place = None if state.point is None else state.orbit.place(state.point, parallel=state.parallel)
    if place is not None:
        middle = np.array([width / 2 + place[0] * height / 2, height / 2 - place[1] * height / 2])
        for color, wide in ((OUTLINE, 4), (PICKED, 2)):
            for arm in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                line(middle + 4 * np.array(arm), middle + 12 * np.array(arm), color, wide)
    return np.asarray(image)
