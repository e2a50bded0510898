"""Chae and Shin, Fig. 5: time against the grid's cells. Draws the record of
`experiments/minimum_distance.py`, with the number in the paper's text: at R = 8, 53 % less than the distance
map alone."""

from pathlib import Path
from typing import Any

from experiments import charts
from experiments.minimum_distance import HIERARCHY, MAP, OF_VOXELS, PROVEN, PUBLISHED, VOXELS, named

from .common import from_record


PAPER = 8, 0.47  # R, time over that of the distance map


def draw(result: dict[str, Any], path: Path) -> None:
    """A panel for each scene; below the points of the published method, their shares of wrong pixels."""
    scenes, cells = result["scenes"], result["cells"]
    figure, (axes,) = charts.panels(1, len(scenes), 4.2 * len(scenes) + 0.4, 3.6)
    for panel, (scene, rows) in zip(axes, scenes.items(), strict=True):
        for method, style in ((PUBLISHED, "C3o-"), (OF_VOXELS, "C1^-"), (PROVEN, "C0s-")):
            ratios = [rows[named(method, cell)]["ratio"] for cell in cells]
            low, high = ([r[end] for r in ratios] for end in ("low", "high"))
            panel.plot(cells, [r["median"] for r in ratios], style, markersize=5, label=method)
            panel.fill_between(cells, low, high, color=style[:2], alpha=0.2, linewidth=0)
        for cell in cells:
            wrong = rows[named(PUBLISHED, cell)]["wrong"]
            panel.text(cell, 0.02, f"{wrong:.2%}", ha="center", fontsize=7, color="C3")
        for method, color, line in ((MAP, "k", "--"), (VOXELS, "C1", "--"), (HIERARCHY, "C2", "-.")):
            panel.axhline(rows[method]["ratio"]["median"], color=color, linestyle=line, label=method)
        off = rows[VOXELS]["ratio"]["median"] * PAPER[1]  # the paper's map is one of voxels
        panel.plot(PAPER[0], off, "kx", markersize=8, label="the paper, off the distance map of voxels")
        panel.set_xscale("log", base=2)
        panel.set_xticks(cells, cells)
        panel.set_ylim(bottom=0)
        panel.set_xlabel("R, side of the grid's cells, pixels", fontsize=9)
        panel.set_title(f"{scene}: {rows[MAP]['seconds'] * 1e3:.0f} ms by the distance map", fontsize=9)
        panel.tick_params(labelsize=8)
    axes[0].set_ylabel("time / that by the distance map", fontsize=9)
    figure.suptitle("Bands: 95 % intervals. Red numbers: wrong pixels under min_distance", fontsize=9)
    charts.legend_below(figure, axes[0], 3)
    charts.save(figure, path)


main = from_record(__doc__, "chae_fig5.webp", "minimum_distance", draw)

if __name__ == "__main__":
    main()
