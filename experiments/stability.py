"""In which regimes do the methods of jaxvol fail, and what does jaxvol do there?

The failure atlas. An entry (`experiments.atlas`) names a method, sweeps one regime from harmless to
harmful, and measures an error. Its edge lies between the last value at which the error is within a stated
limit and the first at which it is not. What jaxvol does beyond: *bounded*, the error cannot occur, so there
is no edge in the sweep; *detected and said*, an error, a warning or an output of the rendering says so;
*documented*, a docstring states it; *fails*, none of these.

Besides the record and the chart this writes `stability.html`, a page with the question, the curve and the
edge of each entry, and pictures on both sides of it where the image itself is what is measured.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from . import record
from .atlas import ENTRIES, FAMILIES
from .atlas.entry import pictured, sweep
from .atlas.page import chart, keep, page
from .harness import experiment, recorded, show, some_of


ABOUT = ("question", "method", "regime", "metric", "judged", "limit", "outcome", "does", "size")


def draw(result: dict[str, Any], path: Path) -> None:
    """The chart of all entries, and the page beside it, with the pictures that the experiment left there."""
    entries, pictures = result["entries"], path.parent / "stability"
    chart(ENTRIES, entries, path)
    families = {family: [e for e in row if e.name in entries] for family, row in FAMILIES.items()}
    text = page(families, entries, pictures if pictures.is_dir() else record.RESULTS / "stability")
    path.with_suffix(".html").write_text(text, encoding="utf-8")


@experiment(
    draw,
    only=some_of(ENTRIES, "ENTRY"),
    picture={"type": int, "default": 96, "help": "pixels along a side of pictures"},
    quick={"picture": 64},
)
def main(chosen: Namespace) -> dict[str, Any]:
    if chosen.quick and chosen.only == list(ENTRIES):  # one of each family, since all take minutes to compile
        chosen.only = [family[0].name for family in FAMILIES.values()]
    entries: dict[str, Any] = {}
    for name in chosen.only:
        entry = ENTRIES[name]
        found = sweep(entry, entry.size, entry.values[:: len(entry.values) - 1] if chosen.quick else None)
        if entry.picture is not None:
            images = [entry.picture(value, chosen.picture) for value in pictured(entry, found)]
            keep(entry, images, chosen.output / "stability")
        entries[name] = found | {key: getattr(entry, key) for key in ABOUT}
        show({name: found["edge"]})
    entries |= recorded(chosen, "entries", [name for name in ENTRIES if name not in entries])
    return {"entries": {name: entries[name] for name in ENTRIES if name in entries}}


if __name__ == "__main__":
    main()
