"""Marks over a viewer's image: the directions of the world's axes, and the picked point."""

import numpy as np
from PIL import Image, ImageDraw

from .state import State
from .tiles import Pixels


MIN_SIDE = 120  # pixels of the smaller side of a view with marks
LENGTH, MARGIN = 30, 44  # pixels of an axis, and from its foot to the edges
AXES = (("x", (214, 48, 49)), ("y", (30, 150, 60)), ("z", (40, 90, 220)))  # names and colours
PICKED, OUTLINE = (255, 214, 0), (40, 40, 40)


def with_marks(pixels: Pixels, state: State) -> Pixels:
    """An image with marks. It may have fewer pixels than the view over which it is stretched."""
    (width, height), orbit = state.size, state.orbit
    if min(width, height) < MIN_SIDE:
        return pixels
    image = Image.fromarray(pixels)
    drawing, scale = ImageDraw.Draw(image), np.array(image.size) / state.size
    right, up, forward = orbit.axes()
    foot = np.array([MARGIN, height - MARGIN])
    for axis in np.argsort(-forward):  # from back to front
        name, color = AXES[axis]
        direction = np.array([right[axis], -up[axis]])
        tip, length = foot + LENGTH * direction, np.linalg.norm(direction)
        drawing.line([*(scale * foot), *(scale * tip)], color, max(1, round(3 * scale.min())))
        if length > 0.2:
            place = tuple(scale * (tip + 9 * direction / length))
            drawing.text(place, name, color, anchor="mm", font_size=max(7, 14 * scale.min()))
    if state.point is not None:
        offset = state.point - orbit.position
        depth = orbit.distance if state.parallel else offset @ forward
        if depth > 0:
            unit = orbit.half_height * depth / orbit.distance * 2 / height  # world length of a pixel there
            middle = np.array([width, height]) / 2 + np.array([offset @ right, -(offset @ up)]) / unit
            for color, radius in ((OUTLINE, 9), (PICKED, 8), (PICKED, 7), (OUTLINE, 6)):
                drawing.ellipse([*(scale * (middle - radius)), *(scale * (middle + radius))], outline=color)
    return np.asarray(image)
