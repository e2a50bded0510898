"""How figures are made: from options, pictures and records.

Pages keep their pixels: one pixel of a picture is one ray, since resampling would smooth the artefacts.
"""

import math
from argparse import Namespace
from collections.abc import Callable, Iterable
from pathlib import Path
from textwrap import wrap
from typing import Any

from matplotlib.patches import Rectangle

from experiments import charts, record
from experiments.charts import plt, whole_file
from experiments.harness import QUICK, Main, command
from experiments.pictures import Panel, Panels


OUTPUT = Path(__file__).parent / "output"
DATA = {"type": Path, "metavar": "FOLDER", "help": "real volumes, beside phantoms"}
RECORDS = {"type": Path, "default": record.RESULTS, "metavar": "FOLDER", "help": "that of the records"}

DPI = 100
GAP = 4
"""Pixels between images."""


def pictures(
    name: str,
    title: str | Callable[[Namespace], str],
    render: Callable[[Namespace], Panels],
    resolution: int = 160,
    size: int = 256,
    data: bool = False,
) -> Main:
    """The `main` of a page of pictures of scenes.

    Args:
        name: of the page.
        title: of the page, or a function from the options to it.
        render: from the options to the panels.
        resolution: voxels along an axis of a phantom, by default.
        size: pixels along a side of an image, by default.
        data: whether it can show real volumes.
    """

    @command(
        f"Renders {name}.", OUTPUT, data=DATA if data else (), size=size, resolution=resolution, quick=QUICK
    )
    def main(chosen: Namespace) -> None:
        if chosen.quick:
            chosen.size, chosen.resolution = 48, 40
        panels = render(chosen)
        page(panels, title if isinstance(title, str) else title(chosen), chosen.output / f"{name}.webp")
        for each in (each for row in panels for each in row):
            print(name, each.above, each.below.replace("\n", ", "))

    return main


def from_record(file: str, experiment: str, draw: Callable[[Any, Path], None]) -> Main:
    """The `main` of a chart of an experiment's record: `draw(result, path)`."""

    @command(f"Draws {file} from the record of experiments.{experiment}.", OUTPUT, results=RECORDS)
    def main(chosen: Namespace) -> None:
        draw(record.read(chosen.results / f"{experiment}.json")["result"], chosen.output / file)
        print(chosen.output / file)

    return main


def table_from_record(name: str, experiment: str, table: Callable[[Any], str]) -> Main:
    """The same of a Markdown table: `table(result)`."""

    def write(result: Any, path: Path) -> None:
        with whole_file(path) as part:
            part.write_text(table(result), encoding="utf-8")

    return from_record(f"{name}.md", experiment, write)


def page(panels: Panels, title: str, path: Path) -> None:
    """Write a page of square pictures, with letters that can be read where a browser shrinks it."""
    side = panels[0][0].image.shape[0]
    width = max(map(len, panels)) * (side + GAP) + GAP
    letter = charts.LETTER * max(1, width / charts.SHOWN)

    def fitted(text: str, across: float) -> str:
        lines = (wrap(line, int(across / (0.6 * letter))) or [""] for line in text.split("\n"))
        return "\n".join(each for line in lines for each in line)

    def tall(texts: Iterable[str]) -> float:
        return max(text.count("\n") + bool(text) for text in texts) * 1.2 * letter + GAP

    title = fitted(title, 0.9 * width)
    rows = [
        [p._replace(above=fitted(p.above, side), below=fitted(p.below, side)) for p in row] for row in panels
    ]
    tops, height = [], GAP + tall([title])
    for row in rows:
        tops.append(height + tall(panel.above for panel in row))
        height = tops[-1] + side + tall(panel.below for panel in row) + 2 * GAP
    height = math.ceil(height)
    figure = plt.figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    how: dict[str, Any] = {"fontsize": letter * 72 / DPI, "linespacing": 1.1}
    figure.text(GAP / width, 1 - GAP / height, title, va="top", weight="bold", **how)
    for row, top in zip(rows, tops, strict=True):
        bottom = height - round(top) - side
        for column, panel in enumerate(row):
            left = GAP + column * (side + GAP)
            _draw(figure.add_axes((left / width, bottom / height, side / width, side / height)), panel, **how)
    with whole_file(path) as part:
        figure.savefig(part, dpi=DPI, pil_kwargs={"quality": 95, "method": 6})
    plt.close(figure)
    print(path)


def _draw(axes: Any, panel: Panel, **how: Any) -> None:
    axes.imshow(panel.image, interpolation="none")
    axes.axis("off")
    for text, y, va in ((panel.above, 1, "bottom"), (panel.below, 0, "top")):
        axes.annotate(text, (0, y), (0, GAP if y else -GAP), "axes fraction", "offset pixels", va=va, **how)
    if panel.square is not None:
        x, y, of = panel.square
        axes.add_patch(Rectangle((x, y), of, of, fill=False, edgecolor="white", linewidth=0.8))
