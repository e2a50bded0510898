"""What documents and tests know of transforms and modes: the public classes of `jaxvol/__init__.pyi`, and
their docstrings, so that nothing is listed twice.

`python -m docs.registry` writes the table of transforms in README anew.
"""

import inspect
import re
from pathlib import Path
from typing import Any

import jaxvol as jv
from jaxvol.compositing.modes import MODES


README = Path(__file__).parent.parent / "README.md"
ENTRIES = re.compile(r"^<!-- entries (\w+) -->$", re.MULTILINE)
KEPT = re.compile(r"(?<=<!-- table transforms -->\n).*?(?=<!-- end -->)", re.DOTALL)
SEAMS = "locate", "clip", "start", "shift", "empty_space", "cut", "stop"
"""Methods of `Transform`, in the order in which a march asks them."""


def subclasses(base: type) -> list[type[Any]]:
    """Public classes that are finished subclasses of a public one."""
    public = [getattr(jv, name) for name in dir(jv)]
    kinds = [kind for kind in public if inspect.isclass(kind) and issubclass(kind, base)]
    return [kind for kind in kinds if kind is not base and not inspect.isabstract(kind)]


def with_entries(markdown: str) -> str:
    """A page of the reference, with entries of all subclasses in place of `<!-- entries BASE -->`."""

    def entries(base: re.Match[str]) -> str:
        kinds = subclasses(getattr(jv, base[1]))
        return "\n".join(f"::: {k.__module__}.{k.__name__}\n    options: {{members: false}}" for k in kinds)

    return ENTRIES.sub(entries, markdown)


def summary(kind: type) -> str:
    """How a docstring begins: its first paragraph."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split()).rstrip(".")


def paragraph(kind: type, name: str) -> str:
    """The part of a docstring behind `name:`, up to the end of its paragraph, in one line."""
    found = re.search(rf"(?<={name}: ).*?(?=\n\n|\Z)", inspect.getdoc(kind) or "", re.DOTALL)
    return " ".join(found[0].split()).rstrip(".") if found else ""


def table(*rows: tuple[str, ...]) -> str:
    """A Markdown table, its head first."""
    head, *others = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join((head, "|---" * len(rows[0]) + "|", *others))


def of_readme() -> str:
    """Transforms, what they do, and their sources."""
    rows = [(f"`{k.__name__}`", summary(k), paragraph(k, "Source")) for k in subclasses(jv.Transform)]
    return table(("transform of a march", "what it does", "source"), *rows)


def transforms() -> str:
    """The same, with the seams that they override, and where they fail."""
    rows = [("transform", "seam", "what it does", "source", "entries of [the failure atlas](failures.md)")]
    for kind in subclasses(jv.Transform):
        seams = [f"`{seam}`" for seam in SEAMS if getattr(kind, seam) is not getattr(jv.Transform, seam)]
        fails = ", ".join(re.findall(r'"([^"]+)"', paragraph(kind, "Where it fails")))
        rows.append((f"`{kind.__name__}`", ", ".join(seams), summary(kind), paragraph(kind, "Source"), fails))
    return table(*rows)


def modes() -> str:
    """Compositing modes, by name where they have one."""
    names = {kind: f'`"{name}"`, ' for name, kind in MODES.items()}
    rows = [
        (f"{names.get(kind, '')}`{kind.__name__}`", summary(kind), paragraph(kind, "Source"))
        for kind in subclasses(jv.Compositing)
    ]
    return table(("mode", "what a pixel shows", "source"), *rows)


if __name__ == "__main__":
    text = README.read_text(encoding="utf-8")
    README.write_text(KEPT.sub(lambda _: of_readme() + "\n", text), encoding="utf-8")
