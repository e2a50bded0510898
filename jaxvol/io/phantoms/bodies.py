"""Phantoms `head`, `labels` (a frog with organs) and `engine`, of the shapes in `parts.json`. Head and frog
face -y; the head's crown and the frog's back point to +z. 1 world unit of the head is about 14 cm."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from .canvas import Canvas, plane_waves
from .shapes import Block, Shape, ellipsoid, shapes_of


SOFT = 0.06  # width of the ramp between intensities of the frog, world units


@cache
def parts() -> dict[str, list[Any]]:
    """Parts of phantoms, as lists whose first entries are (a name may follow): for fields, "join" or "carve",
    blend distance, shapes (`shapes_of`); for `painted` and `spheres`, value, shapes; for `organs`, label,
    value, shape; for fetus and wires, shapes."""
    return json.loads(Path(__file__).with_name("parts.json").read_text("utf-8"))


def field_of(canvas: Canvas, name: str) -> Canvas:
    """Field of the parts `name`, at the nodes of a canvas."""

    def build(field: Canvas) -> None:
        for operation, blend, shapes, *_ in parts()[name]:
            (field.join if operation == "join" else field.carve)(shapes_of(shapes), blend)

    return canvas.field(build)


def draw_head(canvas: Canvas, rng: np.random.Generator) -> None:
    tissue, folds = plane_waves(rng, 0.12, 0.5), plane_waves(rng, 0.13, 0.2)
    skin = field_of(canvas, "skin")
    canvas.paint(lambda x, y, z, d: 78 + (22 + 4 * tissue(x, y, z)) * np.clip(-1 - d / 0.02, 0, 1), skin)
    canvas.paint(lambda x, y, z, d: 205 + 8 * tissue(x, y, z), field_of(canvas, "bones"))

    # two dense tables with the diploë between them
    middle = ellipsoid((0, 0.08, 0.30), (0.46, 0.60, 0.52)).distance
    vault = Shape(
        lambda x, y, z: np.maximum(abs(middle(x, y, z)) - 0.017, 0.2 - 0.25 * y - z),
        (-0.5, -0.6, 0),
        (0.5, 0.8, 0.9),
    )
    canvas.paint(lambda x, y, z, d: 222 - 36 * np.exp(-((middle(x, y, z) / 0.012) ** 2)), vault)

    def brain(x: Block, y: Block, z: Block, d: Block) -> Block:
        # furrows follow the zeros of a wave, and narrow from the surface inwards; grey matter lines both
        wave, depth = folds(x, y, z), np.clip(-d / 0.17, 0, 1)
        furrow = np.exp(-((wave / 0.3) ** 2)) * np.clip(2 - 2.5 * depth, 0, 1)
        midline = np.exp(-((x / 0.016) ** 2)) * np.clip((z - 0.2) / 0.1, 0, 1)
        lining = np.exp(-((wave / 0.75) ** 2)) * np.clip(2 - 2 * depth, 0, 1)
        grey = np.maximum(lining, np.clip(1.5 + d / 0.035, 0, 1))
        return 112 + 15 * grey + 2 * tissue(x, y, z) - 26 * np.maximum(furrow, midline)

    canvas.paint(brain, field_of(canvas, "brain"))
    for value, shapes, *_ in parts()["painted"]:
        for shape in shapes_of(shapes):
            canvas.paint(value, shape)


def draw_frog(canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    body = field_of(canvas, "frog")
    canvas.paint(120, body, SOFT)
    labels = (body.values < 0).astype(np.uint8)
    deepest = np.zeros_like(body.values)
    for label, value, shape, *_ in parts()["organs"]:
        (organ,) = shapes_of([shape])
        canvas.paint(value, organ, SOFT)
        for index, points in canvas.slabs(organ.low, organ.high):
            # a node belongs to the organ it is deepest in, so overlapping organs meet in a smooth face
            distance = organ.distance(*points)
            nearer = distance < deepest[index]
            np.copyto(labels[index], label, where=nearer)
            np.copyto(deepest[index], distance, where=nearer)
    return labels


def draw_engine(canvas: Canvas, rng: np.random.Generator) -> None:
    for value, name in ((90, "pipes"), (150, "cast"), (240, "steel")):  # later ones cover earlier ones
        canvas.paint(value, field_of(canvas, name))
