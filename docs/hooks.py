"""What the documentation takes from the rest of the repository, so that nothing is written twice.

- Documents and pictures outside `docs/` become part of the site, at their own paths. Links work in both
  places: a page of `docs/` names `../paper_figs/README.md`, as it must where the repository is read.
- Charts and pages of records are drawn from these, as `python -m experiments.redraw` does.
- `<!-- section FILE: HEADING -->` is replaced by the text under that heading of a Markdown file.
- `<!-- table NAME -->` is replaced by a table: `failures` and `pictures` from the failure atlas' record,
  `records` from all, `references` from CITATION.cff, the others from docstrings (`docs/registry.py`).
"""

import json
import os
import posixpath
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from mkdocs.structure.files import File


ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from docs import registry  # noqa: E402


DOCS = "docs"
OUTSIDE = (
    "CONTRIBUTING.md",
    "CITATION.cff",
    "jaxvol/**/*.py",
    "notebooks/*.ipynb",
    "experiments/**/*.py",
    "experiments/results/*.md",
    "experiments/results/*.png",
    "experiments/results/*.webp",
    "experiments/results/stability/*.webp",
    "paper_figs/README.md",
    "paper_figs/output/*.webp",
)
"""Files outside `docs/` that become part of the site."""

SMALL = ("features.md",)
"""Pages of many pictures, which are shown small."""

SECTION = re.compile(r"^<!-- section (\S+): (.+?) -->$", re.MULTILINE)
TABLE = re.compile(r"^<!-- table (\w+) -->$", re.MULTILINE)
LINK = re.compile(r"(!?\[((?:[^\[\]]|!\[[^\]]*\]\([^)]*\))*)\])\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")
PICTURE = re.compile(r"^(!\[[^\]]*\]\(([^)\s]+)\))$", re.MULTILINE)
FENCE = re.compile(r"(^ *```.*?^ *```$)", re.DOTALL | re.MULTILINE)


def on_files(files: Any, config: Any) -> Any:
    for pattern in OUTSIDE:
        for path in sorted(ROOT.glob(pattern)):
            name = path.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))
    there = {file.src_uri for file in files}
    for path in sorted(Path(drawn().name).iterdir()):
        if (name := f"experiments/results/{path.name}") not in there:
            files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


@cache
def drawn() -> "TemporaryDirectory[str]":
    """A folder, until the end of this process, of the charts and pages of all records."""
    folder = TemporaryDirectory()
    command = [sys.executable, "-m", "experiments.redraw", "--output", folder.name]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return folder


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    here, markdown = page.file.src_uri, registry.with_entries(markdown)
    outside = not (ROOT / DOCS / here).is_file()
    names = {file.src_uri for file in files}
    markdown = relinked(markdown, here if outside else f"{DOCS}/{here}", here, names)
    markdown = SECTION.sub(lambda m: relinked(section(m[1], m[2]), m[1], here, names), markdown)
    size = "{ .small }" if here in SMALL else ""
    markdown = PICTURE.sub(rf"[\1](\2){size}", markdown)  # a click shows it in full size
    return TABLE.sub(lambda m: TABLES[m[1]](), markdown)


def section(file: str, heading: str) -> str:
    """The text under a heading of a Markdown file, up to the next heading of its level or above."""
    text = (ROOT / file).read_text(encoding="utf-8")
    found = re.search(rf"^(#+) {re.escape(heading)}\n", text, re.MULTILINE)
    if found is None:
        raise ValueError(f"{file} has no heading {heading!r}.")
    code = [match.span() for match in FENCE.finditer(text)]
    for end in re.finditer(rf"^#{{1,{len(found[1])}}} ", text, re.MULTILINE):
        if end.start() >= found.end() and not any(a <= end.start() < b for a, b in code):
            return text[found.end() : end.start()].strip()
    return text[found.end() :].strip()


def relinked(text: str, source: str, page: str, names: set[str]) -> str:
    """The text of the file `source` of the repository, with its links as the site's `page` needs them. Links
    to files that are not part of the site become their names; MkDocs reports those that lead nowhere."""

    def link(found: re.Match[str]) -> str:
        shown, label, target, anchor = found[1], found[2], found[3], found[4] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        name = path.removeprefix(f"{DOCS}/")
        if name in names:
            return f"{shown}({posixpath.relpath(name, posixpath.dirname(page) or '.')}{anchor})"
        if not (ROOT / path).exists():
            return found[0]
        return label if label.strip("`").rstrip("/") == path else f"{label} (`{path}`)"

    parts = FENCE.split(text)
    parts[::2] = [LINK.sub(link, part) for part in parts[::2]]
    return "".join(parts)


def atlas() -> dict[str, Any]:
    """The entries of the failure atlas, as recorded."""
    record = json.loads((ROOT / "experiments/results/stability.json").read_text(encoding="utf-8"))
    return record["result"]["entries"]


def pictures() -> str:
    """The pictures of the failure atlas: one row an entry, on both sides of its edge."""
    lines = ["| entry | within the limit | beyond it |", "|---|---|---|"]
    for name, entry in atlas().items():
        if "pictured" in entry:
            file = f"experiments/results/stability/{name.replace(' ', '-')}"
            cells = [f"{name}<br>{entry['shows']}"]
            for number, value in enumerate(entry["pictured"], 1):
                cells.append(f"![{entry['shows']}]({file}.{number}.webp)<br>{entry['regime']}: {value:.4g}")
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def failures() -> str:
    """The failure atlas, one row an entry."""
    lines = ["| entry | question | edge | beyond it |", "|---|---|---|---|"]
    for name, entry in atlas().items():
        within, beyond = entry["edge"]["within"], entry["edge"]["beyond"]
        if beyond is None:
            edge = "none in the sweep"
        elif within is None:
            edge = f"before {beyond:.4g}"
        else:
            edge = f"between {within:.4g} and {beyond:.4g}"
        method = entry["method"].replace("jaxvol.", "")
        cells = f"{name}<br>`{method}`", entry["question"], f"{edge} ({entry['regime']})"
        lines.append(f"| {' | '.join(cells)} | *{entry['outcome']}.* {entry['does']} |")
    return "\n".join(lines)


def references() -> str:
    """The papers of CITATION.cff."""
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    lines = ["| source | used by |", "|---|---|"]
    for work in cited["references"]:
        people = ", ".join(f"{a['given-names']} {a['family-names']}" for a in work["authors"])
        parts = [
            work.get("journal") or work.get("collection-title") or work.get("institution", {}).get("name")
        ]
        if "volume" in work:
            issue = f"({work['issue']})" if "issue" in work else ""
            pages = f", {work['start']}–{work['end']}" if "start" in work else ""
            parts.append(f"{work['volume']}{issue}{pages}")
        parts.append(str(work["year"]) if "year" in work else None)
        url = f"https://doi.org/{work['doi']}" if "doi" in work else work.get("url")
        title = f"[{work['title']}]({url})" if url else work["title"]
        place = ", ".join(part for part in parts if part)
        lines.append(f"| {people}: {title}. {place} | {work['notes']} |")
    return "\n".join(lines)


def records() -> str:
    """A table of what was measured at which commit, on which machine, and how."""
    lines = ["| record | commit | commits since | machine | command |", "|---|---|---|---|---|"]
    for file in sorted((ROOT / "experiments/results").glob("*.json")):
        found = json.loads(file.read_text(encoding="utf-8"))
        device = found["device"]
        parts = [part for part in merged(found["result"]) if part[0] != found["commit"]]
        machine = device["kind"] if device["platform"] != "cpu" else device.get("processor", "CPU")
        commits = {found["commit"], *(commit for commit, _ in parts)}
        since = max((commits_since(commit.rstrip("+")) for commit in commits), key=lambda n: int(n or 0))
        told = "; ".join([f"`{found['commit']}`", *(part for _, part in parts)])
        lines.append(f"| {file.stem} | {told} | {since} | {machine} | `{found['command']}` |")
    return "\n".join(lines)


def merged(result: Any, name: str = "parts") -> Iterator[tuple[str, str]]:
    """The commits at which parts of a result were measured, where they are named, with how many parts."""
    pairs = result.items() if isinstance(result, dict) else ()
    rows = {key: row for key, row in pairs if isinstance(row, dict)}
    counts = Counter(row["measured"]["commit"] for row in rows.values() if "measured" in row)
    for commit, count in counts.items():
        yield commit, f"{count} of {len(rows)} {name} of `{commit}`"
    for key, row in rows.items():
        if "measured" not in row:
            yield from merged(row, key)


def commits_since(commit: str) -> str:
    """How many commits lie behind one; nothing where that is not known, as in a copy without history."""
    command = ["git", "rev-list", "--count", f"{commit}..HEAD"]
    try:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


TABLES = {"failures": failures, "pictures": pictures, "records": records, "references": references}
TABLES |= {"transforms": registry.transforms, "modes": registry.modes}


def on_post_build(config: Any) -> None:
    """The site needs no list of its pages for search engines, whose dates differ from build to build."""
    for name in ("sitemap.xml", "sitemap.xml.gz"):
        path = Path(config["site_dir"]) / name
        if path.exists():
            os.remove(path)
