"""Draws the chart of a `pareto` record, and its page: one HTML file without network, the chart with
the numbers, the command and the picture behind each point.

Both are made from the record and the small pictures beside it alone. `pareto_page.html` is the page without
its data.
"""

import base64
import html
import io
import json
import math
from pathlib import Path
from typing import Any

from matplotlib.lines import Line2D

from . import charts, record
from .pareto_measure import slug
from .pareto_points import SETTINGS
from .programs import DRJIT, VTK


FAMILIES = [setting.family for settings in SETTINGS.values() for setting in settings.values()]
FAMILIES = list(dict.fromkeys([*FAMILIES, VTK, DRJIT]))
PALETTE = [*charts.plt.get_cmap("tab20").colors, *charts.plt.get_cmap("tab20b").colors]  # pyright: ignore
COLORS = dict(zip(FAMILIES, PALETTE, strict=False))
"""By family, here and on the page."""
MARKS = {VTK: "^", DRJIT: "s"}
COLUMNS = 4
TEMPLATE = Path(__file__).with_suffix(".html")
NUMBERS = ("family", "rmse", "psnr", "ssim", "wood grain")
"""What the page tells of a point, beside its time."""


def chart(result: dict[str, Any]) -> Any:
    """Time against error, a panel for each scene, with the fronts."""
    scenes = result["scenes"]
    columns = min(COLUMNS, len(scenes))
    rows = math.ceil(len(scenes) / columns)
    figure, axes = charts.panels(rows, columns, 4.4 * columns, 3.7 * rows + 0.7)
    for panel, (name, scene) in zip(axes.flat, scenes.items(), strict=False):
        draw_scene(panel, name, scene)
    for panel in axes.flat[len(scenes) :]:
        panel.set_axis_off()
    for panel in axes[:, 0]:
        panel.set_ylabel("time of a frame, ms")
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
    return figure


GRAIN = {
    "equidistant": [f"midpoint, step {step}" for step in ("0.25", "0.5", "1", "2", "4")],
    "jittered": ["jittered, step 1", "jittered, step 2"],
    "jittered, first cell cut at the entry": [
        "jittered, front residual, step 1",
        "jittered, front residual, step 2",
    ],
    "empty-space jittered": ["empty-space jittered, step 1", "empty-space jittered, step 2"],
}
"""Settings of the chart of wood grain, all by the midpoint rule and aligned."""
GRAIN_OF = "head phantom", "engine", "bonsai", "lidc0314_airway"
NO_GRAIN = 1e-8
"""The least energy that is told from 0: less is rounding."""


def grain_chart(result: dict[str, Any]) -> Any:
    """Time against the energy of wood grain: of jitter, and of shorter steps.

    Energies are estimates. As far as the lowest of those drawn lies below 0, others may lie above it by
    chance: below that, points are drawn at one place, which the chart calls "not told from 0".
    """
    scenes = {name: result["scenes"][name] for name in GRAIN_OF if name in result["scenes"]}
    drawn = [
        (number, label, {n: scene["points"][n] for n in settings if n in scene["points"]})
        for number, scene in enumerate(scenes.values())
        for label, settings in GRAIN.items()
    ]
    floor = max([NO_GRAIN, *(-p["wood grain"] for _, _, points in drawn for p in points.values())])
    figure, axes = charts.panels(1, max(len(scenes), 1), 4 * max(len(scenes), 1), 4.4)
    for panel, (name, scene) in zip(axes.flat, scenes.items(), strict=False):
        panel.axvspan(floor / 4, floor, color="0.9")
        panel.set(xscale="log", xlabel="energy of wood grain", title=f"{name}, {scene['pixels']}²")
        panel.grid(which="major", linewidth=0.3)
    for number, label, points in drawn:
        if not points:
            continue
        panel, base = axes.flat[number], list(scenes.values())[number]["points"]["midpoint, step 1"]["time"]
        energies = [p["wood grain"] if p["wood grain"] > floor else floor / 2 for p in points.values()]
        places = list(zip(energies, (p["time"] / base for p in points.values()), strict=True))
        panel.plot(*zip(*places, strict=True), "o-", markersize=4.5, linewidth=0.8, label=label)
        for setting, place in zip(points, places, strict=True):
            panel.annotate(setting.rsplit(" ", 1)[1], place, (3, 3), textcoords="offset points", fontsize=8)
    axes.flat[0].set_ylabel("time of a frame / at one voxel")
    figure.suptitle(
        "Time against wood grain: of jitter, and of shorter equidistant steps. Numbers are steps in voxels; "
        f"below and to the left is better. Grey: below {floor:.1e}, not told from 0",
        fontsize=10,
    )
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
    return figure


def identity(scene: str, setting: str) -> str:
    """Of a point, in the chart of the page."""
    return f"point-{slug(scene)}-{slug(setting)}"


def draw_scene(panel: Any, name: str, scene: dict[str, Any]) -> None:
    points = scene["points"]
    for setting, point in points.items():
        family = point["family"]
        style: Any = {"markersize": 6, "zorder": 3} if family in MARKS else {"markersize": 4.5, "zorder": 2}
        style |= {"color": COLORS.get(family, "0.7"), "alpha": 0.8, "gid": identity(name, setting)}
        panel.plot(point["rmse"], point["time"] * 1e3, MARKS.get(family, "o"), **style)
    front = [points[n] for n in scene["front of jaxvol"]]
    corners = [(p["rmse"], p["time"] * 1e3) for p in front]
    corners.append((max(point["rmse"] for point in points.values()), corners[-1][1]))
    panel.step(*zip(*corners, strict=True), where="post", color="k", linewidth=1.2, zorder=1)
    panel.axvline(scene["reference"]["rmse"], color="k", linewidth=0.8, linestyle=":")
    panel.set(xscale="log", yscale="log", xlabel="RMSE")
    panel.set_title(f"{name}, {scene['pixels']}²", fontsize=10)
    charts.plain_numbers(panel)
    panel.grid(which="major", linewidth=0.3)


def write(path: Path, page: Path) -> None:
    """Write the page of a record, with the pictures that the experiment left beside it."""
    pictures = path.parent / "pareto"
    found = record.read(path)
    result, device = found["result"], found["device"]
    about = (
        "One mark for each setting, one panel for each scene; lower left is better. The line is the front of "
        "jaxvol's marks, the dotted line the error of the reference itself. Times are medians of "
        f"{result['repetitions']} rounds on {device['processor']}, {device['cores']} cores. "
        f"Commit {found['commit']}. " + "; ".join(f"{n}: {v}" for n, v in result["peers"].items()) + "."
    )
    drawn = io.StringIO()
    with charts.plt.rc_context({"svg.fonttype": "none", "svg.hashsalt": "pareto"}):
        figure = chart(result)
        figure.savefig(drawn, format="svg", metadata={"Date": None})
    charts.plt.close(figure)
    points = {
        identity(name, setting): point_of(name, scene, setting)
        for name, scene in result["scenes"].items()
        for setting in scene["points"]
    }
    shown = {
        file.relative_to(pictures).as_posix(): base64.b64encode(file.read_bytes()).decode()
        for file in sorted(pictures.glob("*/*.webp"))
    }
    parts = {
        "<!--ABOUT-->": html.escape(about),
        "<!--CHART-->": drawn.getvalue().partition("<svg")[2].join(("<svg", "")),
        "<!--AHEAD-->": ahead(result["scenes"]),
        "/*POINTS*/": as_script(points),
        "/*PICTURES*/": as_script(shown),
    }
    text = TEMPLATE.read_text(encoding="utf-8")
    for place, part in parts.items():
        text = text.replace(place, part)
    page.write_text(text, encoding="utf-8")


def point_of(name: str, scene: dict[str, Any], setting: str) -> dict[str, Any]:
    """What the page tells of a point."""
    point = scene["points"][setting]
    numbers = {"ms": point["time"] * 1e3, **{key: point[key] for key in NUMBERS}}
    return {
        "scene": name,
        "name": setting,
        "command": point["command"],
        "numbers": {n: f"{v:.4g}" if isinstance(v, float) else v for n, v in numbers.items()},
        "picture": f"{slug(name)}/{slug(setting)}.webp",
        "reference": f"{slug(name)}/reference.webp",
    }


def as_script(data: Any) -> str:
    """JSON within a script, which "</script>" in a string would end."""
    return json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("</", "<\\/")


def ahead(scenes: dict[str, Any]) -> str:
    """A table of the points of other programs that are ahead of ours."""
    titles = ("point", "our fastest time at its error / its own", "our best error in its time / its own")
    rows: list[tuple[str, ...]] = [(*titles, "of that time, our shortest frame")]
    for name, scene in scenes.items():
        points = scene["points"].values()
        shortest = min(point["time"] for point in points if point["family"] not in MARKS)
        for setting, by in scene["their points that it is not"].items():
            ratios = ["none" if by[key] is None else f"{by[key]:.3g}" for key in ("time", "error")]
            ours = by["time"] and scene["points"][setting]["time"] * by["time"]
            rows.append((f"{name}: {setting}", *ratios, f"{shortest / ours:.0%}" if ours else ""))
    lines = ("".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
