"""What do coarser levels of an octree save where rays skip empty blocks?

The KISTI report (2005) designs an octree, and does not get it to work. Counted per ray, in its scenes
(`kisti`) and without early ends: rays skip the coarsest block of an octree that is empty under the transfer
function. The finest level has blocks of 4³ voxels, as in `SpaceLeaping`, and each further one blocks of twice
that side. Levels leave the same samples; what they change is the number of skips, and of the blocks that are
looked up for them, from the coarsest level down or from the finest one up. What is visible is the same under
both of the report's transfer functions.
"""

from argparse import Namespace
from typing import Any

import numpy as np
from jaxtyping import Bool

import jaxvol as jv

from . import harness
from .harness import experiment
from .kisti import PHANTOMS, REAL
from .ray_leaps import Marcher


FINEST = 4
LEVELS = 1, 2, 3, 4, 5
DOWN, UP = "from the coarsest", "from the finest"


def levels_of(occupied: Bool[np.ndarray, "x y z"], number: int) -> list[tuple[int, np.ndarray]]:
    """Sides and occupied blocks of the levels of an octree, from the coarsest one down."""
    levels = []
    for side in FINEST * 2 ** np.arange(number)[::-1]:
        starts = [np.arange(0, n, side) for n in occupied.shape]
        blocks = occupied
        for axis, start in enumerate(starts):
            blocks = np.logical_or.reduceat(blocks, start, axis=axis)
        levels.append((int(side), blocks))
    return levels


def count(marcher: Marcher, camera: jv.Camera, number: int, order: str) -> dict[str, float]:
    """Skips, blocks looked up, and samples of a ray, in the mean, with so many levels."""
    entry, rate, steps = marcher.rays(camera)
    levels = levels_of(~marcher.empty, number)
    most = np.asarray(marcher.empty.shape) - 1
    index, alive = np.zeros_like(steps), np.flatnonzero(steps > 0)
    skips = looked_up = samples = 0
    while len(alive):
        place = entry[alive] + index[alive, None] * rate[alive]
        cell = np.clip(place.astype(int), 0, most)
        further, searched = np.ones(len(alive), int), np.ones(len(alive), bool)
        skipped = ~searched
        for side, blocks in levels if order == DOWN else levels[::-1]:
            looked_up += int(searched.sum())
            empty = searched & ~blocks[tuple((cell // side).T)]
            skipped |= empty
            low, way = cell[empty] // side * side, rate[alive[empty]]
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (np.where(way > 0, low + side, low) - place[empty]) / way
            ends = np.where(way == 0, np.inf, ends).min(axis=-1)
            further[empty] = np.maximum(np.ceil(ends), 1)
            searched &= ~empty if order == DOWN else empty
        skips += int(skipped.sum())
        samples += int((~skipped).sum())
        index[alive] += further
        alive = alive[index[alive] < steps[alive]]
    rays = int(np.sum(steps > 0))
    return {"skips": skips / rays, "blocks looked up": looked_up / rays, "samples": samples / rays}


@experiment(
    resolution=192,
    size=256,
    levels=LEVELS,
    quick={"size": 16, "resolution": 32, "levels": (1, 2)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    folder = harness.data()
    makers = PHANTOMS if folder is None or chosen.quick else REAL
    scenes: dict[str, Any] = {}
    for name, make in makers.items():
        scene = make(folder, chosen.size, chosen.resolution)
        marcher = Marcher(scene)
        steps = marcher.rays(scene.camera)[2]
        scenes[name] = {"all samples": float(np.mean(steps[steps > 0]))}
        for order in (DOWN, UP):
            counts = {str(number): count(marcher, scene.camera, number, order) for number in chosen.levels}
            scenes[name][order] = counts
    return {"finest block": FINEST, "scenes": scenes}
