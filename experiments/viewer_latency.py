"""How long after the pointer moves does the viewer's coarse image follow, in either face?

Headless Chromium shows each face, on the same machine as the viewer: it draws without a GPU and takes its
share of the cores. A move of the pointer is timed from the browser's event until the next coarse image is
there: in the notebook, until the `<img>` has loaded it; on the page, until it has arrived (the browser
decodes it and draws it after that). Moves come at rest; while a fine image is being drawn; and 60 times a
second, in a drag.
"""

import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.app.viewer.tiles import SIDE
from tests.app.viewer.notebook_server import notebook
from tests.browser import Page, opened

from . import charts
from .harness import experiment, show


GOAL = 0.15
"""Seconds."""

SECONDS = 300
"""Longest wait."""

REST = "document.body.innerText.includes('(estimate)')"

HOOK = """
window.moves = []; window.images = [];
addEventListener('pointermove', () => moves.push(performance.now()), true);
const arrived = width => requestAnimationFrame(() => images.push([performance.now(), width]));
const watched = image => image.addEventListener('load', () => arrived(image.naturalWidth));
const jpegWidth = bytes => {
  if (!bytes) return 0;
  let i = 2;
  while (bytes[i + 1] < 0xc0 || bytes[i + 1] > 0xc2) i += 2 + bytes[i + 2] * 256 + bytes[i + 3];
  return bytes[i + 7] * 256 + bytes[i + 8];
};
const messages = data => Array.isArray(data) ? data : data?.messages ?? [data];
window.Worker = class extends Worker {
  constructor(...how) {
    super(...how);
    this.addEventListener('message', event => {
      for (const each of messages(event.data))
        if (each?.type == 'BackgroundImageMessage') arrived(jpegWidth(each.rgb_data));
    });
  }
};
"""
"""Notes when the pointer moves and when images arrive, and how wide these are."""


class Watched:
    """A face that is timed. `middle`: of its image, (x, y)."""

    def __init__(self, page: Page, middle: tuple[float, float]):
        self.page, self.middle = page, middle

    def rest(self) -> None:
        self.page.wait_for(REST, SECONDS)
        time.sleep(1)

    def move(self, x: float) -> None:
        """Move the pointer to this many pixels beside the middle; the button is down."""
        self.page.mouse("Moved", self.middle[0] + x, self.middle[1], button="left", buttons=1)

    def measure(self, repetitions: int) -> dict[str, Any]:
        """Seconds until coarse images follow."""
        self.rest()
        self.page.mouse("Pressed", *self.middle, button="left", buttons=1, clickCount=1)
        for number in range(40):  # until the pace has settled
            self.move(number % 20)
            time.sleep(0.05)
        found: dict[str, Any] = {}
        for name, pause in (("at rest", None), ("while a fine image is drawn", 0.4)):
            seconds = []
            for number in range(repetitions):
                self.rest() if pause is None else time.sleep(pause)
                seconds.append(self._follows(15 * (1 + number % 2)))
            found[name] = summary(seconds)
        found["between images of a drag"] = summary(self._drag())
        self.page.mouse("Released", *self.middle, button="left", clickCount=1)
        widths = [width for _, width in self.page.evaluate("images") if width % SIDE == 0]
        return found | {"coarse images are this wide": max(set(widths), key=widths.count)}

    def _follows(self, x: float) -> float:
        self.page.evaluate("moves.length = images.length = 0")
        self.move(x)
        coarse = f"images.find(each => each[0] > moves[0] && each[1] % {SIDE} == 0)"
        arrived, _ = self.page.wait_for(coarse, SECONDS)
        return (arrived - self.page.evaluate("moves[0]")) / 1000

    def _drag(self) -> list[float]:
        self.page.evaluate("moves.length = images.length = 0")
        begun = time.monotonic()
        for number in range(180):
            self.move(number / 2)
            time.sleep(max(0, begun + (number + 1) / 60 - time.monotonic()))
        images = self.page.evaluate("images.filter(each => each[0] < moves.at(-1)).map(each => each[0])")
        return (np.diff(images) / 1000).tolist()


def summary(seconds: list[float]) -> dict[str, Any]:
    low, middle, high = np.quantile(seconds, (0.1, 0.5, 0.9))
    numbers = {"median": middle, "10 %": low, "90 %": high, "most": max(seconds)}
    return {k: round(float(v), 4) for k, v in numbers.items()} | {"all": [round(s, 4) for s in seconds]}


@contextmanager
def in_notebook(file: Path, folder: Path, *, lit: bool) -> Iterator[Watched]:
    look = 'jv.preset("head", unit_distance=0.01)'
    cells = ["import jaxvol as jv", f"v = jv.view(jv.load({str(file)!r}), {look}, lit={lit})", "v"]
    with notebook(cells, folder) as page:
        page.wait_for("document.querySelector('.renderview-view') && true", SECONDS)
        image = "document.querySelector('.renderview-view')"
        page.evaluate(f"{image}.scrollIntoView({{block: 'center'}})")
        page.evaluate(f"{HOOK}; watched({image}); 1")
        yield Watched(page, _middle(page, image))


@contextmanager
def on_page(file: Path, folder: Path, *, lit: bool) -> Iterator[Watched]:
    transfer = jv.write_transfer(folder / "look.json", jv.preset("head", unit_distance=0.01))
    command = [
        "view",
        str(file),
        "--transfer",
        str(transfer),
        "--no-browser",
        *([] if lit else ["--no-shade"]),
    ]
    server = subprocess.Popen([sys.executable, "-m", "jaxvol", *command], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        url = server.stdout.readline().split()[1]
        # the panel takes 384 pixels
        with opened(url, 640 + 384, 480 + 140, HOOK) as page:
            page.wait_for("document.body.innerText.includes('march and light')", SECONDS)
            yield Watched(page, _middle(page, "document.querySelector('canvas')"))
    finally:
        server.kill()
        server.wait()


def _middle(page: Page, element: str) -> tuple[float, float]:
    x, y, width, height = page.evaluate(
        f"(r => [r.x, r.y, r.width, r.height])({element}.getBoundingClientRect())"
    )
    return x + width / 2, y + height / 2


FACES = {"notebook": in_notebook, "page": on_page}


def draw(result: dict[str, Any], path: Path) -> None:
    """A dot for each time, a bar at the median."""
    figure, ((panel,),) = charts.panels(1, 1, 9, 4.2)
    labels, place = [], 0
    for face, lights in result["faces"].items():
        for light, kinds in lights.items():
            for kind in ("at rest", "while a fine image is drawn", "between images of a drag"):
                seconds = 1000 * np.array(kinds[kind]["all"])
                panel.plot(seconds, np.full(len(seconds), place), "o", color="tab:blue", alpha=0.35, ms=5)
                panel.plot(np.median(seconds), place, "|", color="black", ms=16, mew=2)
                labels.append(f"{face}, {light}: {kind}")
                place += 1
    panel.axvline(1000 * result["goal"], color="tab:red", ls="--")
    panel.text(1000 * result["goal"], -0.8, "goal", color="tab:red", ha="center")
    panel.set_yticks(range(len(labels)), labels)
    panel.invert_yaxis()
    panel.set_xlim(left=0)
    panel.set_xlabel("milliseconds (black: median)")
    voxels = result["voxels"]
    figure.suptitle(
        f"From a move of the pointer to the viewer's next coarse image, {voxels}³ voxels on two cores;\n"
        "in a drag, from one image to the next"
    )
    charts.save(figure, path)


@experiment(
    "viewer_latency",
    "How long after the pointer moves does the viewer's coarse image follow?",
    __doc__,
    draw,
    resolution=256,
    repetitions=12,
    quick={"resolution": 48, "repetitions": 2},
)
def main(chosen: Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = jv.save(jv.phantom("head", chosen.resolution), folder / "head.npz")
        for face, shown in FACES.items():
            found[face] = {}
            for light, lit in (("unlit", False), ("lit", True)):
                own = folder / f"{face} {light}"
                own.mkdir()
                with shown(file, own, lit=lit) as watched:
                    found[face][light] = watched.measure(chosen.repetitions)
        show(found)
    return {"voxels": chosen.resolution, "goal": GOAL, "faces": found}


if __name__ == "__main__":
    main()
