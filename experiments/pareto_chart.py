"""Draws time against error, a panel for each scene, with the fronts."""

import math
from pathlib import Path
from typing import Any

from matplotlib.lines import Line2D

from . import common
from .accuracy import DRJIT, VTK
from .common import plt


COLORS = {
    "left": "#1f77b4",
    "midpoint": "#2ca02c",
    "preintegrated": "#d62728",
    "adaptive": "#9467bd",
    "jitter": "#e377c2",
    "alignment": "#8c564b",
    "leaping": "#17becf",
    "termination": "#bcbd22",
    "transfer table": "#5254a3",
    "storage": "#ad494a",
    "photons": "#08306b",
    "templates": "#7f0000",
    "baked": "#00441b",
    "deferred": "#fd8d8d",
    "shaded": "#6a3d9a",
    "shaded once": "#b15928",
    "isosurface": "#1b9e77",
    "isosurface, no leaping": "#d95f02",
    "isosurface, leaping by distance": "#7570b3",
    "whole": "#2b8cbe",
    "bricks, memory of the whole": "#e6ab02",
    "bricks, memory of a quarter": "#a6761d",
    VTK: "#555555",
    DRJIT: "#ff7f0e",
}
"""By family, here and on the page."""
MARKS = {VTK: "^", DRJIT: "s"}
COLUMNS = 4


def draw(result: dict[str, Any], path: Path) -> None:
    scenes = result["scenes"]
    columns = min(COLUMNS, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4.4 * columns, 3.7 * rows + 0.7), squeeze=False, layout="constrained"
    )
    for panel, (name, scene) in zip(axes.flat, scenes.items(), strict=False):
        _panel(panel, name, scene)
    for panel in axes.flat[len(scenes) :]:
        panel.set_axis_off()
    for panel in axes[:, 0]:
        panel.set_ylabel("time of a frame, ms", fontsize=9)
    used = {point["family"] for scene in scenes.values() for point in scene["points"].values()}
    marks = [
        Line2D([], [], color=color, marker=MARKS.get(family, "o"), linestyle="", label=family)
        for family, color in COLORS.items()
        if family in used
    ]
    lines = [
        Line2D([], [], color="k", linewidth=1.2, label="jaxvol's front"),
        Line2D([], [], color="k", linewidth=0.8, linestyle=":", label="error of the reference"),
    ]
    figure.suptitle(
        "Each point is a method with its settings: the time of a frame against the error of its image; below "
        "and to the left is better",
        fontsize=11,
    )
    figure.legend(handles=[*marks, *lines], loc="outside lower center", ncols=min(9, 3 * columns), fontsize=9)
    common.save(figure, path)


def _panel(panel: Any, name: str, scene: dict[str, Any]) -> None:
    points = scene["points"]
    for family in dict.fromkeys(point["family"] for point in points.values()):
        mine = [point for point in points.values() if point["family"] == family]
        errors, times = [p["rmse"] for p in mine], [p["time"] * 1e3 for p in mine]
        style = {"color": COLORS[family], "markersize": 6 if family in MARKS else 4.5, "alpha": 0.8}
        panel.plot(errors, times, MARKS.get(family, "o"), zorder=3 if family in MARKS else 2, **style)
    front = [points[n] for n in scene["front of jaxvol"]]
    corners = [(p["rmse"], p["time"] * 1e3) for p in front]
    if corners:
        corners.append((max(point["rmse"] for point in points.values()), corners[-1][1]))
        panel.step(*zip(*corners, strict=True), where="post", color="k", linewidth=1.2, zorder=1)
    panel.axvline(scene["reference"]["rmse"], color="k", linewidth=0.8, linestyle=":")
    panel.set(xscale="log", yscale="log", xlabel="RMSE")
    panel.set_title(f"{name}, {scene['pixels']}²", fontsize=10)
    panel.tick_params(labelsize=8, which="both")
    common.plain_numbers(panel)
    panel.grid(which="major", linewidth=0.3)
