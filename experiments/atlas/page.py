"""The failure atlas as a chart, and as one page: plain HTML, its images embedded, without scripts."""

import base64
import html
import io
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogFormatter, LogLocator, NullFormatter
from PIL import Image

import jaxvol as jv
from jaxvol._util.whole_files import whole_file

from .. import charts
from .entry import Entry, pictured


SOURCES = "../../"
"""From the folder of records to the root, where `jaxvol/` is."""
COLUMNS = 4
TICKS = 6
"""At most, along an axis with a logarithmic scale."""
OUTCOMES = {"bounded": "C2", "detected and said": "C0", "documented": "C1", "fails": "C3"}
DONE = {"bounded": "#2a7f2a", "detected and said": "#1f5fa8", "documented": "#b86a00", "fails": "#b02020"}
STYLE = """
body { font: 16px/1.45 sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
h2 { border-bottom: 1px solid #bbb; margin-top: 3rem } h3 { margin: 2.5rem 0 0.3rem }
.parts { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start }
figure { margin: 0; max-width: 24rem } figcaption { font-size: 0.8rem; color: #444; max-width: 16rem }
.picture img { width: 240px; border: 1px solid #ccc; image-rendering: pixelated }
table { border-collapse: collapse; font-size: 0.85rem } td, th { padding: 0.15rem 0.6rem; text-align: left }
tr:nth-child(even) { background: #f3f3f3 } .done { font-weight: bold }
"""
INTRODUCTION = """
Each entry sweeps one regime from harmless to harmful and measures an error. The edge lies between the last
value at which the error is within the stated limit (dashed) and the first at which it is not; the curve
that decides is black. Beyond the edge the failure is <b>detected and said</b> by an error, a warning or an
output of the rendering, <b>documented</b> in a docstring, or none of these: it <b>fails</b>. <b>Bounded</b>
means that the failure does not occur anywhere in the sweep.
"""


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


def page(families: dict[str, list[Entry]], found: dict[str, dict[str, Any]], pictures: Path) -> str:
    """The page of all entries in `found`. `pictures`: the folder in which `keep` left theirs."""
    body = ["<h1>Failure atlas</h1>", f"<p>{INTRODUCTION}</p>", _contents(families, found)]
    for family, entries in families.items():
        if entries:
            body.append(f"<h2>{html.escape(family)}</h2>")
        body += [_entry(e, found[e.name], pictures) for e in entries]
    head = f'<meta charset="utf-8"><title>jaxvol: failure atlas</title><style>{STYLE}</style>'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n'
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def keep(entry: Entry, images: Sequence[np.ndarray], folder: Path) -> None:
    """Writes the pictures of an entry, linear images."""
    folder.mkdir(exist_ok=True)
    for file, image in zip(_files(entry, folder), images, strict=True):
        levels = np.round(255 * np.asarray(jv.to_srgb(np.clip(image, 0, 1)))).astype(np.uint8)
        with whole_file(file) as part:
            Image.fromarray(levels).save(part, "WEBP", lossless=True)


def _files(entry: Entry, folder: Path) -> list[Path]:
    return [folder / f"{_anchor(entry)}.{i}.webp" for i in (1, 2)]


def number(value: float | None) -> str:
    """A value of a regime, as text."""
    return "–" if value is None else f"{value:.4g}"


def edge_text(entry: Entry, found: dict[str, Any]) -> str:
    """Where the edge is, as a sentence."""
    within, beyond = found["edge"]["within"], found["edge"]["beyond"]
    if beyond is None:
        return f"No edge up to {number(within)} ({entry.regime})."
    if within is None:
        return f"Beyond the limit from {number(beyond)} on, the first value of the sweep ({entry.regime})."
    return f"Within the limit up to {number(within)}, beyond it from {number(beyond)} on ({entry.regime})."


def _contents(families: dict[str, list[Entry]], found: dict[str, dict[str, Any]]) -> str:
    rows = "".join(
        f'<tr><td><a href="#{_anchor(e)}">{html.escape(e.name)}</a></td><td>{_outcome(e)}</td>'
        f"<td>{html.escape(edge_text(e, found[e.name]))}</td></tr>\n"
        for entries in families.values()
        for e in entries
    )
    return f"<table><tr><th>entry</th><th>what jaxvol does</th><th>edge</th></tr>\n{rows}</table>"


def _entry(entry: Entry, found: dict[str, Any], pictures: Path) -> str:
    source, name = _source(entry.method)
    figures = "".join(
        f'<figure class="picture"><img src="{_uri(file.read_bytes(), "webp")}" '
        f'alt="{html.escape(entry.shows)}">'
        f"<figcaption>{html.escape(entry.regime)}: <b>{number(value)}</b></figcaption></figure>"
        for value, file in zip(pictured(entry, found), _files(entry, pictures), strict=True)
        if file.is_file()
    )
    return (
        f'<h3 id="{_anchor(entry)}">{html.escape(entry.name)}</h3>\n'
        f"<p><i>{html.escape(entry.question)}</i> {html.escape(edge_text(entry, found))} "
        f"Limit: {number(entry.limit)} ({html.escape(entry.metric)}).</p>\n"
        f"<p>{_outcome(entry)}: {html.escape(entry.does)} "
        f'See the docstring of <a href="{SOURCES}{source}">{name}</a>.</p>\n'
        f'<div class="parts"><figure><img src="{_curves(entry, found)}" alt="curve"></figure>'
        f"{figures}</div>\n"
        + (f"<p><small>Pictures: {html.escape(entry.shows)}.</small></p>" if figures else "")
    )


def _outcome(entry: Entry) -> str:
    return f'<span class="done" style="color: {DONE[entry.outcome]}">{entry.outcome}</span>'


def _anchor(entry: Entry) -> str:
    return entry.name.replace(" ", "-")


def method(name: str) -> Any:
    """The object of `Entry.method`."""
    found: Any = jv
    for part in name.split(".")[1:]:
        found = getattr(found, part)
    return found


def _source(name: str) -> tuple[str, str]:
    """File and name of the object whose docstring states an edge."""
    return method(name).__module__.replace(".", "/") + ".py", name


def _curves(entry: Entry, found: dict[str, Any]) -> str:
    figure, ((panel,),) = charts.panels(1, 1, 4.2, 3.0)
    draw_panel(panel, entry, found)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, metadata={"Software": None})
    charts.plt.close(figure)
    return _uri(buffer.getvalue(), "png")


def _uri(image: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
