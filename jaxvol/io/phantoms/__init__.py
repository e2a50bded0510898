"""Synthetic volumes, independent of the resolution: shapes are signed distances and textures waves, in world
units; edges are ramps of a fixed number of voxels."""

from collections.abc import Callable

import numpy as np

from ..._util.checks import integer
from ...scene.volume import Volume
from .bodies import draw_engine, draw_frog, draw_head
from .canvas import Canvas
from .shapes import Block
from .toroidal import toroidal_phantom as toroidal_phantom
from .tubes import colon_path as colon_path, draw_colon, draw_vessels


def _plane(x: Block, y: Block, z: Block) -> Block:
    return _logistic(((z + 1) / 2 - (0.25 + 0.35 * (x + 1) / 2)) / 0.004)


def _cut_block(x: Block, y: Block, z: Block) -> Block:
    return np.where(x < 0, 0.5 + 0.1 * np.sin(20 * (z + 1)), _plane(x, y, z))


def _logistic(x: Block) -> Block:
    from scipy.special import expit  # slow to import

    return expit(x)


FORMULAS: dict[str, Callable[[Block, Block, Block], Block]] = {
    "plane": _plane,
    "cut_block": _cut_block,
    "sphere": lambda x, y, z: _logistic((0.5 - np.sqrt(x * x + y * y + z * z)) / 0.008),
    "constant": lambda x, y, z: np.ones_like(x),
    "linear": lambda x, y, z: (x + 1) / 2,
    "gaussian": lambda x, y, z: np.exp((x * x + y * y + z * z) / (-2 * 0.3**2)),
}
"""Values at world points x, y, z (an open mesh) of phantoms whose images are known in closed form."""

DRAWN: dict[str, Callable[[Canvas, np.random.Generator], np.ndarray | None]] = {
    "head": draw_head,
    "engine": draw_engine,
    "colon": draw_colon,
    "vessels": draw_vessels,
    "labels": draw_frog,
}
"""Functions that paint a canvas and return labels or None."""

PHANTOMS = (*DRAWN, *FORMULAS)


def phantom(name: str, resolution: int = 128, *, seed: int = 0) -> Volume:
    """Make a synthetic volume on the cube [-1, 1]³, with `resolution` nodes along each axis.

    The value at a world point does not depend on the resolution, except at boundaries of the uint8 phantoms,
    which are ramps 2 voxels wide (in `labels`, 0.06 world units at every resolution). `u` below is
    (world + 1) / 2, in the unit cube.

    | name | type | content |
    |---|---|---|
    | `head` | uint8 | CT-like head, face towards -y, crown towards +z; the -z face cuts the neck. Air 0, \
    skin 78, muscle 100, brain and cord 105 to 130, bone 185 to 225, teeth 255 |
    | `engine` | uint8 | three-cylinder engine, crankshaft along x, cut open towards -y: pipes 90, cast \
    block 150, steel parts 240 |
    | `colon` | uint8 | winding tube with folds and polyps along `colon_path`: lumen and outside 0, tissue \
    180, wall 220 |
    | `vessels` | uint8 | branching tubes (230 on 0) from a root at the -z face, radii 0.12 to 0.02 |
    | `labels` | uint8 | frog facing -y, with organs, soft-edged, and `labels`: 0 outside, 1 body, 2 and 3 \
    lungs (right, left), 4 liver, 5 stomach; organs that touch share a curved face |
    | `plane` | float32 | 1 / (1 + exp(-(u_z - h) / 0.004)) with h = 0.25 + 0.35 u_x; seen along +z |
    | `cut_block` | float32 | 0.5 + 0.1 sin(40 u_z) for u_x < 0.5, cut by the box's faces; else `plane` |
    | `sphere` | float32 | 1 / (1 + exp((r - 0.5) / 0.008)) |
    | `constant`, `linear`, `gaussian` | float32 | 1; (x + 1) / 2; exp(-r² / (2 · 0.3²)) |

    Args:
        name: of the table.
        resolution: nodes along each axis, at least 8.
        seed: of the textures of `head` and `colon`, polyps and folds of `colon`, and the tree of `vessels`.

    Returns:
        The `Volume`, with labels for the phantom `labels`.

    Raises:
        ValueError: for an unknown name, and for numbers that are too small or not integers.
    """
    if name not in PHANTOMS:
        raise ValueError(f"name must be one of {', '.join(PHANTOMS)}; got {name!r}.")
    resolution = integer("resolution", resolution, 8)
    rng = np.random.default_rng(integer("seed", seed, 0))
    canvas, labels = Canvas(resolution), None
    if name in DRAWN:
        labels = DRAWN[name](canvas, rng)
    else:
        for index, points in canvas.slabs():
            canvas.values[index] = FORMULAS[name](*points)
    data = canvas.as_uint8() if name in DRAWN else canvas.values
    return Volume(data, spacing=(canvas.spacing,) * 3, origin=(-1.0, -1.0, -1.0), labels=labels)
