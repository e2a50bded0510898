"""What does a minimum-distance grid gain inside a cavity, and which pixels does it spoil, by cell size?

Chae and Shin, Figs. 5 and 6: a perspective camera inside a cavity, where rays run along walls and leaps by a
distance map are short. Measured are the distance map alone, starts taken from the corner rays of cells of R x
R pixels ("min_distance", as published), starts proven from the whole cell ("beam"), and empty stretches of
beams ("blocks"). Distances are those of blocks of 4³ voxels, found in every image; and, for the map and
the published starts, also those of voxels (and, for the map, of blocks of 2³), found before the image, as the
paper has them. "speed-up" is off the map of the same distances: only with those of voxels it is off what the
paper's is off.

The published starts are not a bound, so each time comes with the share of pixels that differ from the march
without leaping by more than 1/255, and with the RMSE against a converged image. The paper reports 53 % less
time at R = 8, which is the goal (2.1 times the speed of the distance map of voxels), and distortion at R =
32. Steps are one voxel long. Times are CPU seconds.

Beside the times stand leaps and samples counted per ray, as the paper's program marches (`ray_leaps`), at
steps of a voxel and of a quarter: what starts save of both is what they could save of its time.
"""

import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import charts, harness, marches, timing
from .harness import chosen_scenes, experiment, recorded, some_of
from .ray_leaps import Marcher, Saved, grid_of
from .scenes import AIRWAY, OF_AIRWAY, SCENES as OUTSIDE, Scene, inside


NONE, MAP, HIERARCHY = "no leaping", "distance map", "hierarchy"
OF_TWO, VOXELS = "distance map of blocks of 2", "distance map of voxels"
PUBLISHED, PROVEN, OF_VOXELS = "min_distance", "beam", "min_distance, voxels"
LINES = (
    (MAP, "k", "--"),
    (OF_TWO, "C4", "--"),
    (VOXELS, "C1", "--"),
    (HIERARCHY, "C2", "-."),
    (NONE, "C7", ":"),
)
CELLS = (2, 4, 8, 16, 32, 64)
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
    """Folds, one behind the other."""
    volume, path = jv.phantom("colon", resolution), jv.colon_path()
    camera = jv.Camera(path[340], path[352], (0, 1, 0.1), view_angle=90, size=(size, size))
    transfer = jv.TransferFunction.from_points(WALL, unit_distance=0.0125)
    return Scene(volume, transfer, camera, float(volume.spacing[0]))


def airway(folder: Path, size: int, resolution: int) -> Scene:
    """The trachea, down to where it divides. The preset begins at -920 Hounsfield units, which the noise of
    air exceeds somewhere in most blocks; here it is moved up to begin at -724."""
    volume = jv.load(folder / AIRWAY, spacing=OF_AIRWAY)
    camera = jv.Camera((96, 76, 144), (90, 89, 112), (0, -1, 0), view_angle=90, size=(size, size))
    return Scene(volume, jv.preset("ct_airway", clim=(-800, 3000)), camera, OF_AIRWAY[0])


def vessels(folder: Path, size: int, resolution: int) -> Scene:
    """Vessels with an aneurysm, seen from the middle of the widest place between them: thin ones stand before
    others."""
    return inside(OUTSIDE["aneurism"](folder, size))


WHOLE, QUARTER = "steps of a voxel", "of a quarter"
PHANTOM = "colon phantom"
SCENES: dict[str, Callable[..., Scene]] = {"airway": airway, PHANTOM: colon}


def march(scene: Scene, *leaps: jv.SpaceLeaping) -> jv.March:
    return jv.March(scene.step, (*leaps, jv.EarlyTermination(LEFT)))


def wrong(rendering: jv.Rendering, reference: jv.Rendering) -> np.ndarray:
    """Pixels that differ from the march without leaping by more than `LIMIT`."""
    difference = np.abs(np.asarray(rendering.rgba, float) - np.asarray(reference.rgba))
    return np.max(difference, axis=-1) > LIMIT


def named(method: str, cell: int) -> str:
    return f"{method}, R = {cell}"


def measure(scene: Scene, cells: Sequence[int], repetitions: int) -> dict[str, dict[str, Any]]:
    """CPU seconds, error and wrong pixels of a scene's image under every method."""
    leaps = {MAP: jv.SpaceLeaping("distance"), HIERARCHY: jv.SpaceLeaping("blocks")}
    leaps[OF_TWO] = jv.SpaceLeaping("distance", block=2)
    leaps[VOXELS] = jv.SpaceLeaping("distance", block=1)
    for cell in cells:
        leaps |= {named(method, cell): jv.SpaceLeaping(method, cell) for method in (PUBLISHED, PROVEN)}
        leaps[named(OF_VOXELS, cell)] = jv.SpaceLeaping(PUBLISHED, cell, block=1)
    under = {name: march(scene, each) for name, each in leaps.items()} | {NONE: march(scene)}
    drawn = {name: partial(harness.image, scene, each) for name, each in under.items()}
    seconds = timing.interleaved(drawn, repetitions, time.process_time)
    images = {name: draw() for name, draw in drawn.items()}
    truth = harness.image(scene, marches.converged(scene.step, harness.FINER)).rgba
    rows = {}
    for name, found in images.items():
        base = VOXELS if name.startswith(OF_VOXELS) else MAP
        rows[name] = {
            **harness.row(seconds[name], seconds[MAP], rmse(found.rgba, truth)),
            "wrong": float(np.mean(wrong(found, images[NONE]))),
            "speed-up": timing.ratio(seconds[base], seconds[name]),
        }
    return rows


def counted(scene: Scene, cells: Sequence[int]) -> dict[str, Any]:
    """Leaps and samples of a ray by the distance map of voxels, in the mean, and what starts save of them."""
    marcher = Marcher(scene)
    alone = marcher.count(scene.camera)
    grids = {str(cell): grid_of(alone.hit, cell) for cell in cells}
    saved = {cell: Saved.of(alone, marcher.count(scene.camera, g.start), g) for cell, g in grids.items()}
    means = {"leaps a ray": float(alone.leaps.mean()), "samples a ray": float(alone.samples.mean())}
    return {**means, "saved": {cell: each._asdict() for cell, each in saved.items()}}


def draw(result: dict[str, Any]) -> Any:
    """For each scene, time, wrong pixels and RMSE against R, the methods without cells as lines; and what is
    left of leaps and samples."""
    scenes, cells = result["scenes"], result["cells"]
    figure, axes = charts.panels(len(scenes), 4, 16, 3.2 * len(scenes) + 0.6, sharey="col")
    labels = (
        "CPU time / that by the distance map",
        "leaps, samples left, %",
        "wrong pixels (> 1/255), %",
        "RMSE of the image",
    )
    for row, (scene, rows) in zip(axes, scenes.items(), strict=True):
        times, left, wrongs, errors = row
        for method, style in ((PUBLISHED, "C3o-"), (PROVEN, "C0s-"), (OF_VOXELS, "C1^-")):
            of_method = [rows[named(method, cell)] for cell in cells]
            times.plot(cells, [each["ratio"]["median"] for each in of_method], style, label=method)
            wrongs.plot(cells, [100 * each["wrong"] for each in of_method], style)
            errors.plot(cells, [each["rmse"] for each in of_method], style)
        for method, color, line in LINES:
            times.axhline(rows[method]["ratio"]["median"], color=color, linestyle=line, label=method)
            errors.axhline(rows[method]["rmse"], color=color, linestyle=line)
        draw_counts(left, cells, result["counts"][scene])
        for panel, label in zip(row, labels, strict=True):
            charts.numbered(panel, cells)
            panel.set(xlabel="R, side of the grid's cells, pixels", title=f"{scene}: {label}")
    for panel in axes[0]:
        panel.set_ylim(0, max(1.1 * panel.get_ylim()[1], 1e-3))
    axes[0, 1].legend()
    charts.legend_below(figure, axes[0, 0], 5)
    return figure


def draw_counts(panel: Any, cells: Sequence[int], counts: dict[str, Any]) -> None:
    """What starts leave of leaps, and of leaps and samples, in percent of those by the map alone."""
    for steps, line in ((WHOLE, "-"), (QUARTER, ":")):
        for part, style in (("leaps", "C2o"), ("both", "C4s")):
            left = [100 * (1 - counts[steps]["saved"][str(cell)][part]) for cell in cells]
            label = f"{'leaps and samples' if part == 'both' else part}, {steps}"
            panel.plot(cells, left, style + line, label=label)
    panel.set_ylim(0, 140)  # with room for a legend


@experiment(
    repetitions=15,
    size=512,
    resolution=256,
    only=some_of(SCENES, "SCENE"),
    cells=CELLS,
    quick={"size": 64, "repetitions": 2, "cells": (8, 32), "resolution": 48},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes, counts = {}, {}
    for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, chosen.size):
        scenes[name] = measure(scene, chosen.cells, chosen.repetitions)
        finer = {WHOLE: scene, QUARTER: scene._replace(step=scene.step / 4)}
        counts[name] = {steps: counted(marched, chosen.cells) for steps, marched in finer.items()}
    others = [name for name in SCENES if name not in scenes]
    same = {"cells": list(chosen.cells)}
    scenes |= recorded(chosen, "scenes", others, same)
    counts |= recorded(chosen, "counts", others, same)
    order = [name for name in SCENES if name in scenes]
    return {
        "goal at R = 8": GOAL,
        "cells": chosen.cells,
        "scenes": {name: scenes[name] for name in order},
        "counts": {name: counts[name] for name in order},
    }
