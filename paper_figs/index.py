"""Every figure and table of the papers on one page, each beside what its paper reports.

What experiments measured is drawn from their records, and tables are written anew; pictures of scenes, which
take minutes to render, are those that were kept. With `run`, all is made again: experiments are measured,
scenes rendered.
"""

import html
import importlib
import io
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from itertools import starmap
from pathlib import Path

from experiments import harness, record
from experiments.charts import whole_file

from .common import OUTPUT
from .contents import ENTRIES, PAPERS, Entry
from .pictures import PICTURES
from .records import RECORDS


FIGURES = PICTURES | RECORDS
"""What makes each figure and table, by name."""

STYLE = """
body { font: 16px/1.45 sans-serif; max-width: 74rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
nav { font-size: 0.9rem } nav p { margin: 0.3rem 0 }
h2 { border-bottom: 1px solid #bbb; margin-top: 3rem } h3 { margin: 2.2rem 0 0.4rem }
.said { display: grid; grid-template-columns: 1fr 1fr; gap: 0 2rem } .said p { margin: 0.2rem 0 0.8rem }
.said b { display: block; font-size: 0.8rem; color: #666 }
img { max-width: 100%; border: 1px solid #ddd } .wide { overflow-x: auto }
table { border-collapse: collapse; font-size: 0.8rem } td, th { padding: 0.15rem 0.7rem; text-align: left }
td:first-child, th:first-child { white-space: nowrap }
tr:nth-child(even) { background: #f3f3f3 } small { color: #666 } code { font-size: 0.85em }
@media (max-width: 50rem) { .said { grid-template-columns: 1fr } }
"""


KEPT = (
    "Each figure and table stands below what its paper reports, and what to look at in ours. Charts and "
    "tables are made from the records of experiments; pictures of scenes, which take minutes to render, are "
    "those that were kept. A click shows a picture in full size. The energy of wood grain is a little above "
    "or below 0 where there is none. `jaxvol figures --run` measures and renders all of it anew."
)
ANEW = (
    "Each figure and table stands below what its paper reports, and what to look at in ours. All of it was "
    "measured and rendered for this page."
)
"""The first lines of the page."""


def make(
    folder: Path,
    *,
    results: Path = record.RESULTS,
    run: bool = False,
    only: Sequence[str] = (),
    quick: bool = False,
    say: Callable[[str], None] = print,
) -> Path:
    """Make all figures and tables, and the page. Returns the page.

    Args:
        folder: where they are written. With `run`, new records go into `folder`/results. Scenes of real
            volumes are then rendered from the folder JAXVOL_DATA, or, without one, from phantoms.
        results: of the records, without `run`.
        run: measure experiments and render scenes.
        only: names of entries; by default all.
        quick: with `run`: tiny sizes, to see that everything works.
        say: is told what is done.
    """
    known = [entry.name for entry in ENTRIES]
    if wrong := [name for name in only if name not in known]:
        raise ValueError(f"--only must be some of {', '.join(known)}; got {', '.join(wrong)}.")
    entries = [entry for entry in ENTRIES if not only or entry.name in only]
    folder.mkdir(parents=True, exist_ok=True)
    if run:
        results = folder / "results"
        _measure(entries, results, quick, say)
    for number, entry in enumerate(entries, 1):
        say(f"[{number}/{len(entries)}] {entry.name}")
        with redirect_stdout(sys.stdout if run else io.StringIO()):  # what is printed is in the file
            _draw(entry, folder, results, run, quick)
    page = folder / "index.html"
    with whole_file(page) as part:
        part.write_text(_page(entries, folder, results, run), encoding="utf-8")
    return page


def _measure(entries: Sequence[Entry], results: Path, quick: bool, say: Callable[[str], None]) -> None:
    for name in sorted({entry.record for entry in entries if entry.record}):
        say(f"measuring experiments.{name}")
        options = ["--quick"] if quick else []
        importlib.import_module(f"experiments.{name}").main(["--output", str(results), *options])


def _draw(entry: Entry, folder: Path, results: Path, run: bool, quick: bool) -> None:
    given = ["--output", str(folder)]
    if entry.record:
        FIGURES[entry.name]([*given, "--results", str(results)])
    elif run:
        folder_of_data = None if quick else harness.data()
        real = ["--data", str(folder_of_data)] if folder_of_data and entry.data else []
        FIGURES[entry.name]([*given, *real, *(["--quick"] if quick else [])])
    elif folder.resolve() != OUTPUT.resolve():
        shutil.copyfile(OUTPUT / entry.file, folder / entry.file)


def _page(entries: Sequence[Entry], folder: Path, results: Path, run: bool) -> str:
    of_papers = {title: [e for e in entries if e.paper == paper] for paper, title in PAPERS.items()}
    of_papers = {title: found for title, found in of_papers.items() if found}
    body = ["<h1>Figures and tables of the papers</h1>", f"<p>{_text(ANEW if run else KEPT)}</p>"]
    body += [f"<nav>{''.join(starmap(_links, of_papers.items()))}</nav>"]
    for title, found in of_papers.items():
        body += [f"<h2>{html.escape(title)}</h2>", *(_section(e, folder, results, run) for e in found)]
    head = f'<meta charset="utf-8"><title>jaxvol: figures of the papers</title><style>{STYLE}</style>'
    text = "\n".join(body)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{text}\n</body></html>\n'


def _links(title: str, entries: Sequence[Entry]) -> str:
    """A paper's line in the contents: links to its figures and tables."""
    links = (f'<a href="#{e.name}">{html.escape(e.title.split(":")[0])}</a>' for e in entries)
    return f"<p>{html.escape(title)}<br>{', '.join(links)}</p>\n"


def _section(entry: Entry, folder: Path, results: Path, run: bool) -> str:
    said = [("the paper", entry.reported), ("jaxvol", entry.ours)]
    parts = "".join(f"<div><b>{who}</b><p>{_text(what)}</p></div>" for who, what in said if what)
    if entry.file.endswith(".md"):
        shown = f'<div class="wide">{tables((folder / entry.file).read_text(encoding="utf-8"))}</div>'
    else:
        shown = f'<a href="{entry.file}"><img src="{entry.file}" alt="{html.escape(entry.title)}"></a>'
    return (
        f'<h3 id="{entry.name}">{html.escape(entry.title)}</h3>\n<div class="said">{parts}</div>\n{shown}\n'
        f"<p><small>{_text(origin(entry, results, run))}</small></p>"
    )


def origin(entry: Entry, results: Path, run: bool) -> str:
    """How a figure came about, and the command that makes it again."""
    command = f"`python -m paper_figs {entry.name}{' --data FOLDER' if entry.data else ''}`"
    if entry.record:
        found = record.read(results / f"{entry.record}.json")
        device = found["device"]
        return (
            f"{command}, from the record of `{found['command']}`: commit {found['commit']}, "
            f"{device['processor']}, {device['cores']} cores, JAX {found['versions']['jax']}."
        )
    return f"{command}, rendered for this page." if run else f"A picture that was kept; {command} renders it."


def _text(text: str) -> str:
    """Text with `code` marked, as HTML."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(text))


def tables(text: str) -> str:
    """The Markdown tables of a text, as HTML."""
    found: list[str] = []
    for block in text.strip().split("\n\n"):
        head, _, *rows = [line.strip().strip("|").split("|") for line in block.splitlines()]
        lines = [_row(head, "th"), *(_row(row, "td") for row in rows)]
        found.append("<table>\n" + "\n".join(lines) + "\n</table>")
    return "<br>\n".join(found)


def _row(cells: Sequence[str], tag: str) -> str:
    marked = (re.sub(r"^\*(.+)\*$", r"<i>\1</i>", html.escape(cell.strip())) for cell in cells)
    return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in marked) + "</tr>"
