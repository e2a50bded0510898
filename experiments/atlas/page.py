"""The failure atlas as one page: plain HTML, its images embedded, without scripts."""

import base64
import html
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import jaxvol as jv
from jaxvol._util.whole_files import whole_file

from ..common import plt
from .entry import Entry, pictured


SOURCES = "../../"
"""From the folder of records to the root, where `jaxvol/` is."""
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

Chart = Callable[[Any, Entry, dict[str, Any]], None]


def page(
    families: dict[str, list[Entry]],
    found: dict[str, dict[str, Any]],
    pictures: Path,
    chart: Chart,
) -> str:
    """The page of all entries in `found`. `pictures`: the folder in which `keep` left theirs."""
    body = ["<h1>Failure atlas</h1>", f"<p>{INTRODUCTION}</p>", _contents(families, found)]
    for family, entries in families.items():
        if entries:
            body.append(f"<h2>{html.escape(family)}</h2>")
        body += [_entry(e, found[e.name], pictures, chart) for e in entries]
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


def _entry(entry: Entry, found: dict[str, Any], pictures: Path, chart: Chart) -> str:
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
        f'<div class="parts"><figure><img src="{_chart(entry, found, chart)}" alt="curve"></figure>'
        f"{figures}</div>\n"
        f"<p><small>Pictures: {html.escape(entry.shows)}.</small></p>"
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


def _chart(entry: Entry, found: dict[str, Any], chart: Chart) -> str:
    figure, panel = plt.subplots(figsize=(4.2, 3.0), layout="constrained")
    chart(panel, entry, found)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, metadata={"Software": None})
    plt.close(figure)
    return _uri(buffer.getvalue(), "png")


def _uri(image: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
