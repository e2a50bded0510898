"""Kim, Kwon and Shin, Fig. 6: the order of bricks, by the depth of their centres.

The paper's scan cut into six bricks, in the plane of the motor's turn, and a camera beside it. The numbers
are the order in which `render_bricks` takes them; the lines lead from the camera to their centres.
The ray leaves a brick through its curved face and comes back to it (the paper's Fig. 4); the dashed chord of
that face is what K reaches to.
"""

import math
from argparse import Namespace

import numpy as np

import jaxvol as jv
from experiments.bricks_paper import probe
from experiments.command import QUICK, command
from experiments.common import plt, save
from jaxvol.bricks import BrickGrid

from .common import OUTPUT


SHAPE = 41, 21, 61
SPLIT = 2, 1, 3
EYE = 0.0, -820.0, 533.0
"""Of the camera, mm; the plane of the figure is x = 0."""


def outline(scan: jv.ToroidalMap, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(points, 2): y and z of the edge of a part of the plane, from its ends in (β, γ)."""
    line = np.linspace(0, 1, 40)
    beta = np.concatenate([low[0] + line * (high[0] - low[0]), np.full(40, high[0])])
    beta = np.concatenate([beta, low[0] + high[0] - beta])
    gamma = np.concatenate([np.full(40, low[1]), low[1] + line * (high[1] - low[1])])
    gamma = np.concatenate([gamma, low[1] + high[1] - gamma])
    points = np.stack([beta, np.full_like(beta, math.pi / 2), gamma], axis=-1)
    return np.asarray(scan.to_world(points))[:, 1:]


@command(__doc__, OUTPUT, quick=QUICK)
def main(chosen: Namespace) -> None:
    scan = probe()
    x, y, z = (-(-(n - 1) // count) for n, count in zip(SHAPE, SPLIT, strict=True))
    grid = BrickGrid(SHAPE, (x, y, z))
    march = jv.March(1.0, (scan,))
    space = march.locate(jv.Volume(np.zeros(SHAPE, np.uint8)))
    order = grid.order(space, jv.Camera(EYE, (0, 0, EYE[2]), (0, 0, 1), 60.0, size=(8, 8)))

    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    ends = np.asarray([scan.beta_range, scan.sigma_range, scan.gamma_range], float)
    nodes = np.asarray(SHAPE) - 1
    eye = np.array(EYE[1:])
    for turn, brick in enumerate(order, 1):
        low, high = (
            ends[:, 0] + np.asarray(n) / nodes * (ends[:, 1] - ends[:, 0]) for n in grid.cells(brick)
        )
        edge = outline(scan, low[[0, 2]], high[[0, 2]])
        axes.fill(*edge.T, facecolor=plt.get_cmap("Blues")(0.65 - 0.09 * turn), edgecolor="k", linewidth=1)
        middle = np.asarray(scan.to_world((low + high) / 2))[1:]
        axes.plot(*np.stack([eye, middle]).T, color="0.5", linewidth=0.7, linestyle=":")
        axes.plot(*middle, "k.", markersize=4)
        axes.annotate(
            str(turn), tuple(middle), (4, 4), textcoords="offset points", fontsize=13, weight="bold"
        )
    axes.plot(float(eye[0]), float(eye[1]), "ks", markersize=8)
    axes.annotate("camera", tuple(eye), (0, 9), textcoords="offset points", fontsize=9, ha="center")
    # across the middle beam of the left bricks, a little below the farther face between two of them
    beta, gamma = (low + part * (high - low) for (low, high), part in ((ends[0], 0.25), (ends[2], 2 / 3)))
    face = [(beta + turn * (ends[0, 1] - ends[0, 0]) / 4, math.pi / 2, gamma) for turn in (-1, 0, 1)]
    first, top, last = np.asarray(scan.to_world(face))[:, 1:]
    axes.plot(*np.stack([first, last]).T, "k--", linewidth=0.8)
    through = 0.985 * top
    end = eye + 2.1 * (through - eye)
    axes.plot(*np.stack([eye, end]).T, "C3-", linewidth=1.2)
    axes.annotate("ray", end, (4, 0), textcoords="offset points", color="C3", fontsize=9)
    axes.plot(0, 0, "k+", markersize=9)
    axes.annotate("motor axis", (0, 0), (6, -3), textcoords="offset points", fontsize=9)
    axes.set_aspect("equal")
    axes.set_xlabel("y, mm", fontsize=8)
    axes.set_ylabel("z, mm", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.set_title("Kim, Kwon and Shin, Fig. 6: bricks in the order of their centres' depth", fontsize=9)
    save(figure, chosen.output / "kim_fig6.webp")
    print(chosen.output / "kim_fig6.webp")


if __name__ == "__main__":
    main()
