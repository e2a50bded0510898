"""Where do bricks of a toroidal scan fail? Where rays come back to a brick that they have left."""

import math
from functools import cache

import numpy as np

import jaxvol as jv

from .entry import Entry, signed


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


def by_bricks(depth: float, size: int, method: str, memory: int | None = None) -> jv.Rendering:
    how = {"bricks": BRICKS, "method": method, "memory": memory, "outputs": "rgba"}
    return jv.render_bricks(volume(), fog(depth), view(size), jv.March(STEP, (PROBE,)), **how)


def error(found: jv.Rendering, truth: np.ndarray) -> float:
    return float(np.abs(np.asarray(found.rgba) - truth).max())


# -- the order of a ray's samples -------------------------------------------------------------------------


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


# -- less overlap than rays need --------------------------------------------------------------------------

FOG = 1.0
"""Optical depth at which a wrong order shows most."""


@cache
def ample(size: int) -> int:
    """Bytes that bricks take with as much overlap as the rays of this view need."""
    report = by_bricks(FOG, size, "overlap").bricks
    assert report is not None
    return report.bytes_held


def short(part: float, size: int) -> dict[str, float]:
    """`part`: of the memory that bricks take with all their overlap."""
    found = by_bricks(FOG, size, "overlap", max(1, int(part * ample(size))))
    report = found.bricks
    assert report is not None
    return {"error": error(found, whole(FOG, size)), "bricks read again": float(report.reloads)}


def short_picture(part: float, size: int) -> np.ndarray:
    found = by_bricks(FOG, size, "overlap", max(1, int(part * ample(size))))
    return signed((np.asarray(found.rgba, np.float64) - whole(FOG, size))[..., :3], LEVEL)


SHORT = Entry(
    name="overlap under k",
    question="What happens where memory leaves bricks less overlap than rays that come back need?",
    method="jaxvol.render_bricks",
    regime="memory over that of bricks with all their overlap",
    values=(1.0, 0.8, 0.6, 0.4, 0.0),
    measure=short,
    metric="largest error of a pixel; number of bricks read again",
    judged="error",
    limit=2e-5,
    outcome="bounded",
    does="A brick that would not fit with its overlap is read without it, and again for the rays that come "
    "back: more reads, the same image. Bricks have at least the paper's K, whatever memory there is.",
    picture=short_picture,
    shows="error of the image, ± 1 / 255 from blue to red",
    scales=("linear", "symlog"),
    size=SIZE,
)

ENTRIES = (ORDER, SHORT)
