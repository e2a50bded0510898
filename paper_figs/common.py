"""How figures are made: from options, pictures and records.

Pages keep their pixels: one pixel of a picture is one ray, since resampling would smooth the artefacts.
"""

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Rectangle
from PIL import Image

from experiments import record
from experiments.charts import plt, whole_file
from experiments.harness import QUICK, Main, command
from experiments.pictures import Panel, Panels


OUTPUT = Path(__file__).parent / "output"
DATA = {"type": Path, "metavar": "FOLDER", "help": "real volumes, in place of phantoms"}
RECORDS = {"type": Path, "default": record.RESULTS, "metavar": "FOLDER", "help": "that of the records"}

DPI = 100
GAP, HEAD, TEXT = 4, 40, 54  # pixels: gap between images, height of the title and of the text under an image


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
    """Write a page of square pictures, down to the last line that is not white."""
    side, columns = panels[0][0].image.shape[0], max(map(len, panels))
    width, height = columns * (side + GAP) + GAP, HEAD + len(panels) * (side + TEXT) + GAP
    figure = plt.figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.text(GAP / width, 1 - 5 / height, title, va="top", fontsize=8, weight="bold")
    for row, line in enumerate(panels):
        for column, panel in enumerate(line):
            left, bottom = GAP + column * (side + GAP), height - HEAD - row * (side + TEXT) - side
            _draw(figure.add_axes((left / width, bottom / height, side / width, side / height)), panel, side)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # pyright: ignore[reportAttributeAccessIssue]
    plt.close(figure)
    last = np.flatnonzero((pixels < 255).any(axis=(1, 2)))[-1]
    with whole_file(path) as part:
        Image.fromarray(pixels[: last + 1 + GAP]).save(part, "WEBP", quality=95, method=6)
    print(path)


def _draw(axes: Any, panel: Panel, side: int) -> None:
    axes.imshow(panel.image, interpolation="none")
    axes.axis("off")
    how = {"transform": axes.transAxes}
    axes.text(0, -4 / side, panel.below, va="top", fontsize=7.5, linespacing=1.1, **how)
    axes.text(0, 1 + 3 / side, panel.above, va="bottom", fontsize=8, **how)
    if panel.square is not None:
        x, y, of = panel.square
        axes.add_patch(Rectangle((x, y), of, of, fill=False, edgecolor="white", linewidth=0.8))
