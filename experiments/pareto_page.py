"""Writes the page of a `pareto` record: one HTML file without network, with the picture behind each point.

It is made from the record and the small pictures beside it alone; nothing is measured. Where pictures of a
scene are not there, those of the page that is replaced are taken. `pareto_page.html` is the page without its
data.
"""

import base64
import json
from argparse import Namespace
from pathlib import Path
from typing import Any

from . import record
from .command import command
from .pareto_chart import COLORS, MARKS
from .pareto_measure import AMPLIFIED, slug


TEMPLATE = Path(__file__).with_suffix(".html")
DATA = "/*DATA*/"
SHOWN = {"family": "f", "time": "t", "rmse": "e", "psnr": "p", "ssim": "s", "wood grain": "w", "command": "c"}
"""What the page knows of a point, and how its data call it."""


def write(path: Path, pictures: Path, page: Path) -> Path:
    """Write the page of a record.

    - `pictures`: the folder with a folder of pictures for each scene.
    """
    found, earlier = record.read(path), pictures_of(page)
    result = found.pop("result")
    data = {
        "about": found,
        "amplified": AMPLIFIED,
        "colors": COLORS,
        "marks": MARKS,
        "summary": result["summary"],
        "peers": result["peers"],
        "repetitions": result["repetitions"],
        "scenes": [
            scene(name, each, pictures / slug(name), earlier.get(name, {}))
            for name, each in result["scenes"].items()
        ],
    }
    # "</script>" in a string would end the script
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("</", "<\\/")
    page.write_text(TEMPLATE.read_text(encoding="utf-8").replace(DATA, text), encoding="utf-8")
    return page


def pictures_of(page: Path) -> dict[str, dict[str, str | None]]:
    """By scene, the pictures that a page holds: of each point, and of the reference under ""."""
    before, after = TEMPLATE.read_text(encoding="utf-8").split(DATA)
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    if not (text.startswith(before) and text.endswith(after)):
        return {}
    scenes = json.loads(text[len(before) : len(text) - len(after)])["scenes"]
    return {s["name"]: {"": s["image"], **{point["n"]: point["i"] for point in s["points"]}} for s in scenes}


def scene(name: str, found: dict[str, Any], pictures: Path, earlier: dict[str, str | None]) -> dict[str, Any]:
    """What the page shows of a scene. `earlier`: pictures to take where there are no newer ones."""
    points = [
        {
            "n": point,
            **{short: rounded(row[long]) for long, short in SHOWN.items()},
            "i": embedded(pictures / f"{slug(point)}.webp") or earlier.get(point),
        }
        for point, row in found["points"].items()
    ]
    kept = (
        "view",
        "look",
        "lit",
        "toroidal",
        "pixels",
        "reference",
        "gradients",
        "their points that it is not",
    )
    about = {key: found[key] for key in kept if key in found}
    image = embedded(pictures / "reference.webp") or earlier.get("")
    return {"name": name, **about, "image": image, "points": points}


def rounded(value: Any) -> Any:
    """Numbers to four digits, which is more than the page shows."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def embedded(file: Path) -> str | None:
    """A picture as text; None if it is not there."""
    return base64.b64encode(file.read_bytes()).decode() if file.is_file() else None


@command(__doc__, record.RESULTS)
def main(chosen: Namespace) -> None:
    folder = chosen.output
    print(write(folder / "pareto.json", folder / "pareto", folder / "pareto.html"))


if __name__ == "__main__":
    main()
