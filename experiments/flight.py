"""Do starts from a minimum-distance grid save as much wherever the camera is?

A flight through the colon phantom and through the trachea of a CT into a main bronchus: at each place, a view
ahead and one aside, at the wall. Counted per ray as the program of Chae and Shin marches (`ray_leaps`), at
steps of a voxel: leaps and samples by the distance map of voxels alone, and what starts by cells of R x R
pixels save of them. Each view is rendered by the engine as well, for the share of wrong pixels.

The cause, as in their Figs. 1 and 4, by the angle between a ray and the wall that it hits: leaps of the map
alone and with starts, and how far the hits of a cell's corners lie apart.
"""

from argparse import Namespace
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

import jaxvol as jv

from . import charts
from .harness import chosen_scenes, experiment, image, some_of
from .minimum_distance import PHANTOM, PUBLISHED, SCENES, march, wrong
from .ray_leaps import Marcher, Saved, grid_of
from .scenes import Scene


CELLS = (2, 4, 8, 16, 32, 64)
BEST = 8
"""R of the paper's shortest time."""
QUANTILES = 0.25, 0.5, 0.75, 0.9
BINS = np.arange(0, 91, 10)
"""Ends of the intervals of angles between ray and wall, degrees."""
TRACHEA = [
    *((99.9, 38.6, 186), (98.8, 60.6, 162), (98.8, 72.9, 150), (94.7, 79.0, 136), (93.0, 84.0, 124)),
    *((97.0, 87.0, 112), (102.0, 87.0, 104), (107.0, 89.0, 96), (115.0, 91.0, 88)),
]
"""Middles of its cross-sections, and of the left main bronchus below, mm."""
FLOWN = {name: SCENES[name] for name in ("airway", PHANTOM)}
AHEAD, ASIDE = "ahead", "aside"
LEAPS, STARTED, SPREAD = "leaps, distance map", f"leaps, R = {BEST}", "spread of the corners"


def path(name: str, places: int) -> tuple[np.ndarray, np.ndarray]:
    """Places along a centre line, and unit directions of the flight there, (places, 3)."""
    line = jv.colon_path() if name == PHANTOM else np.asarray(TRACHEA)
    curve = CubicSpline(np.linspace(0, 1, len(line)), line)
    at = np.linspace(0.04, 0.92, places)
    forward = curve(at, 1)
    return curve(at), forward / np.linalg.norm(forward, axis=-1, keepdims=True)


def cameras(name: str, camera: jv.Camera, places: int) -> dict[str, list[jv.Camera]]:
    """Views ahead, and to the right of that."""
    up, size = np.asarray(camera.view_up, float), camera.size
    found: dict[str, list[jv.Camera]] = {AHEAD: [], ASIDE: []}
    for place, forward in zip(*path(name, places), strict=True):
        for view, way in ((AHEAD, forward), (ASIDE, np.cross(forward, up))):
            found[view].append(jv.Camera(place, place + way, up, view_angle=90, size=size))
    return found


def flown(name: str, scene: Scene, chosen: Namespace) -> dict[str, Any]:
    """What each view takes, saves and spoils; and over all views, both by angle, and how far corners lie
    apart."""
    marcher = Marcher(scene)
    views: dict[str, list[dict[str, Any]]] = {}
    rays: list[np.ndarray] = []
    spreads: dict[str, list[np.ndarray]] = {str(cell): [] for cell in chosen.cells}
    for direction, along in cameras(name, scene.camera, chosen.views).items():
        views[direction] = []
        for camera in along:
            alone = marcher.count(camera)
            hits, saved = alone.hit < alone.exit, {}
            for cell in chosen.cells:
                grid = grid_of(alone.hit, cell)
                started = marcher.count(camera, grid.start)
                saved[str(cell)] = Saved.of(alone, started, grid)._asdict()
                spreads[str(cell)].append(grid.spread[hits])
                if cell == BEST:
                    degrees = marcher.slopes(camera, alone.hit)
                    rays.append(np.stack([degrees, alone.leaps, started.leaps, grid.spread])[:, hits])
            views[direction].append(
                {
                    "eye": np.asarray(camera.position).tolist(),
                    "towards": np.asarray(camera.focal_point).tolist(),
                    "leaps a ray": float(alone.leaps.mean()),
                    "samples a ray": float(alone.samples.mean()),
                    "saved": saved,
                    "wrong": spoiled(scene._replace(camera=camera), chosen.cells),
                }
            )
    quantiles = {c: np.quantile(np.concatenate(parts), QUANTILES) for c, parts in spreads.items()}
    return {
        "views": views,
        "by angle": by_angle(np.concatenate(rays, axis=1)),
        SPREAD: {cell: found.tolist() for cell, found in quantiles.items()},
    }


def by_angle(rays: np.ndarray) -> dict[str, list[float]]:
    """Means of the rays' rows in each interval of angles, with the share of rays."""
    degrees, *rows = rays
    number = np.digitize(degrees, BINS[1:-1])
    members = [number == n for n in range(len(BINS) - 1)]
    means = {
        name: [float(np.mean(row[member])) for member in members]
        for name, row in zip((LEAPS, STARTED, SPREAD), rows, strict=True)
    }
    return {"share of rays": [float(np.mean(member)) for member in members], **means}


def spoiled(scene: Scene, cells: Sequence[int]) -> dict[str, float]:
    """Share of wrong pixels in the engine's image, by R."""
    reference = image(scene, march(scene))
    images = {cell: image(scene, march(scene, jv.SpaceLeaping(PUBLISHED, cell, block=1))) for cell in cells}
    return {str(cell): float(np.mean(wrong(found, reference))) for cell, found in images.items()}


def draw(result: dict[str, Any]) -> Any:
    """Leaps, and the spread of corners, by the angle between ray and wall; what starts save along the flight;
    and the spread by R."""
    figure, ((leaps, spread), (saved, by_cell)) = charts.panels(2, 2, 11, 7.6)
    cells, middles = result["cells"], (np.array(result["angles"][1:]) + result["angles"][:-1]) / 2
    for (scene, found), color in zip(result["scenes"].items(), ("C0", "C3"), strict=False):
        table = found["by angle"]
        leaps.plot(middles, table[LEAPS], color + "--", label=f"{scene}, distance map")
        leaps.plot(middles, table[STARTED], color + "o-", label=f"{scene}, R = {BEST}")
        spread.plot(middles, [100 * part for part in table[SPREAD]], color + "o-", label=scene)
        for (direction, views), line in zip(found["views"].items(), ("-", ":"), strict=True):
            along = [100 * view["saved"][str(BEST)]["leaps"] for view in views]
            saved.plot(range(1, len(along) + 1), along, color + line, label=f"{scene}, {direction}")
        quantiles = 100 * np.array([found[SPREAD][str(cell)] for cell in cells])
        by_cell.plot(cells, quantiles[:, 1], color + "o-", label=f"{scene}, median")
        by_cell.plot(cells, quantiles[:, 3], color + ":", label=f"{scene}, 90 % of the rays")
    leaps.set(ylabel="leaps of a ray", title="Leaps are short along a wall (Fig. 1)")
    spread.set(ylabel="spread, % of the farthest", title=f"Corners differ along a wall, R = {BEST} (Fig. 4)")
    for panel in (leaps, spread):
        panel.set(xlabel="angle between ray and wall, degrees", xticks=result["angles"][::3])
    saved.set(xlabel="view of the flight", ylabel="leaps saved, %", ylim=(0, 100))
    saved.set_title(f"What starts save, R = {BEST}")
    by_cell.set(xlabel="R, side of the grid's cells, pixels", ylabel="spread, % of the farthest")
    by_cell.set_title("Corners of large cells differ (Fig. 4)")
    charts.numbered(by_cell, cells)
    for panel in (leaps, spread, saved, by_cell):
        panel.legend()
    return figure


@experiment(
    views=24,
    size=256,
    resolution=256,
    only=some_of(FLOWN, "SCENE"),
    cells=CELLS,
    quick={"views": 2, "size": 32, "cells": (8, 32), "resolution": 48},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes = {
        name: flown(name, scene, chosen) for name, scene in chosen_scenes(chosen, FLOWN, PHANTOM, chosen.size)
    }
    return {"cells": chosen.cells, "angles": BINS.tolist(), "quantiles": QUANTILES, "scenes": scenes}
