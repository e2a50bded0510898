"""In which regimes do the methods of jaxvol fail, and what does jaxvol do there?

The failure atlas. An entry (`experiments.atlas`) names a method, sweeps one regime from harmless to
harmful, and measures an error. Its edge lies between the last value at which the error is within a stated
limit and the first at which it is not. What jaxvol does beyond: *bounded*, the error cannot occur, so there
is no edge in the sweep; *detected and said*, an error, a warning or an output of the rendering says so;
*documented*, a docstring states it; *fails*, none of these.

Beside the record and the chart, the folder `stability` holds pictures on both sides of an edge, where an
image is what is measured. The documentation's page of failures shows all of it.
"""

import math
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image

import jaxvol as jv
from jaxvol._util.whole_files import whole_file

from . import charts
from .atlas import ENTRIES
from .atlas.entry import Entry, sweep
from .harness import experiment, recorded, some_of


ABOUT = ("question", "method", "regime", "metric", "judged", "limit", "outcome", "does", "shows", "size")
COLUMNS = 2
OUTCOMES = {"detected and said": "C0", "documented": "C1", "fails": "C3"}


def draw(result: dict[str, Any]) -> Any:
    """A panel for each entry."""
    entries = result["entries"]
    rows = -(-len(entries) // COLUMNS)
    figure, axes = charts.panels(rows, COLUMNS, 4.4 * COLUMNS, 3 * rows)
    for panel in axes.flat[len(entries) :]:
        panel.set_axis_off()
    for panel, (name, found) in zip(axes.flat, entries.items(), strict=False):
        draw_panel(panel, ENTRIES[name], found)
    handles = [Rectangle((0, 0), 1, 1, color=color, alpha=0.35) for color in OUTCOMES.values()]
    labels = [f"edge; beyond it: {outcome}" for outcome in OUTCOMES]
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(
        "From left to right a regime becomes harmful; upwards: an error.\n"
        "Black: the curve that finds the edge. Dashed: the limit. Crosses: not finite."
    )
    return figure


def draw_panel(panel: Any, entry: Entry, found: dict[str, Any]) -> None:
    """Metric against regime, with the limit and the edge. Crosses at the top: not finite."""
    values, curves = found["values"], found["curves"]
    numbers = [number for curve in curves.values() for number in curve]
    top = 2 * max(entry.limit, *(number for number in numbers if math.isfinite(number)))
    for name, curve in curves.items():
        style, width = ("k-", 1.4) if name == entry.judged else ("-", 1)
        (line,) = panel.plot(values, curve, style, marker=".", markersize=6, label=name, linewidth=width)
        lost = [v for v, number in zip(values, curve, strict=True) if not math.isfinite(number)]
        panel.plot(lost, [top] * len(lost), "x", color=line.get_color(), markersize=6)
    _scale(panel, "x", values)
    _scale(panel, "y", numbers)
    if values[0] > values[-1]:  # from harmless to harmful, from left to right
        panel.invert_xaxis()
    panel.axhline(entry.limit, color="0.6", linewidth=0.8, linestyle="--")
    within, beyond = found["edge"]["within"], found["edge"]["beyond"]
    if beyond is not None:
        panel.axvspan(beyond if within is None else within, beyond, color=OUTCOMES[entry.outcome], alpha=0.35)
    panel.set_title(entry.name)
    panel.set_xlabel(textwrap.fill(entry.regime, 42))
    panel.set_ylabel(textwrap.fill(entry.metric, 30))
    panel.legend(framealpha=0.7)
    charts.plain_numbers(panel)


def _scale(panel: Any, name: Literal["x", "y"], values: Sequence[float]) -> None:
    """A logarithmic scale, through 0 where there is one, with ticks that do not overlap."""
    axis, setter = getattr(panel, f"{name}axis"), getattr(panel, f"set_{name}scale")
    sizes = [abs(v) for v in values if v != 0 and math.isfinite(v)]
    if not sizes:
        return
    powers = np.log10([min(sizes), max(sizes)])
    if min(values) <= 0:
        setter("symlog", linthresh=min(sizes))
        if name == "y":
            panel.set_ylim(bottom=min(values) - min(sizes) / 3)
        every = max(1, math.ceil(np.ptp(powers) / 5))
        axis.set_ticks([0.0, *10.0 ** np.arange(math.ceil(powers[1]), math.floor(powers[0]) - 1, -every)])
    else:
        setter("log", nonpositive="mask")
        axis.set_major_locator(LogLocator(numticks=6))
    axis.set_minor_formatter(NullFormatter())


def keep(entry: Entry, values: tuple[float, float], size: int, folder: Path) -> None:
    """Write the pictures of an entry at two values of its regime."""
    assert entry.picture is not None
    folder.mkdir(exist_ok=True)
    for number, value in enumerate(values, 1):
        image = np.clip(entry.picture(value, size), 0, 1)
        levels = np.round(255 * np.asarray(jv.to_srgb(image))).astype(np.uint8)
        with whole_file(folder / f"{entry.name.replace(' ', '-')}.{number}.webp") as part:
            Image.fromarray(levels).save(part, "WEBP", lossless=True)


@experiment(
    only=some_of(ENTRIES, "ENTRY"),
    picture={"type": int, "default": 96, "help": "pixels along a side of pictures"},
    quick={"picture": 64},
)
def main(chosen: Namespace) -> dict[str, Any]:
    if chosen.quick and chosen.only == list(ENTRIES):  # one of each file, since all take minutes to compile
        chosen.only = list({entry.measure.__module__: name for name, entry in ENTRIES.items()}.values())
    entries: dict[str, Any] = {}
    for name in chosen.only:
        entry = ENTRIES[name]
        found = sweep(entry, entry.size, entry.values[:: len(entry.values) - 1] if chosen.quick else None)
        if entry.picture is not None:
            within = found["edge"]["within"]
            found["pictured"] = entry.pictured or (within or entry.values[0], entry.values[-1])
            keep(entry, found["pictured"], chosen.picture, chosen.output / "stability")
        entries[name] = found | {key: getattr(entry, key) for key in ABOUT}
    entries |= recorded(chosen, "entries", [name for name in ENTRIES if name not in entries])
    return {"entries": {name: entries[name] for name in ENTRIES if name in entries}}
