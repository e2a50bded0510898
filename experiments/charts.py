"""How charts of experiments are drawn and saved."""

import math
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib

from jaxvol._util.whole_files import whole_file

from . import record


matplotlib.use("Agg")
import matplotlib.pyplot as plt


DPI = 90
SHOWN, LETTER = 800, 12.5
"""The width in which documents show a picture, and the size of the letters in it, pixels."""
SIZES: Any = {"font.size": LETTER * 72 / DPI, "axes.titlesize": "medium", "figure.titlesize": "medium"}
SIZES |= {"figure.labelsize": "medium", "lines.markersize": 4}


def panels(rows: int, columns: int, width: float, height: float, **how: Any) -> tuple[Any, Any]:
    """A figure of so many panels, (rows, columns); its size is in inches. Documents shrink those that are
    wider than `SHOWN`, with their letters."""
    plt.rcParams.update(SIZES)
    return plt.subplots(rows, columns, figsize=(width, height), squeeze=False, layout="constrained", **how)


def interval(panel: Any, ratio: Mapping[str, float], y: float, color: str, label: str | None = None) -> None:
    """A median ratio and its 95 % interval, at a height."""
    panel.plot((ratio["low"], ratio["high"]), (y, y), color=color, linewidth=2, alpha=0.5)
    panel.plot(ratio["median"], y, "o", color=color, label=label, markersize=5)


def legend_below(figure: Any, panel: Any, columns: int) -> None:
    """One legend for all panels, below them: that of one panel."""
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=columns)


def numbered(panel: Any, x: Any, names: Sequence[str] | None = None) -> None:
    """A logarithmic scale along x, with ticks at these numbers alone."""
    panel.set_xscale("log", base=2)
    panel.set_xticks(x, x if names is None else names)
    panel.set_xticks([], minor=True)


def plain_numbers(panel: Any) -> None:
    """Label logarithmic axes by numbers such as 0.002 and 20, not by powers of ten; on axes of few decades
    also between these."""
    for axis, ends in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
        low, high = sorted(ends)
        if axis.get_scale() == "log" and low > 0:
            axis.set_major_formatter("{x:g}")
            leads = (2, 3, 5, 7) if high / low < 6 else (2, 5) if high / low < 30 else ()
            axis.set_minor_formatter(partial(_labelled, leads))


def _labelled(leads: Sequence[int], value: float, _: Any) -> str:
    """The label of a value that is one of these digits times a power of ten; of others, none."""
    lead = value / 10 ** math.floor(math.log10(value))
    return f"{value:g}" if round(lead, 6) in leads else ""


def draw_record(file: Path, path: Path) -> None:
    """Draws a record into a file by the `draw` of its experiment, if that has one; next to it its page, and
    the charts that it calls `more`, by their names."""
    found = record.read(file)
    module = import_module(shlex.split(found["command"])[2])
    if hasattr(module, "draw"):
        save(module.draw(found["result"]), path)
    for name, chart in getattr(module, "more", {}).items():
        save(chart(found["result"]), path.with_name(f"{name}{path.suffix}"))
    if hasattr(module, "page"):
        module.page(file, path.with_suffix(".html"))


def save(figure: Any, path: Path) -> None:
    """Write a chart. Equal results give equal files."""
    with whole_file(path) as part:
        exactly: dict[str, Any] = {"pil_kwargs": {"lossless": True}}
        how = exactly if path.suffix == ".webp" else {"metadata": {"Software": None}}
        figure.savefig(part, dpi=DPI, **how)
    plt.close(figure)
