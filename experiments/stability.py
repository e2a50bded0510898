"""In which regimes do the methods of jaxvol fail, and what does jaxvol do there?

The failure atlas. An entry (`experiments.atlas`) names a method, sweeps one regime from harmless to
harmful, and measures an error. Its edge lies between the last value at which the error is within a stated
limit and the first at which it is not. What jaxvol does beyond: *bounded*, the error cannot occur, so there
is no edge in the sweep; *detected and said*, an error, a warning or an output of the rendering says so;
*documented*, a docstring states it; *fails*, none of these.

Besides the record (`stability.json`) and the chart (`stability.png`) this writes `stability.html`, a page
with the question, the curve, the edge and pictures on both sides of it for each entry.
"""

import math
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from matplotlib.patches import Rectangle
from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter

from . import common, record
from .atlas import ENTRIES, FAMILIES
from .atlas.entry import Entry, pictured, sweep
from .atlas.page import keep, number, page
from .common import plt


PICTURE, SMALL = 96, 64
"""Pixels along a side of pictures, in a full run and in a quick one. The page shows each pixel enlarged."""
COLUMNS = 4
OUTCOMES = {"bounded": "C2", "detected and said": "C0", "documented": "C1", "fails": "C3"}


def chart(panel: Any, entry: Entry, found: dict[str, Any]) -> None:
    """Metric against regime, with the limit and the edge. Crosses at the top: not finite."""
    values = found["values"]
    known = [v for curve in found["curves"].values() for v in curve if math.isfinite(v) and v > 0]
    top = 2 * max([entry.limit, *known])
    for name, curve in found["curves"].items():
        style = "k-" if name == entry.judged else "-"
        (line,) = panel.plot(
            values, curve, style, marker=".", label=name, linewidth=1.4 if style == "k-" else 1
        )
        lost = [v for v, number in zip(values, curve, strict=True) if not math.isfinite(number)]
        panel.plot(lost, [top] * len(lost), "x", color=line.get_color())
    _scale(panel, "x", entry.scales[0], values)
    _scale(panel, "y", entry.scales[1], [v for curve in found["curves"].values() for v in curve])
    if len(values) > 1 and values[0] > values[-1]:  # from harmless to harmful, from left to right
        panel.invert_xaxis()
    panel.axhline(entry.limit, color="0.6", linewidth=0.8, linestyle="--")
    within, beyond = found["edge"]["within"], found["edge"]["beyond"]
    if beyond is not None:
        panel.axvspan(beyond if within is None else within, beyond, color=OUTCOMES[entry.outcome], alpha=0.35)
    panel.set_title(entry.name, fontsize=9)
    panel.set_xlabel(entry.regime, fontsize=7)
    panel.set_ylabel(textwrap.fill(entry.metric, 36), fontsize=7)
    panel.tick_params(labelsize=7, which="both")
    for axis in (panel.xaxis, panel.yaxis):
        axis.get_offset_text().set_size(7)
    panel.legend(fontsize=6, framealpha=0.7)


TICKS = 6
"""At most, along an axis with a logarithmic scale."""


def _scale(panel: Any, name: Literal["x", "y"], scale: str, values: Sequence[float]) -> None:
    """Sets the scale of an axis, with ticks that do not overlap. Linear where nothing is positive."""
    axis, setter = getattr(panel, f"{name}axis"), getattr(panel, f"set_{name}scale")
    sizes = [abs(v) for v in values if v != 0 and math.isfinite(v)]
    if scale == "linear" or not sizes:
        setter("linear")
        return
    least, decades = min(sizes), math.log10(max(sizes) / min(sizes))
    if scale == "symlog":
        setter("symlog", linthresh=least)
        powers = range(math.floor(math.log10(least)), math.ceil(math.log10(max(sizes))) + 1)
        every = -(-len(powers) // (TICKS - 1))
        axis.set_ticks([0.0, *(10.0**power for power in powers[::-1][::every])])
    else:
        setter("log", nonpositive="mask")
        axis.set_major_locator(LogLocator(numticks=TICKS))
    if decades > 1:
        axis.set_minor_formatter(NullFormatter())
    else:  # ticks at powers of ten alone would be too few
        axis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))


def draw(result: dict[str, Any], pictures: Path, path: Path) -> None:
    """The chart of all entries, and the page beside it. `pictures`: their folder."""
    draw_chart(result, path)
    entries = result["entries"]
    families = {family: [e for e in row if e.name in entries] for family, row in FAMILIES.items()}
    path.with_suffix(".html").write_text(page(families, entries, pictures, chart), encoding="utf-8")


def draw_chart(result: dict[str, Any], path: Path) -> None:
    """The chart of all entries, a panel each."""
    entries = result["entries"]
    rows = -(-len(entries) // COLUMNS)
    figure, axes = plt.subplots(
        rows, COLUMNS, figsize=(3.6 * COLUMNS, 2.9 * rows), squeeze=False, layout="constrained"
    )
    for panel in axes.flat[len(entries) :]:
        panel.set_axis_off()
    for panel, (name, found) in zip(axes.flat, entries.items(), strict=False):
        chart(panel, ENTRIES[name], found)
    handles = [Rectangle((0, 0), 1, 1, color=color, alpha=0.35) for color in OUTCOMES.values()]
    labels = [f"edge; beyond it: {outcome}" for outcome in OUTCOMES if outcome != "bounded"]
    figure.legend(handles[1:], labels, loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(
        "From left to right a regime becomes harmful; upwards: an error. Black: the curve that finds the "
        "edge. Dashed: the limit. Crosses: not finite.",
        fontsize=9,
    )
    common.save(figure, path)


@common.experiment(
    "stability",
    "In which regimes do the methods fail, and what does jaxvol do there?",
    __doc__,
    only=common.some_of(ENTRIES, "ENTRY"),
)
def main(chosen: Namespace) -> common.Answer:
    entries: dict[str, Any] = {}
    pictures = chosen.output / "stability"
    if chosen.quick and chosen.only == list(ENTRIES):  # one of each family, since all take minutes to compile
        chosen.only = [family[0].name for family in FAMILIES.values()]
    for name in chosen.only:
        entry = ENTRIES[name]
        size = SMALL if chosen.quick else PICTURE
        values = [entry.values[0], entry.values[-1]] if chosen.quick else None
        found = sweep(entry, entry.size, values)
        keep(entry, [entry.picture(value, size) for value in pictured(entry, found)], pictures)
        about = {
            key: getattr(entry, key) for key in ("question", "method", "regime", "metric", "judged", "limit")
        }
        entries[name] = {**about, **found, "outcome": entry.outcome, "does": entry.does, "size": entry.size}
        within, beyond = (number(found["edge"][side]) for side in ("within", "beyond"))
        print(f"{name:40} {entry.outcome:18} within {within}, beyond {beyond} ({entry.regime})", flush=True)
    all_of_them = entries | recorded(chosen)
    result = {"entries": {name: all_of_them[name] for name in ENTRIES if name in all_of_them}}
    return result, partial(draw, result, pictures)


def recorded(chosen: Namespace) -> dict[str, Any]:
    """What the record in the output says of the entries that are not chosen, with the commit and the command
    that measured them; nothing if quick."""
    path = chosen.output / "stability.json"
    if chosen.quick or not path.is_file():
        return {}
    found = record.read(path)
    made = {"commit": found["commit"], "command": found["command"]}
    return {
        name: {"measured": made, **entry}
        for name, entry in found["result"]["entries"].items()
        if name in ENTRIES and name not in chosen.only
    }


if __name__ == "__main__":
    main()
