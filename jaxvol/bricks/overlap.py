"""By how much must bricks of a toroidal grid overlap, so that each is needed once?

The faces of a brick across γ are curved in the world. A ray may enter a brick, pass through the one that lies
nearer to the probe, and come back. If the farther one reaches over the cap between the curved face and its
chord, it need not be rendered again. The height of the cap is K = l - l cos(θ / 2), where l is the distance
of the face from the centre of its curvature, and θ the angle under which it sees the brick: in the plane of
the fan l = b + γ and θ the part of the range of σ, and about the motor's axis l = a + b + γ and θ that of β.
The larger of the two counts.

Source: Kim, Kwon and Shin 2008, section 3.2.
"""

import math

import numpy as np

from ..march.transforms import ToroidalMap
from .grid import BrickGrid, Node


def heights(a: float, b: float, ranges: np.ndarray, grid: BrickGrid) -> list[float]:
    """K* of each face between two bricks along γ, in voxels, from the probe outward. `ranges`: (first, last)
    of β, σ and γ."""
    (beta, sigma, gamma), cells = np.diff(ranges, axis=1)[:, 0], [n - 1 for n in grid.shape]
    parts = [size / n for size, n in zip(grid.size, cells, strict=True)]
    found = []
    for face in range(1, grid.counts[2]):
        at = ranges[2][0] + face * parts[2] * gamma
        fan = (b + at) * (1 - math.cos(sigma * parts[1] / 2))
        turn = (a + b + at) * (1 - math.cos(beta * parts[0] / 2))
        found.append(max(fan, turn, 0.0) * cells[2] / gamma)
    return found


def overlap_of(probe: ToroidalMap, grid: BrickGrid) -> list[float]:
    """By how much bricks must overlap at their curved faces along γ, so that each ray meets each brick once.

    At a face at the distance l from the apex, K = l - l cos(θ/2), where θ is the angle of a brick's fan;
    along the sweep, l is measured from the motor axis, and θ is the angle of its sweep. The larger counts.
    It suffices where the brick beyond a face has its turn before the one within, and rays from side to side
    of a brick need all of it: with less, they are blended in the wrong order. The images of `render_bricks`
    do not rest on it: how far each brick is read is found from the rays.

    **Arguments:** `probe`: of the volume. `grid`: how it is divided into bricks.

    **Returns:** K* of each face between two bricks, from the probe outwards, voxels.

    Source: Kim, Kwon and Shin 2008, section 3.2.
    """
    ranges = np.array(
        [np.asarray(r, float) for r in (probe.beta_range, probe.sigma_range, probe.gamma_range)]
    )
    return heights(float(probe.a), float(probe.b), ranges, grid)


def share(found: list[float], nodes: int) -> float:
    """What the overlap adds to a volume: whole layers at each face.

    **Arguments:** `found`: the overlap of each face, from `overlap_of`. `nodes`: of the volume along γ.

    **Returns:** the part of the volume that is read twice.
    """
    return sum(math.ceil(k) for k in found) / nodes


def most(probe: ToroidalMap | None, grid: BrickGrid) -> Node:
    """Nodes along each axis by which a brick may be larger, for any of its faces; 0 without a probe."""
    found = [] if probe is None else overlap_of(probe, grid)
    return 0, 0, math.ceil(max(found, default=0.0))
