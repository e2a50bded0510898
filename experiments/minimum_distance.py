"""What does a minimum-distance grid gain inside a cavity, and which pixels does it spoil, by cell size?

Chae and Shin, Figs. 5 and 6: a perspective camera inside a cavity, where rays run along walls and leaps by a
distance map are short. Measured are the distance map alone, starts taken from the corner rays of cells of R x
R pixels ("min_distance", as published), starts proven from the whole cell ("beam"), and empty stretches of
beams ("hierarchy"). Distances are those of blocks of 4³ voxels, found in every image; and, for the map and
the published starts, also those of voxels, found before, as the paper has them.

The published starts are not a bound, so each time comes with the share of pixels that differ from the march
without leaping by more than 1/255, and with the RMSE against a converged image. The paper reports 53 % less
time at R = 8, which is the goal (2.1 times the speed of the distance map of voxels), and distortion at R =
32.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped, UInt8
from scipy.ndimage import distance_transform_cdt

import jaxvol as jv
from jaxvol.march.march import EmptySpaceIndex, View
from jaxvol.scene.occupancy import FARTHEST, ROUNDING, Blocks, Occupancy

from . import charts, harness, timing
from .harness import chosen_scenes, experiment, frame, some_of
from .scenes import AIRWAY, OF_AIRWAY, Scene


NONE, MAP, HIERARCHY, VOXELS = "no leaping", "distance map", "hierarchy", "distance map of voxels"
PUBLISHED, PROVEN, OF_VOXELS = "min_distance", "beam", "min_distance, voxels"
LINES = (MAP, "k", "--"), (VOXELS, "C1", "--"), (HIERARCHY, "C2", "-."), (NONE, "C7", ":")
CELLS = (4, 8, 16, 32, 64)
GOAL = 2.1
LIMIT = 1 / 255  # largest difference of a correct pixel: one step of an 8-bit image
LEFT = 1 / 255
WALL = [
    (40, (0.05, 0.01, 0.01), 0.0),
    (90, (0.35, 0.08, 0.06), 0.25),
    (160, (0.90, 0.45, 0.35), 0.8),
    (220, (1.00, 0.85, 0.75), 0.95),
]


def colon(folder: Path | None, size: int, resolution: int = 256) -> Scene:
    """Folds, one behind the other; steps of a quarter voxel."""
    volume, path = jv.phantom("colon", resolution), jv.colon_path()
    camera = jv.Camera(path[340], path[352], (0, 1, 0.1), view_angle=90, size=(size, size))
    transfer = jv.TransferFunction.from_points(WALL, unit_distance=0.0125)
    return Scene(volume, transfer, camera, float(volume.spacing[0]) / 4)


def airway(folder: Path, size: int, resolution: int) -> Scene:
    """The trachea, down to where it divides; steps of a quarter voxel. The preset begins at -920 Hounsfield
    units, which the noise of air exceeds somewhere in most blocks; here it is moved up to begin at -724."""
    volume = jv.load(folder / AIRWAY, spacing=OF_AIRWAY)
    camera = jv.Camera((96, 76, 144), (90, 89, 112), (0, -1, 0), view_angle=90, size=(size, size))
    return Scene(volume, jv.preset("ct_airway", clim=(-800, 3000)), camera, 0.2)


PHANTOM = "colon phantom"
SCENES: dict[str, Callable[..., Scene]] = {"airway": airway, PHANTOM: colon}


class Measured(Occupancy):
    """Occupied cells, of which the distances are known."""

    distances: UInt8[Array, " cells"] = eqx.field(kw_only=True)

    def distance(self) -> UInt8[Array, " cells"]:
        return self.distances


class VoxelLeaping(jv.SpaceLeaping):
    """`SpaceLeaping` by distances of voxels: under `"distance"` as they are, under `"min_distance"` from
    starts found with them. Only for the volume and the transfer function that the `grid` is of: the image of
    others would be wrong."""

    grid: Measured

    def __init__(self, grid: Measured, method: Any = "distance", cell: int = 8):
        super().__init__(method, cell)
        self.grid = grid

    def empty_space(self, occupancy: Occupancy, view: View | None) -> EmptySpaceIndex:
        return super().empty_space(self.grid, view)


def distances(volume: jv.Volume, transfer: jv.TransferFunction) -> Measured:
    """Chessboard distance from each cell between voxels to the nearest in which anything may be visible."""
    data = np.asarray(volume.data, np.float32)
    low, high = over_corners(data, np.minimum), over_corners(data, np.maximum)
    slack = ROUNDING * np.maximum(abs(low), abs(high))
    ranges = Blocks(jnp.asarray(low - slack), jnp.asarray(high + slack), None)
    visible = np.asarray(transfer.visible(ranges))
    away = np.full(visible.shape, FARTHEST)
    if visible.any():
        found = np.asarray(distance_transform_cdt(~visible, metric="chessboard"))
        away = np.minimum(found, FARTHEST - 1)
    corner, size = (tuple(of) for of in (volume.origin, volume.spacing))
    return Measured(jnp.asarray(visible), corner, size, distances=jnp.asarray(away.astype(np.uint8).ravel()))


def over_corners(data: Shaped[np.ndarray, "nx ny nz"], combine: np.ufunc) -> np.ndarray:
    """Combines the eight voxels at the corners of each cell."""
    for axis in range(3):
        n = data.shape[axis]
        data = combine(data.take(range(n - 1), axis), data.take(range(1, n), axis))
    return data


def march(scene: Scene, *leaps: jv.SpaceLeaping) -> jv.March:
    return jv.March(scene.step, (*leaps, jv.EarlyTermination(LEFT)))


def wrong(rendering: jv.Rendering, reference: jv.Rendering) -> np.ndarray:
    """Pixels that differ from the march without leaping by more than `LIMIT`."""
    difference = np.abs(np.asarray(rendering.rgba, float) - np.asarray(reference.rgba))
    return np.max(difference, axis=-1) > LIMIT


def named(method: str, cell: int) -> str:
    return f"{method}, R = {cell}"


def measure(scene: Scene, cells: Sequence[int], repetitions: int) -> dict[str, dict[str, Any]]:
    """Time, error and wrong pixels of a scene's frame under every method."""
    grid = distances(scene.volume, scene.transfer)
    leaps = {MAP: jv.SpaceLeaping("distance"), HIERARCHY: jv.SpaceLeaping(HIERARCHY)}
    leaps[VOXELS] = VoxelLeaping(grid)
    for cell in cells:
        leaps |= {named(method, cell): jv.SpaceLeaping(method, cell) for method in (PUBLISHED, PROVEN)}
        leaps[named(OF_VOXELS, cell)] = VoxelLeaping(grid, PUBLISHED, cell)
    under = {name: march(scene, each) for name, each in leaps.items()} | {NONE: march(scene)}
    rows = harness.compare(scene, under, repetitions)
    reference = frame(scene, under[NONE])
    for name, row in rows.items():
        row["wrong"] = float(np.mean(wrong(frame(scene, under[name]), reference)))
        base = VOXELS if name.startswith(OF_VOXELS) else MAP
        row["speed-up"] = timing.ratio(rows[base]["all seconds"], row["all seconds"])
    return rows


def draw(result: dict[str, Any]) -> Any:
    """Time, wrong pixels and RMSE against R; the methods without cells are lines."""
    scenes, cells = result["scenes"], result["cells"]
    figure, axes = charts.panels(len(scenes), 3, 11.5, 2.8 * len(scenes) + 0.4)
    labels = "time / that by the distance map", "wrong pixels (> 1/255), %", "RMSE of the image"
    for row, (scene, rows) in zip(axes, scenes.items(), strict=True):
        times, wrongs, errors = row
        for method, style in ((PUBLISHED, "C3o-"), (PROVEN, "C0s-"), (OF_VOXELS, "C1^-")):
            of_method = [rows[named(method, cell)] for cell in cells]
            times.plot(cells, [each["ratio"]["median"] for each in of_method], style, label=method)
            wrongs.plot(cells, [100 * each["wrong"] for each in of_method], style)
            errors.plot(cells, [each["rmse"] for each in of_method], style)
        for method, color, line in LINES:
            times.axhline(rows[method]["ratio"]["median"], color=color, linestyle=line, label=method)
            errors.axhline(rows[method]["rmse"], color=color, linestyle=line)
        for panel, label in zip(row, labels, strict=True):
            charts.numbered(panel, cells)
            panel.set(xlabel="R, side of the grid's cells, pixels", title=f"{scene}: {label}")
            panel.set_ylim(0, max(1.1 * panel.get_ylim()[1], 1e-3))
    charts.legend_below(figure, axes[0, 0], 5)
    return figure


@experiment(
    repetitions=15,
    size=512,
    resolution=256,
    only=some_of(SCENES, "SCENE"),
    cells=CELLS,
    quick={"size": 64, "repetitions": 2, "cells": (8, 32), "resolution": 48},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes = {
        name: measure(scene, chosen.cells, chosen.repetitions)
        for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, chosen.size)
    }
    return {"goal at R = 8": GOAL, "cells": chosen.cells, "scenes": scenes}
