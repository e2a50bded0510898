"""Where do bricks of a toroidal scan fail? Where rays come back to a brick that they have left."""

import math
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.bricks import BrickGrid, overlap_of
from jaxvol.scene.space import enter

from ..naive_bricks import each_at_once
from .entry import Entry, colors


SHAPE = 24, 32, 48
BRICKS = 1, 1, 3
STEP = 1.5
LEVEL = 1 / 255
RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
SIZE, ACROSS = 24, 90.0
"""Pixels along a side, and mm across the image."""


def _about(half: float) -> tuple[float, float]:
    return math.pi / 2 - half, math.pi / 2 + half


PROBE = jv.ToroidalMap(10.0, 20.0, _about(0.6), _about(0.9), (0.0, 60.0))


@cache
def volume() -> jv.Volume:
    """Values grow with the depth."""
    return jv.Volume(np.broadcast_to(np.linspace(20, 250, SHAPE[2]), SHAPE).astype(np.uint8))


def fog(depth: float) -> jv.TransferFunction:
    """Red near the probe and blue far from it; `depth`: optical depth of `ACROSS`."""
    extinction = np.full(4, depth / ACROSS, np.float32)
    return jv.TransferFunction([0, 120, 135, 255], [RED, RED, BLUE, BLUE], extinction)


def view(size: int) -> jv.Camera:
    """Along the fan: rays pass the curved faces at small angles, and most of them twice."""
    return jv.Camera((300, 10, 45), (0, 0, 45), (0, 0, 1), size=(size, size), parallel_scale=ACROSS / 2)


def whole(depth: float, size: int) -> np.ndarray:
    march = jv.March(STEP, (PROBE,))
    how = {"outputs": "rgba", "adjoint": "forward"}
    return np.asarray(jv.render(volume(), fog(depth), view(size), march, **how).rgba, np.float64)


METHODS: dict[str, Any] = {"naive": each_at_once, "overlap": "overlap"}


def by_bricks(depth: float, size: int, method: str) -> jv.Rendering:
    how = {"bricks": BRICKS, "method": METHODS[method], "outputs": "rgba"}
    return jv.render_bricks(volume(), fog(depth), view(size), jv.March(STEP, (PROBE,)), **how)


def error(found: jv.Rendering, truth: np.ndarray) -> float:
    return float(np.abs(np.asarray(found.rgba) - truth).max())


def ordered(depth: float, size: int) -> dict[str, float]:
    truth = whole(depth, size)
    return {method: error(by_bricks(depth, size, method), truth) for method in METHODS}


ORDER = Entry(
    name="wrong order",
    question="From which optical depth on does it show that each brick of a scan is shown at once?",
    method="jaxvol.render_bricks",
    regime="optical depth of the scan",
    values=(0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
    measure=ordered,
    metric="largest error of a pixel",
    judged="naive",
    limit=LEVEL,
    outcome="documented",
    does="A ray that leaves a brick and comes back passes another one between. Shown at once (naive), both "
    "parts of it in the first brick are blended at once, and what lies between them after or before both. "
    '"overlap" and "reload" keep the order of the samples, and their error is that of rounding.',
    picture=lambda depth, size: np.asarray(by_bricks(depth, size, "naive").rgba)[..., :3],
    shows="a scan that is red near the probe (below) and blue far from it, each brick shown at once",
    size=SIZE,
)


# -- bricks that overlap by less than K* ------------------------------------------------------------------

FACE = 24
"""Node along γ at which the brick near the probe ends, and the one beyond it begins."""
FINE = 0.75
"""Step, mm."""


@cache
def hidden() -> jv.Volume:
    """1 in a wall in the middle of the fan; -1 in stripes in the brick beyond the face, which the wall hides
    from the camera."""
    beta, sigma, gamma = np.indices(SHAPE)
    wall, stripes = abs(sigma - 16) < 2, (beta // 3 % 2 == 0) & (sigma < 10) & (gamma >= FACE)
    return jv.Volume((wall.astype(np.float32) - stripes).astype(np.float32))


PALE = (0.3, 0.45, 0.7)
PAINT = jv.TransferFunction([-0.8, -0.2, 0.2, 0.8], [RED, RED, PALE, PALE], [2.0, 0.0, 0.0, 2.0])
"""1/mm, so that stripes and wall are opaque."""


def across(size: int) -> jv.Camera:
    """From one side of the fan to the other, so little from beyond it that rays dip as far as they can below
    the face, and that the brick beyond the face has the first turn."""
    return jv.Camera((300, 2, 60), (0, 0, 57), (0, 0, 1), size=(size, size), parallel_scale=54)


class Samples(NamedTuple):
    """Of an image: γ in voxels, whether it is inside the scan, opacity, and colour, (rows, columns, samples)
    each; the colour with three numbers more."""

    gamma: np.ndarray
    inside: np.ndarray
    alpha: np.ndarray
    color: np.ndarray


@cache
def samples(size: int) -> Samples:
    """All samples of each ray, as it meets them one after the other."""
    space, view = jv.March(FINE, (PROBE,)).locate(hidden()), across(size)
    classification = PAINT.classification(hidden())
    depths = jnp.arange(0, float(space.diagonal), FINE)

    def ray(column: jax.Array, row: jax.Array) -> Any:
        line = enter(space, *view.ray(column, row), (column, row))

        def sample(depth: jax.Array) -> Any:
            at = line.path(depth)
            color, extinction = classification.classify(classification.at(at))
            return at[2], line.contains(depth), -jnp.expm1(-extinction * FINE), jnp.stack(color)

        return jax.vmap(sample)(depths)

    pixels = jnp.meshgrid(*(jnp.arange(size),) * 2)
    gamma, inside, alpha, color = map(np.asarray, jax.jit(jax.vmap(jax.vmap(ray)))(*pixels))
    return Samples(gamma, inside, np.where(inside, alpha, 0).astype(np.float64), color)


def taken_first(part: float, size: int) -> np.ndarray:
    """Which samples are taken in the turn of the brick beyond the face: its own, and next to these on a ray
    the samples of the other brick that lie below the face by no more than this part of K*."""
    gamma, inside, *_ = samples(size)
    grid = BrickGrid(SHAPE, (SHAPE[0] - 1, SHAPE[1] - 1, FACE))
    assert grid.order(jv.March(FINE, (PROBE,)).locate(hidden()), across(size)) == [1, 0]
    (needed,) = overlap_of(PROBE, grid)
    own, reached = inside & (gamma >= FACE), inside & (gamma >= FACE - part * needed)
    # each stretch of a ray within reach has a number; those are taken that hold samples of the brick's own
    stretch = np.cumsum(np.diff(reached, axis=-1, prepend=False), axis=-1)
    stretch += (stretch.max() + 1) * np.arange(size * size).reshape(size, size, 1)
    return reached & np.isin(stretch, stretch[own])


def overlapped_image(part: float, size: int) -> np.ndarray:
    """Colour over black where all that is taken first is blended before all else."""
    _, _, alpha, color = samples(size)
    order = np.argsort(~taken_first(part, size), axis=-1, kind="stable")
    alpha, color = np.take_along_axis(alpha, order, -1), np.take_along_axis(color, order[..., None], -2)
    passed = np.cumprod(1 - alpha, axis=-1) / (1 - alpha)
    return np.sum((alpha * passed)[..., None] * color, axis=-2)


def overlapped(part: float, size: int) -> dict[str, float]:
    truth = colors(hidden(), PAINT, across(size), jv.March(FINE, (PROBE,)))
    off = np.abs(overlapped_image(part, size) - truth).max(axis=-1)
    return {"largest": float(off.max()), "share of pixels off by > 1/255": float(np.mean(off > LEVEL))}


OVERLAP = Entry(
    name="overlap under k",
    question="By how much may bricks of a scan overlap less than the paper's K* before their image is wrong?",
    method="jaxvol.bricks.overlap_of",
    regime="overlap, in parts of K*",
    values=(1.25, 1.0, 0.9, 0.75, 0.5, 0.25, 0.0),
    measure=overlapped,
    metric="largest error of a pixel; share of pixels",
    judged="largest",
    limit=LEVEL,
    outcome="documented",
    does="A ray that dips below the curved face between two bricks by more than they overlap is blended in "
    "the wrong order: what it meets where it comes back stands before what it meets in the dip. K* is how "
    "far rays between the sides of a brick can dip, so that it suffices. The images of render_bricks do not "
    "rest on it: how far each brick is read is found from the rays.",
    picture=overlapped_image,
    shows="two bricks of a fan, blended one after the other; a wall in its middle hides red stripes that lie "
    "in the farther one",
    pictured=(1.0, 0.5),
    scales=("linear", "symlog"),
    size=48,
)


ENTRIES = (ORDER, OVERLAP)
