"""In which regimes do the methods of jaxvol fail, and what does jaxvol do there?

The failure atlas. An entry (`experiments.atlas`) names a method, sweeps one regime from harmless to
harmful, and measures an error. Its edge lies between the last value at which the error is within a stated
limit and the first at which it is not. What jaxvol does beyond: *bounded*, the error cannot occur, so there
is no edge in the sweep; *detected and said*, an error, a warning or an output of the rendering says so;
*documented*, a docstring states it; *fails*, none of these.

Beside the record and the chart, the folder `stability` holds pictures on both sides of an edge, where an
image is what is measured. The documentation's page of failures shows all of it.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import jaxvol as jv
from jaxvol._util.whole_files import whole_file

from .atlas import ENTRIES, FAMILIES
from .atlas.chart import chart
from .atlas.entry import Entry, pictured, sweep
from .harness import experiment, recorded, show, some_of


ABOUT = ("question", "method", "regime", "metric", "judged", "limit", "outcome", "does", "shows", "size")


def draw(result: dict[str, Any], path: Path) -> None:
    chart(ENTRIES, result["entries"], path)


def keep(entry: Entry, values: tuple[float, float], size: int, folder: Path) -> None:
    """Write the pictures of an entry at two values of its regime."""
    assert entry.picture is not None
    folder.mkdir(exist_ok=True)
    for number, value in enumerate(values, 1):
        image = np.clip(entry.picture(value, size), 0, 1)
        levels = np.round(255 * np.asarray(jv.to_srgb(image))).astype(np.uint8)
        with whole_file(folder / f"{entry.name.replace(' ', '-')}.{number}.webp") as part:
            Image.fromarray(levels).save(part, "WEBP", lossless=True)


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
            found["pictured"] = pictured(entry, found)
            keep(entry, found["pictured"], chosen.picture, chosen.output / "stability")
        entries[name] = found | {key: getattr(entry, key) for key in ABOUT}
        show({name: found["edge"]})
    entries |= recorded(chosen, "entries", [name for name in ENTRIES if name not in entries])
    return {"entries": {name: entries[name] for name in ENTRIES if name in entries}}
