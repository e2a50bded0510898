"""Draws charts and pages from their records; nothing is measured.

`python -m experiments.redraw` draws all, `--only speed kisti` some. They are not kept beside the records, and
the documentation draws its own; pictures of scenes are. `pareto.html` has those that were left here.

To measure a result again, run the `command` of its record, on a machine that does nothing else; at its
commit, if its experiment is in the tree no longer.
"""

import re
from argparse import Namespace
from pathlib import Path

from . import charts, record
from .harness import command, some_of


def is_drawn(name: str) -> bool:
    """Whether the experiment of a record is in the tree, and draws it from what it holds."""
    module = record.read(record.RESULTS / f"{name}.json")["command"].split()[2]
    file = Path(__file__).parent.parent / f"{module.replace('.', '/')}.py"
    return file.is_file() and bool(
        re.search(r"^(def )?draw\b", file.read_text(encoding="utf-8"), re.MULTILINE)
    )


NAMES = sorted(file.stem for file in record.RESULTS.glob("*.json"))
DRAWN = [name for name in NAMES if is_drawn(name)]


@command(
    __doc__,
    record.RESULTS,
    results={"type": Path, "default": record.RESULTS, "metavar": "FOLDER", "help": "that of the records"},
    only=some_of(DRAWN, "NAME"),
)
def main(chosen: Namespace) -> None:
    for name in chosen.only:
        file = chosen.results / f"{name}.json"
        if not file.is_file():
            raise ValueError(f"--results must hold the record {name}.json; {chosen.results} does not.")
        charts.draw_record(file, chosen.output / f"{name}.png")
        print(chosen.output / f"{name}.png")


if __name__ == "__main__":
    main()
