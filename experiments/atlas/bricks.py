"""Where do bricks of a toroidal scan fail? Where rays come back to a brick that they have left."""

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.bricks import BrickGrid, overlap_of

from .entry import Entry


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


def by_bricks(depth: float, size: int, method: str) -> jv.Rendering:
    how = {"bricks": BRICKS, "method": method, "outputs": "rgba"}
    return jv.render_bricks(volume(), fog(depth), view(size), jv.March(STEP, (PROBE,)), **how)


def error(found: jv.Rendering, truth: np.ndarray) -> float:
    return float(np.abs(np.asarray(found.rgba) - truth).max())


def ordered(depth: float, size: int) -> dict[str, float]:
    truth = whole(depth, size)
    return {method: error(by_bricks(depth, size, method), truth) for method in ("naive", "overlap")}


def ordered_picture(depth: float, size: int) -> np.ndarray:
    rgba = np.asarray(by_bricks(depth, size, "naive").rgba, np.float64)
    return np.clip(rgba[..., :3], 0, 1)


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
    does='A ray that leaves a brick and comes back passes another one between. Under method="naive" both '
    "parts of it in the first brick are blended at once, and what lies between them after or before both. "
    '"overlap" and "reload" keep the order of the samples, and their error is that of rounding.',
    picture=ordered_picture,
    shows='a scan that is red near the probe (below) and blue far from it, under method="naive"',
    size=SIZE,
)


BANDS = (0.9, 0.15, 0.1), (0.95, 0.75, 0.1), (0.1, 0.6, 0.3), (0.15, 0.3, 0.9)
"""Colours of a scan from the probe outward, each of equally many samples."""
DENSE = 2.0
"""Optical depth of `ACROSS`."""
FARTHEST = 460.0
"""Length of a ray, mm: past the scan."""


def above(size: int) -> jv.Camera:
    """From beside the fan and beyond its end: the bricks that lie farther from the probe come first."""
    return jv.Camera((300, 10, 145), (0, 0, 45), (0, 0, 1), size=(size, size), parallel_scale=ACROSS / 2)


@cache
def met(size: int) -> tuple[np.ndarray, np.ndarray]:
    """γ of each sample of each ray, in voxels, and whether it lies in the scan, (rows, columns, samples)."""
    view, space = above(size), jv.March(STEP, (PROBE,)).locate(volume())
    depths = jnp.arange(0, FARTHEST, STEP)

    def ray(column: jax.Array, row: jax.Array) -> jax.Array:
        path = space.path(*view.ray(column, row))
        return jax.vmap(lambda depth: jnp.stack(path(depth)))(depths)

    pixels = jnp.meshgrid(*(jnp.arange(size, dtype=jnp.float32),) * 2)
    found = np.asarray(jax.jit(jax.vmap(jax.vmap(ray)))(*pixels), np.float64)
    return found[..., 2], np.all((found >= 0) & (found <= np.array(SHAPE) - 1), axis=-1)


def turns(size: int, part: float) -> np.ndarray:
    """In which brick's turn each sample is taken, if farther bricks reach over the nearer ones by this part
    of K*: that of the first one in which it lies, or in whose overlap on the way from there."""
    gamma, inside = met(size)
    grid = BrickGrid(SHAPE, (SHAPE[0] - 1, SHAPE[1] - 1, -(-(SHAPE[2] - 1) // BRICKS[2])))
    needed, space = overlap_of(PROBE, grid), jv.March(STEP, (PROBE,)).locate(volume())
    turn = np.full(gamma.shape, grid.number)
    for number, brick in enumerate(grid.order(space, above(size))):
        (_, _, low), (_, _, high) = grid.cells(brick)
        free = inside & (turn == grid.number)
        own = free & (gamma >= low) & (gamma <= high)
        reached = free & (gamma >= low - (part * needed[brick - 1] if brick else 0)) & (gamma <= high)
        # stretches of a ray in the brick or its overlap, and which of them hold samples of the brick itself
        stretch = np.cumsum(np.diff(reached, axis=-1, prepend=False), axis=-1)
        stretch += (stretch.shape[-1] + 1) * np.arange(stretch[..., 0].size).reshape(*stretch.shape[:-1], 1)
        known = np.zeros(stretch.max() + 1, bool)
        known[stretch[own]] = True
        turn[reached & known[stretch]] = number
    return turn


def overlapped_image(part: float | None, size: int) -> np.ndarray:
    """Colour over black of the scan, with samples blended brick by brick; or as they lie, for None."""
    gamma, inside = met(size)
    value = np.linspace(0, len(BANDS), SHAPE[2])[np.clip(np.rint(gamma), 0, SHAPE[2] - 1).astype(int)]
    color = np.array(BANDS)[np.minimum(value.astype(int), len(BANDS) - 1)]
    alpha = np.where(inside, -math.expm1(-DENSE / ACROSS * STEP), 0.0)
    if part is not None:
        order = np.argsort(turns(size, part), axis=-1, kind="stable")
        alpha, color = np.take_along_axis(alpha, order, -1), np.take_along_axis(color, order[..., None], -2)
    passed = np.cumprod(1 - alpha, axis=-1) / (1 - alpha)
    return np.sum((alpha * passed)[..., None] * color, axis=-2)


def overlapped(part: float, size: int) -> dict[str, float]:
    truth = overlapped_image(None, size)
    off = np.abs(overlapped_image(part, size) - truth).max(axis=-1)
    return {"largest": float(off.max()), "share of pixels off by > 1/255": float(np.mean(off > LEVEL))}


def overlapped_picture(part: float, size: int) -> np.ndarray:
    return np.clip(overlapped_image(part, size), 0, 1)


OVERLAP = Entry(
    name="overlap under K",
    question="By how much may bricks of a scan overlap less than the paper's K* before their image is wrong?",
    method="jaxvol.bricks.overlap_of",
    regime="overlap, in parts of K*",
    values=(1.5, 1.25, 1.0, 0.9, 0.8, 0.6, 0.4, 0.2, 0.0),
    measure=overlapped,
    metric="largest error of a pixel; share of pixels",
    judged="largest",
    limit=LEVEL,
    outcome="bounded",
    does="A ray that dips below the curved face of a brick by more than the overlap is taken behind it in the "
    "next brick's turn, after what it shows where it comes back. K* is how far rays between the brick's sides "
    "can dip, and enough. Images do not rest on it: render_bricks finds from its rays how far each brick is "
    "read, and reads a brick again where that does not fit into memory.",
    picture=overlapped_picture,
    shows="a scan in bands of four colours, from beside and beyond: its bricks blended one after the other",
    pictured=(1.0, 0.0),
    scales=("linear", "symlog"),
    size=SIZE,
)


ENTRIES = (ORDER, OVERLAP)
