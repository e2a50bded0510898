"""The failure atlas as a chart, a panel for each entry."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from matplotlib.patches import Rectangle
from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter

from .. import charts
from .entry import Entry


COLUMNS = 4
TICKS = 6
"""At most, along an axis with a logarithmic scale."""
OUTCOMES = {"bounded": "C2", "detected and said": "C0", "documented": "C1", "fails": "C3"}


def chart(by_name: dict[str, Entry], entries: dict[str, Any], path: Path) -> None:
    """The chart of all entries, a panel each."""
    rows = -(-len(entries) // COLUMNS)
    figure, axes = charts.panels(rows, COLUMNS, 3.6 * COLUMNS, 2.9 * rows)
    for panel in axes.flat[len(entries) :]:
        panel.set_axis_off()
    for panel, (name, found) in zip(axes.flat, entries.items(), strict=False):
        draw_panel(panel, by_name[name], found)
    handles = [Rectangle((0, 0), 1, 1, color=color, alpha=0.35) for color in OUTCOMES.values()]
    labels = [f"edge; beyond it: {outcome}" for outcome in OUTCOMES if outcome != "bounded"]
    figure.legend(handles[1:], labels, loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(
        "From left to right a regime becomes harmful; upwards: an error. Black: the curve that finds the "
        "edge. Dashed: the limit. Crosses: not finite.",
        fontsize=9,
    )
    charts.save(figure, path)


def draw_panel(panel: Any, entry: Entry, found: dict[str, Any]) -> None:
    """Metric against regime, with the limit and the edge. Crosses at the top: not finite."""
    values = found["values"]
    known = [v for curve in found["curves"].values() for v in curve if math.isfinite(v) and v > 0]
    top = 2 * max([entry.limit, *known])
    for name, curve in found["curves"].items():
        style = "k-" if name == entry.judged else "-"
        width = 1.4 if style == "k-" else 1
        (line,) = panel.plot(values, curve, style, marker=".", label=name, linewidth=width)
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
