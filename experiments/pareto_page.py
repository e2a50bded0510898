"""Draws the chart of a `pareto` record, and writes its page: one HTML file without network, with the picture
behind each point.

Both are made from the record and the small pictures beside it alone. `pareto_page.html` is the page without
its data.
"""

import base64
import json
import math
from pathlib import Path
from typing import Any

from matplotlib.lines import Line2D

from . import charts, record
from .pareto_measure import AMPLIFIED, slug
from .programs import DRJIT, VTK


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
TEMPLATE = Path(__file__).with_suffix(".html")
DATA = "/*DATA*/"
SHOWN = {"family": "f", "time": "t", "rmse": "e", "psnr": "p", "ssim": "s", "wood grain": "w", "command": "c"}
"""What the page knows of a point, and how its data call it."""
ABOUT = (
    *("view", "look", "lit", "toroidal", "pixels", "reference", "gradients"),
    "their points that it is not",
)
"""What it knows of a scene, beside its points."""


def chart(result: dict[str, Any], path: Path) -> None:
    """Time against error, a panel for each scene, with the fronts."""
    scenes = result["scenes"]
    columns = min(COLUMNS, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure, axes = charts.panels(rows, columns, 4.4 * columns, 3.7 * rows + 0.7)
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
    charts.save(figure, path)


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
    charts.plain_numbers(panel)
    panel.grid(which="major", linewidth=0.3)


def write(path: Path, pictures: Path, page: Path) -> Path:
    """Write the page of a record.

    - `pictures`: the folder with a folder of pictures for each scene.
    """
    found = record.read(path)
    result = found.pop("result")
    data = {
        "about": found,
        "amplified": AMPLIFIED,
        "colors": COLORS,
        "marks": MARKS,
        "summary": result["summary"],
        "peers": result["peers"],
        "repetitions": result["repetitions"],
        "scenes": [scene(name, each, pictures / slug(name)) for name, each in result["scenes"].items()],
    }
    # "</script>" in a string would end the script
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("</", "<\\/")
    page.write_text(TEMPLATE.read_text(encoding="utf-8").replace(DATA, text), encoding="utf-8")
    return page


def scene(name: str, found: dict[str, Any], pictures: Path) -> dict[str, Any]:
    """What the page shows of a scene."""
    points = [
        {
            "n": point,
            **{short: rounded(row[long]) for long, short in SHOWN.items()},
            "i": embedded(pictures / f"{slug(point)}.webp"),
        }
        for point, row in found["points"].items()
    ]
    about = {key: found[key] for key in ABOUT if key in found}
    image = embedded(pictures / "reference.webp")
    return {"name": name, **about, "image": image, "points": points}


def rounded(value: Any) -> Any:
    """Numbers to four digits, which is more than the page shows."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def embedded(file: Path) -> str | None:
    """A picture as text; None if it is not there."""
    return base64.b64encode(file.read_bytes()).decode() if file.is_file() else None
