"""What does the paper print of bricks of an ultrasound scan, and what does its formula give? Table 1 of Kim,
Kwon and Shin 2008, with its scan."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import jaxvol as jv
from jaxvol.bricks import BrickGrid, overlap_of


Split = tuple[int, int, int]
"""Bricks along β, σ and γ, the axes of data[β, σ, γ]."""

SHAPE = 325, 490, 1280
"""Voxels along β, σ and γ."""
A, B = 70.04, 338.11
"""Of the probe, mm."""
BETA, SIGMA = math.radians(57.29), math.radians(103.64)
"""Ranges of angles."""
PIXELS = 375
BEST = 2, 4, 2

NEAR, DEEP = 245.0, 349.0
"""Fitted, since the paper does not print the range of depths: distances, from the centre of curvature, of the
near end of the scan, and from there to its far end. They reproduce the column of overlap, if K in this unit
counts as a number of voxels. The unit is unexplained: DEEP is 1280 voxels."""


class Row(NamedTuple):
    """A row of the table.

    - `overlap`: in percent of the volume. `reload`, `proposed`: frames per second.
    """

    overlap: float
    reload: float
    proposed: float


TABLE: dict[Split, Row] = {
    (2, 2, 1): Row(0, 13.99, 13.97),
    (2, 1, 2): Row(7.58, 11.57, 1.30),
    (1, 2, 2): Row(2.03, 11.64, 13.27),
    (1, 1, 4): Row(30.23, 8.35, 0.63),
    (2, 2, 2): Row(2.03, 15.49, 16.61),
    (2, 2, 4): Row(7.97, 17.66, 0.99),
    (2, 4, 2): Row(0.63, 20.88, 22.87),
    (4, 2, 2): Row(2.03, 1.07, 1.05),
    (2, 2, 8): Row(20.78, 17.62, 1.10),
    (2, 8, 2): Row(0.63, 19.92, 21.46),
    (8, 2, 2): Row(2.03, 1.57, 1.50),
    (4, 4, 4): Row(2.11, 3.19, 2.73),
    (2, 8, 4): Row(2.58, 15.43, 17.93),
    (2, 32, 2): Row(0.63, 10.49, 11.77),
    (4, 4, 8): Row(5.47, 2.94, 3.02),
    (4, 4, 16): Row(12.89, 4.22, 1.98),
    (8, 8, 4): Row(0.70, 4.97, 3.92),
}
"""As printed, in the paper's order."""


def probe(scale: float = 1.0) -> jv.ToroidalMap:
    """The paper's probe, all lengths times `scale`. Its range of depths is to `b` as fitted."""
    beta, sigma = ((math.pi / 2 - angle / 2, math.pi / 2 + angle / 2) for angle in (BETA, SIGMA))
    return jv.ToroidalMap(A * scale, B * scale, beta, sigma, (0.0, B * scale * DEEP / NEAR))


def grid(shape: tuple[int, int, int], split: Split) -> BrickGrid:
    """Bricks as `render_bricks` makes them of so many along each axis."""
    x, y, z = (-(-(n - 1) // count) for n, count in zip(shape, split, strict=True))
    return BrickGrid(shape, (x, y, z))


def overlap(split: Split) -> float:
    """Overlap in percent by the paper's formula (`jaxvol.bricks.overlap_of`), in the unit in which it gives
    the printed column: to 0.1 in 12 of 17 rows, and to 0.4 in the others. K is taken at the near face of each
    brick but the last, which is that between two bricks if the scan began a brick nearer; both planes
    count from the same centre."""
    near, (beta, sigma) = NEAR - DEEP / split[2], (probe().beta_range, probe().sigma_range)
    if split[2] == 1:
        return 0.0
    scan = jv.ToroidalMap(0.0, near, beta, sigma, (0.0, DEEP))
    voxel = DEEP / (SHAPE[2] - 1)
    return share([k * voxel for k in overlap_of(scan, grid(SHAPE, split))], SHAPE[2])


def share(overlaps: Iterable[float], nodes: int) -> float:
    """The part of a volume of so many voxels along γ that is read twice, in percent: whole layers at each
    face."""
    return 100 * sum(map(math.ceil, overlaps)) / nodes
