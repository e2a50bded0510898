"""Where do bricks of a toroidal scan fail? Where rays come back to a brick that they have left."""

import math
from functools import cache
from typing import Any

import numpy as np

import jaxvol as jv

from ..bricks import each_at_once
from .entry import Entry


SHAPE = 24, 32, 48
BRICKS = 1, 1, 3
STEP = 1.5
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
    does="A ray that leaves a brick and comes back passes another one between. Shown at once (naive), both "
    "parts of it in the first brick are blended at once, and what lies between them after or before both. "
    '"overlap" and "reload" keep the order of the samples, and their error is that of rounding.',
    picture=lambda depth, size: np.asarray(by_bricks(depth, size, "naive").rgba)[..., :3],
    shows="a scan that is red near the probe (below) and blue far from it, each brick shown at once",
    size=SIZE,
)


ENTRIES = (ORDER,)
