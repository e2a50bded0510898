"""Charts and tables of what experiments recorded, beside what the papers report."""

from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from experiments import charts, flight, templates
from experiments.bricks_once import ASKED, FORMULA, NONE, PRINTED
from experiments.harness import Main
from experiments.kisti import (
    BOTH as ERT_AND_ESS,
    BOTH_SKIPPED,
    BY_GRADIENT,
    ERT,
    ESS,
    NEITHER,
    REPORT,
    SKIPPED,
)
from experiments.marches import BOTH, EMPTY, JITTER, PLAIN
from experiments.minimum_distance import (
    HIERARCHY,
    MAP,
    OF_VOXELS,
    PROVEN,
    PUBLISHED,
    VOXELS,
    draw_counts,
    named,
)

from .common import from_record, table_from_record


# -- Kye 2013

COLUMNS = (JITTER, EMPTY, BOTH)
KYE = {  # seconds, 1024 x 1024 pixels, in the order of the table's columns
    "head": (0.767, 0.771, 0.775, 0.775),
    "heart": (3.728, 3.741, 3.739, 3.745),
    "kidney": (1.768, 1.765, 1.771, 1.772),
    "vessels": (1.192, 1.196, 1.199, 1.216),
}


def table1(result: dict[str, Any]) -> str:
    """The record of `experiments/overhead.py` and the paper's table, as one Markdown table."""
    lines = [
        f"| volume | pixels | {PLAIN} | "
        + " | ".join(COLUMNS)
        + f" | RMSE, {PLAIN} | RMSE, {BOTH} | pixels aligned |",
        "|---|" + "---|" * (len(COLUMNS) + 5),
    ]
    each = [
        (f"{name}, {said}", size, condition["volumes"][name][str(size)])
        for said, condition in result["conditions"].items()
        for size in result["sizes"]
        for name in condition["volumes"]
    ]
    for name, size, rows in each:
        cells = [f"{size}²", f"{rows[PLAIN]['seconds']:.3f} s"]
        for column in COLUMNS:
            ratio = rows[column]["ratio"]
            cells.append(f"{ratio['median']:.3f} [{ratio['low']:.3f}, {ratio['high']:.3f}]")
        cells += [f"{rows[march]['rmse']:.5f}" for march in (PLAIN, BOTH)]
        cells.append(f"{rows[BOTH]['aligned']:.2%}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for name, (plain, *others) in KYE.items():
        cells = ["1024²", f"{plain:.3f} s", *(f"{other / plain:.3f}" for other in others), *"–––"]
        lines.append(f"| *paper: {name}* | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


# -- Chae and Shin

CHAE = 8, 0.47  # R, time over that of the distance map


def chae_fig5(result: dict[str, Any], path: Path) -> None:
    """A column for each scene: times, and below the points of the published method their shares of wrong
    pixels; and what starts leave of leaps and samples."""
    scenes, cells = result["scenes"], result["cells"]
    figure, (axes, below) = charts.panels(2, len(scenes), 4.4 * len(scenes), 7.6, sharey="row")
    for panel, left, (scene, rows) in zip(axes, below, scenes.items(), strict=True):
        for method, style in ((PUBLISHED, "C3o-"), (OF_VOXELS, "C1^-"), (PROVEN, "C0s-")):
            ratios = [rows[named(method, cell)]["ratio"] for cell in cells]
            median = np.array([r["median"] for r in ratios])
            ends = abs(np.array([[r[end] for r in ratios] for end in ("low", "high")]) - median)
            panel.errorbar(cells, median, ends, fmt=style, markersize=4, capsize=3, label=method)
        for cell in cells:
            wrong = 100 * rows[named(PUBLISHED, cell)]["wrong"]
            share = f"{wrong:.2g}" if wrong >= 1e-3 or not wrong else "< 0.001"
            panel.text(cell, 0.03, f"{share} %", ha="center", color="C3", size="small")
        for method, color, line in ((MAP, "k", "--"), (VOXELS, "C1", "--"), (HIERARCHY, "C2", "-.")):
            panel.axhline(rows[method]["ratio"]["median"], color=color, linestyle=line, label=method)
        off = rows[VOXELS]["ratio"]["median"] * CHAE[1]  # the paper's map is one of voxels
        panel.plot(CHAE[0], off, "kx", markersize=8, label="the paper, off the map of voxels")
        charts.numbered(panel, cells)
        panel.set(xlim=(1.7, 95), ylim=(0, 1.6), xlabel="R, side of the grid's cells, pixels")
        panel.set_title(f"{scene}: {rows[MAP]['seconds'] * 1e3:.0f} ms by the distance map")
        draw_counts(left, cells, result["counts"][scene])
        charts.numbered(left, cells)
        left.set(xlim=(1.7, 95), xlabel="R, side of the grid's cells, pixels")
    axes[0].set_ylabel("CPU time / that by the distance map")
    below[0].set_ylabel("left of those by the map of voxels, %")
    below[0].legend(loc="upper center")
    figure.suptitle("Bars: 95 % intervals. Red numbers: wrong pixels under min_distance")
    charts.legend_below(figure, axes[0], 3)
    charts.save(figure, path)


def chae_fig1(result: dict[str, Any], path: Path) -> None:
    charts.save(flight.draw(result), path)


# -- Kim, Kwon and Shin 2008

METHODS = ("overlap", "reload", "naive", "whole")


def kim_rows(result: dict[str, Any], condition: str) -> str:
    """A row for each split under one condition: overlap as printed, by the formula, and for the voxels that
    are measured; what was read, loads, the memory that bricks took, and rates, of the paper and ours; and
    rows of the best split from other sides."""
    head = [
        "β, σ, γ",
        "*paper: overlap %*",
        "formula, changed so %",
        "formula, these voxels %",
        "read: overlap / reload, times the volume",
        "loads: overlap / reload",
        "held: overlap / reload, MiB",
        "*paper: fps, proposed / reload*",
        "fps: overlap / reload / naive / whole",
        "time of reload / overlap",
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    found = result["conditions"][condition]
    others = {f"{BEST}, {view}": row for view, row in found[f"{BEST} from"].items()}
    for name, row in (found["splits"] | others).items():
        paper, both = row.get("paper"), [row[method] for method in METHODS[:2]]
        ratio = row["reload"]["ratio to overlap"]
        printed = ["", "", "", ""]
        if paper is not None:
            printed = [
                f"*{paper['overlap']:.2f}*",
                f"{row['formula']:.2f}",
                f"{row['formula, of these voxels']:.2f}",
                f"*{paper['proposed']:.2f} / {paper['reload']:.2f}*",
            ]
        cells = [
            name.replace(",", " × ", 2),
            *printed[:3],
            " / ".join(f"{each['read, times the volume']:.2f}" for each in both),
            " / ".join(f"{each['loads']}" for each in both),
            " / ".join(f"{each['held, MiB']:.0f}" for each in both),
            printed[3],
            " / ".join(f"{1 / row[m]['seconds']:.3g}" if m in row else "–" for m in METHODS),
            f"{ratio['median']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]"
            if row["repetitions"] > 1
            else f"{ratio['median']:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def kim_table1(result: dict[str, Any]) -> str:
    """A table for each condition."""
    return "\n".join(kim_rows(result, condition) for condition in result["conditions"])


def kim_once(result: dict[str, Any]) -> str:
    """A row for each split and view in which bricks read once without overlap leave rays incomplete: what is
    incomplete and wrong, by overlap, and what is read, by ours, too."""
    ways, ours = (NONE, PRINTED, FORMULA), METHODS[:2]
    head = [
        "β, σ, γ",
        "from",
        "incomplete rays %: " + " / ".join(ways),
        "wrong pixels %",
        "read, times the volume: " + " / ".join((*ways, *ours)),
        "loads: " + " / ".join((*ways, *ours)),
        "at the paper's size: " + " / ".join(ways),
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, row in result["splits"].items():
        for view, found in row["views"].items():
            if not found[NONE]["incomplete rays"]:
                continue
            percent = [
                " / ".join(f"{100 * found[way][what]:.2f}" for way in ways)
                for what in ("incomplete rays", "wrong pixels")
            ]
            reads = [
                " / ".join(format(found[way][what], form) for way in (*ways, *ours))
                for what, form in (("read, times the volume", ".2f"), ("loads", "d"))
            ]
            asked = " / ".join(f"{row[ASKED][way]:.3f}" for way in ways)
            cells = [name.replace(",", " × "), view, *percent, *reads, asked]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


BEST = "2,4,2"


def kim_fig9(result: dict[str, Any], path: Path) -> None:
    """Above the paper's rates, below ours, from the largest bricks to the smallest."""
    conditions = result["conditions"]
    rows = conditions[next(iter(conditions))]["splits"]
    names = sorted(rows, key=lambda name: (rows[name]["bricks"], name))
    at = range(len(names))
    figure, axes = charts.panels(1 + len(conditions), 1, 9, 2.8 * (1 + len(conditions)), sharex=True)
    (theirs,), *ours = axes
    theirs.plot(at, [rows[n]["paper"]["proposed"] for n in names], "C0o-", label="proposed (overlap)")
    theirs.plot(at, [rows[n]["paper"]["reload"] for n in names], "C1s-", label="reload")
    theirs.set_title("the paper: 1280 x 490 x 325 voxels, 375 x 375 pixels")
    for (panel,), (condition, found) in zip(ours, conditions.items(), strict=True):
        rows, image = found["splits"], found["image"]
        here = [(x, rows[n]) for x, n in zip(at, names, strict=True) if n in rows]
        for method, style in (("overlap", "C0o-"), ("reload", "C1s-"), ("naive", "C3x:")):
            label = "naive, wrong" if method == "naive" else method
            points = [(x, 1 / row[method]["seconds"]) for x, row in here if method in row]
            if points:
                panel.plot(*zip(*points, strict=True), style, label=label)
        whole = median(1 / row["whole"]["seconds"] for _, row in here)
        panel.axhline(whole, color="0.5", linestyle="--", label="the whole volume at once")
        voxels = " x ".join(map(str, found["voxels"][::-1]))
        panel.set_title(f"{condition}: {voxels} voxels, {image[0]} x {image[1]} pixels")
    for (panel,) in axes:
        panel.set_yscale("log")
        panel.set_ylabel("frames per second")
        panel.legend()
        charts.plain_numbers(panel)
        if BEST in names:
            panel.axvline(names.index(BEST), color="0.8", linewidth=6, zorder=0)
    last, bricks = axes[-1][0], conditions[next(iter(conditions))]["splits"]
    last.set_xticks(at, [f"{n}: {bricks[n]['bricks']}" for n in names], rotation=60, ha="right")
    last.set_xlabel("split β,σ,γ: number of bricks; grey: the paper's best")
    charts.save(figure, path)


# -- KISTI report


def speed_ups(result: dict[str, Any], shading: str) -> str:
    """One half of the record of `experiments/kisti.py`, "scenes" (unshaded) or "shaded", and the report's
    table, as one Markdown table."""
    sizes, scenes = [str(size) for size in result["sizes"]], result[shading]
    lines = ["| | " + " | ".join(REPORT) + " |", "|---|" + "---|" * len(REPORT)]

    def line(name: str, cells: list[list[str]]) -> None:
        lines.append(f"| {name} | " + " | ".join(" / ".join(cell) for cell in cells) + " |")

    def of(method: str, form: str, *keys: str) -> list[list[str]]:
        rows = [[scenes[scene][size][method] for size in sizes] for scene in REPORT]
        for key in keys:
            rows = [[row[key] for row in pair] for pair in rows]
        return [[format(value, form) for value in pair] for pair in rows]

    ours = {ERT: [ERT], ESS: [SKIPPED, ESS], ERT_AND_ESS: [BOTH_SKIPPED, ERT_AND_ESS]}
    for method, forms in ours.items():
        line(f"*report: {method}*", [[f"{gain:.2f}" for gain in REPORT[scene][method]] for scene in REPORT])
        for form in forms:
            if form not in scenes[next(iter(REPORT))][sizes[0]]:
                continue
            line(form, of(form, ".2f", "speed-up", "median"))
            quotients = [
                [
                    f"{scenes[scene][size][form]['speed-up']['median'] / gain:.2f}"
                    for size, gain in zip(sizes, REPORT[scene][method], strict=True)
                ]
                for scene in REPORT
            ]
            line(f"{form}, ours / report's", quotients)
    line(f"seconds, {NEITHER}", of(NEITHER, ".3f", "seconds"))
    line(f"RMSE, {NEITHER}", of(NEITHER, ".4f", "rmse"))
    line(f"RMSE, {ERT_AND_ESS}", of(ERT_AND_ESS, ".4f", "rmse"))
    return "\n".join(lines) + "\n"


def tested_every(result: dict[str, Any]) -> str:
    """What early termination gains where ended rays are looked for every so many samples, over the shortest
    frame without it."""
    rows = result["ended rays are looked for every so many samples"]
    counts = list(rows[next(iter(REPORT))])
    lines = ["| samples | " + " | ".join(REPORT) + " |", "|---|" + "---|" * len(REPORT)]
    best = {scene: min(rows[scene][count]["seconds"][NEITHER] for count in counts) for scene in REPORT}
    for count in counts:
        seconds = {scene: rows[scene][count]["seconds"][ERT] for scene in REPORT}
        cells = [f"{best[scene] / own:.2f} ({own:.3f} s)" for scene, own in seconds.items()]
        lines.append(f"| {count} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def kisti_table(result: dict[str, Any]) -> str:
    """All four."""
    parts = "shaded", BY_GRADIENT, "scenes"
    return "\n".join((*(speed_ups(result, part) for part in parts), tested_every(result)))


# -- Lee, Kwon and Shin 2016

LEE = {
    "Table 1": (0.72760, 0.10492, 0.04836, 0.02219, 0.01002, 0.00454, 0.00206, 0.00945),
    "Table 2": (0.18145, 0.12455, 0.12500, 0.12321, 0.05762, 0.05719, 0.05676, 0.02634),
    "Table 3, material A": (0.12291, 0.12241, 0.07501, 0.07500, 0.48284, 0.48282, 0.03076, 0.03060),
    "Table 3, material B": (0.22145, 0.17421, 0.17500, 0.17120, 0.04829, 0.04805, 0.04728, 0.01339),
}
"""Intensities as printed. 0.00945, 0.48284 and 0.48282 lack a zero: 0.000945, 0.048284, 0.048282."""
LEVELS = "01 2 3 4 5 6 7 8", "01 0 0 0 1 1 1 2", "01 01 0 0 1 1 2 2", "01 0 0 0 1 1 1 2"
"""Of each table's rows: how often its photon was refracted before; of both, where one landed on another."""
LEAST = (1 - 1 / templates.INDEX**2) ** 0.5
"""cos θ' at the critical angle."""


PHOTONS = dict.fromkeys(("Table 1", "Table 2"), "*56 to 63 photons*")
"""How many the paper has at an opacity of 50 %; it does not say from how many packets."""


def lee_tables(result: dict[str, Any]) -> str:
    """All three tables as one Markdown table. In brackets, the fewest and most photons of many templates."""
    heads = "", "x", "y", "z", "intensity", "*paper*", "*level*", "light of this level"
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for (name, found), levels in zip(result["tables"].items(), LEVELS, strict=True):
        table, (opacity, packets) = name.split(":")[0], templates.TABLES[name]
        for row, (paper, level) in enumerate(zip(LEE[table], levels.split(), strict=True)):
            cells = ["–"] * 4
            if row < len(found["photons"]):
                *offset, light = found["photons"][row]
                cells = [*(f"{c:.2f}" for c in offset), f"{light:.5f}"]
            least, most = (
                sum(opacity * ((1 - opacity) * cosine) ** int(k) for k in level) / packets
                for cosine in (LEAST, 1)
            )
            cells += [f"*{paper:.5f}*", f"*{' + '.join(level)}*"]
            cells.append(f"{least:.5f}" if least == most else f"{least:.5f} to {most:.5f}")
            lines.append(f"| {'' if row else name} | {' | '.join(cells)} |")
        fewest, most = found["counts of many"]
        counts = f"*{found['count']} photons ({fewest} to {most})*"
        lines.append(f"| {counts} | | | | {found['energy']:.5f} | {PHOTONS.get(table, '')} | | |")
    return "\n".join(lines) + "\n"


def lee_fig1(result: dict[str, Any], path: Path) -> None:
    charts.save(templates.draw(result), path)


RECORDS: dict[str, Main] = {
    "table1": table_from_record("table1", "overhead", table1),
    "chae_fig1": from_record("chae_fig1.webp", "flight", chae_fig1),
    "chae_fig5": from_record("chae_fig5.webp", "minimum_distance", chae_fig5),
    "kim_table1": table_from_record("kim_table1", "bricks", kim_table1),
    "kim_once": table_from_record("kim_once", "bricks_once", kim_once),
    "kim_fig9": from_record("kim_fig9.webp", "bricks", kim_fig9),
    "kisti_table": table_from_record("kisti_table", "kisti", kisti_table),
    "lee_fig1": from_record("lee_fig1.webp", "templates", lee_fig1),
    "lee_tables": table_from_record("lee_tables", "templates", lee_tables),
}
"""By the name of what is written."""
