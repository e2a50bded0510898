"""How long after the pointer moves does the viewer's coarse image follow, on real volumes at defaults?

Headless Chromium shows the page of `jaxvol view FILE`, for volumes of the folder `JAXVOL_DATA`, on the same
machine: it draws without a GPU and takes its share of the cores. The clock is the browser's, from
`pointermove` until a coarse image has arrived and a frame begins. Moves come at rest; while a fine image is
drawn; and 60 times a second in a drag, of which the times from image to image are noted.
"""

import os
import socket
import subprocess
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from jaxvol.app.viewer.tiles import SIDE
from tests.browser import Page, opened

from . import record
from .harness import QUICK, command, show


VOLUMES = "cthead", "engine", "bonsai"
PANEL, AROUND = 384, 140  # pixels of the window beside and above the image
REST = "document.body.innerText.includes('(estimate)')"
MIDDLE = """(r => [r.x + r.width / 2, r.y + r.height / 2])(
    document.querySelector('canvas').getBoundingClientRect())"""

HOOK = """
window.moves = []; window.images = [];
addEventListener('pointermove', () => moves.push(performance.now()), true);
const arrived = width => requestAnimationFrame(() => images.push([performance.now(), width]));
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


def summary(seconds: list[float]) -> dict[str, Any]:
    low, middle, high = np.quantile(seconds, (0.1, 0.5, 0.9))
    numbers = {"median": middle, "10 %": low, "90 %": high, "most": max(seconds)}
    return {k: round(float(v), 4) for k, v in numbers.items()} | {"all": [round(s, 4) for s in seconds]}


def measured(page: Page, repetitions: int) -> dict[str, Any]:
    """Seconds until coarse images follow, by what the viewer does when the pointer moves."""

    def rest() -> None:
        page.wait_for(REST, 300)
        time.sleep(1)

    def move(by: float) -> None:
        page.mouse("Moved", middle[0] + by, middle[1], button="left", buttons=1)

    def follows(by: float) -> float:
        page.evaluate("moves.length = images.length = 0")
        move(by)
        coarse = f"images.find(each => each[0] > moves[0] && each[1] % {SIDE} == 0)"
        return (page.wait_for(coarse, 300)[0] - page.evaluate("moves[0]")) / 1000

    rest()
    middle = page.evaluate(MIDDLE)
    page.mouse("Pressed", *middle, button="left", buttons=1, clickCount=1)
    for number in range(40):  # until the pace has settled
        move(number % 20)
        time.sleep(0.05)
    found: dict[str, Any] = {}
    for name, wait in (("at rest", rest), ("while a fine image is drawn", lambda: time.sleep(0.4))):
        seconds = []
        for number in range(repetitions):
            wait()
            seconds.append(follows(15 * (1 + number % 2)))
        found[name] = summary(seconds)
    page.evaluate("moves.length = images.length = 0")
    begun = time.monotonic()
    for number in range(150):
        move(number / 2)
        time.sleep(max(0, begun + (number + 1) / 60 - time.monotonic()))
    images = page.evaluate("images.filter(each => each[0] < moves.at(-1))")
    found["between images of a drag"] = summary((np.diff([at for at, _ in images]) / 1000).tolist())
    return found | {
        "coarse images are this wide": sorted({width for _, width in images if width % SIDE == 0})
    }


@command(__doc__, record.RESULTS, seed=0, quick=QUICK, size=512, repetitions=12)
def main(chosen: Namespace) -> None:
    found: dict[str, Any] = {}
    for name in VOLUMES[: 1 if chosen.quick else None]:
        file = next(Path(os.environ["JAXVOL_DATA"]).glob(f"{name}*"))
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = str(free.getsockname()[1])
        words = ["-m", "jaxvol", "view", str(file), "--no-browser", "--port", port]
        server = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            url = server.stdout.readline().split()[1]
            with opened(url, chosen.size + PANEL, chosen.size + AROUND, HOOK) as page:
                page.wait_for("document.body.innerText.includes('slices')", 300)
                found[name] = measured(page, 2 if chosen.quick else chosen.repetitions)
        finally:
            server.kill()
            server.wait()
        show(found)
    question, how = (__doc__ or "").partition("\n")[0], {"seed": chosen.seed}
    words = ["experiments.viewer_latency", *chosen.argv]
    result = {"pixels": chosen.size, "goal": 0.15, "side of a tile": SIDE, "volumes": found}
    record.write(chosen.output / "viewer_latency.json", question, result, command=words, **how)


if __name__ == "__main__":
    main()
