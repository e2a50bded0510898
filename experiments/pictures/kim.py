"""Kim, Kwon and Shin 2008: the order of bricks (Fig. 6), and a scan whose bricks are blended in a wrong one
(Fig. 8)."""

import math
from argparse import Namespace
from typing import Any, NamedTuple

import numpy as np

import jaxvol as jv

from ..bricks import camera, each_at_once, grid, marching, phantom, probe
from ..bricks_once import FORMULA, EachOnce, extensions
from . import BLACK, Panels, panel


WATER, FLESH, SKIN, BONE = (0.06, 0.22, 0.5), (0.8, 0.1, 0.05), (1.0, 0.8, 0.6), (1.0, 1.0, 0.9)
POINTS = [
    *((12, WATER, 0.0), (24, WATER, 0.025), (40, WATER, 0.025)),
    *((55, FLESH, 0.08), (85, FLESH, 0.08)),
    *((105, SKIN, 0.15), (135, SKIN, 0.15)),
    *((150, BONE, 0.9), (170, BONE, 0.9)),
]
"""A transfer function in which fluid is transparent, and all but bone translucent."""
BESIDE = (-220.0, -200.0, 40.0)
"""Of the camera, beside the head, mm: rays pass curved faces at small angles, and the fetus in between."""
SPLIT = 1, 1, 4


def kim_fig8(chosen: Namespace) -> Panels:
    """A fetus in translucent tissue, cut into bricks along the beams: in a wrong order, each brick once as
    published, and in the right order; then the differences of the first two from the third. Below, along the
    fan."""
    volume, scan = phantom(chosen.resolution, "uint8", speckle=False)
    march = marching(scan, volume)
    scene = volume, jv.TransferFunction.from_points(POINTS)
    beside = jv.Camera(BESIDE, (0, 0, 100), (0, 0, 1), 19.0, size=(chosen.size,) * 2)
    once = EachOnce(extensions(scan, grid(volume.shape, SPLIT), SPLIT)[FORMULA])
    orders: dict[str, Any] = {
        "wrong order: no overlap": each_at_once,
        "as published: each once, with K*": once,
        "right order: overlap": "overlap",
    }
    rows: Panels = []
    for view in (beside, camera("along", chosen.size)):
        images, row = [], []
        for title, method in orders.items():
            how: dict[str, Any] = {"bricks": SPLIT, "method": method, "outputs": "rgba"}
            rendering = jv.render_bricks(*scene, view, march, **how)
            images.append(np.asarray(rendering.image(BLACK)))
            assert rendering.bricks is not None
            loads = f"{rendering.bricks.loads} bricks read"
            row.append(panel(images[-1], loads, "" if rows else title))
        for title, image in zip(
            ("difference, wrong order", "difference, as published"), images, strict=False
        ):
            off = np.abs(image - images[-1])
            caption = (
                f"largest {off.max():.2f}\n{np.mean(off.max(-1) > 1 / 255):.1%} of the pixels by > 1/255"
            )
            row.append(panel(off, caption, "" if rows else title))
        rows.append(row)
    return rows


SHAPE = 41, 21, 61
EYE = 0.0, -820.0, 533.0
"""Of the camera, mm; the plane of the figure is x = 0."""


class Order(NamedTuple):
    """Bricks in the plane of the motor's turn, in the order in which they are rendered: their edges and the
    middles of these, (y, z); the camera; and three points of a curved face, with a ray through it."""

    edges: list[np.ndarray]
    middles: list[np.ndarray]
    eye: np.ndarray
    chord: np.ndarray
    ray: np.ndarray


def order_of_bricks() -> Order:
    """Of the paper's scan, cut into six."""
    scan, bricks = probe(), grid(SHAPE, (2, 1, 3))
    space = jv.March(1.0, (scan,)).locate(jv.Volume(np.zeros(SHAPE, np.uint8)))
    seen = jv.Camera(EYE, (0, 0, EYE[2]), (0, 0, 1), 60.0, size=(8, 8))
    ends = np.asarray([scan.beta_range, scan.sigma_range, scan.gamma_range], float)

    def plane(points: Any) -> np.ndarray:
        return np.asarray(scan.to_world(np.asarray(points)))[..., 1:]

    edges, middles = [], []
    for brick in bricks.order(space, seen):
        low, high = (
            ends[:, 0] + np.asarray(n) / (np.asarray(SHAPE) - 1) * (ends[:, 1] - ends[:, 0])
            for n in bricks.cells(brick)
        )
        edges.append(plane(outline(low[[0, 2]], high[[0, 2]])))
        middles.append(plane((low + high) / 2))
    # across the middle beam of the left bricks, a little below the farther face between two of them
    beta, gamma = (low + part * (high - low) for (low, high), part in ((ends[0], 0.25), (ends[2], 2 / 3)))
    turn = (ends[0, 1] - ends[0, 0]) / 4
    chord = plane([(beta + side * turn, math.pi / 2, gamma) for side in (-1, 0, 1)])
    eye = np.array(EYE[1:])
    return Order(edges, middles, eye, chord, np.stack([eye, eye + 2.1 * (0.985 * chord[1] - eye)]))


def outline(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(points, 3): the edge of a part of the plane, from its ends in (β, γ)."""
    line = np.linspace(0, 1, 40)
    beta = np.concatenate([low[0] + line * (high[0] - low[0]), np.full(40, high[0])])
    beta = np.concatenate([beta, low[0] + high[0] - beta])
    gamma = np.concatenate([np.full(40, low[1]), low[1] + line * (high[1] - low[1])])
    gamma = np.concatenate([gamma, low[1] + high[1] - gamma])
    return np.stack([beta, np.full_like(beta, math.pi / 2), gamma], axis=-1)
