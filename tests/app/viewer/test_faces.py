"""Do both faces of the viewer, in a browser, show what is asked for by the pointer and the controls?

They are driven as by a hand, by events of mouse and keyboard, and judged by what the window shows.
"""

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import jaxvol as jv

from ...browser import CHROMIUM, Page, opened
from .notebook_server import notebook


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium"),
]

SECONDS = 400
"""Longest wait, for a program to be compiled by a busy machine, say."""

REST = "document.body.innerText.includes('(estimate)')"
"""What a viewer tells at rest."""


def scene(folder: Path) -> tuple[Path, Path]:
    """Files of a volume and a transfer function: a light ball, and a small blue one on its front as the first
    camera sees it, a little left of the middle, where a turn hardly moves it up or down."""
    x, y, z = np.mgrid[:40, :40, :40] - 19.5
    small = np.sqrt((x - 1.6) ** 2 + (y + 13) ** 2 + z**2) < 6
    body = np.clip(150 - 8 * np.sqrt(x**2 + y**2 + z**2), 0, 255)
    np.savez(folder / "balls.npz", data=np.where(small, 220, body).astype(np.uint8))
    points = [(30, (0.9, 0.7, 0.4), 0.0), (50, (0.9, 0.7, 0.4), 0.1), (150, (0.9, 0.7, 0.4), 0.1)]
    points += [(160, (0, 0, 1), 0.9), (250, (0, 0, 1), 0.9)]
    transfer = jv.TransferFunction.from_points(points)
    return folder / "balls.npz", jv.write_transfer(folder / "look.json", transfer)


def middle_of_blue(image: np.ndarray) -> np.ndarray:
    """Where the small ball lies on average: (x, y)."""
    rows, columns = np.nonzero(image[..., 2] > image[..., 0] + 80)
    return np.array([columns.mean(), rows.mean()])


def extent(image: np.ndarray) -> int:
    """Pixels that show anything."""
    return int(np.count_nonzero(image.min(axis=-1) < 235))


class Face:
    """A face of the viewer in a browser. `image`: left, top, right and bottom of its image in the window."""

    def __init__(self, page: Page, image: tuple[int, int, int, int]):
        self.page, self.image = page, image
        left, top, right, bottom = image
        self.middle = (left + right) / 2, (top + bottom) / 2

    def now(self) -> np.ndarray:
        left, top, right, bottom = self.image
        return self.page.screenshot()[top:bottom, left:right].astype(float)

    def after(self, act: Callable[[], None]) -> np.ndarray:
        """The image once the act shows, and the viewer is at rest again."""
        old, end = self.now(), time.monotonic() + SECONDS
        act()
        while np.abs(self.now() - old).mean() < 0.02:
            assert time.monotonic() < end, "the image does not change"
            time.sleep(0.05)
        time.sleep(0.5)  # an image and what is told of it are sent one after the other
        self.page.wait_for(REST, SECONDS)
        time.sleep(0.5)
        return self.now()

    def check_pointer(self) -> None:
        """Drags and turns of the wheel."""
        self.page.wait_for(REST, SECONDS)
        time.sleep(0.5)
        start = self.now()
        assert extent(start) > 5000
        right = self.after(lambda: self.page.drag(self.middle, (40, 0)))
        moved = middle_of_blue(right) - middle_of_blue(start)
        assert moved[0] > 10  # the front goes where the pointer goes
        assert moved[0] > 2 * abs(moved[1])
        down = self.after(lambda: self.page.drag(self.middle, (0, 40)))
        moved = middle_of_blue(down) - middle_of_blue(right)
        assert moved[1] > 10
        near = self.after(lambda: self.page.mouse("Wheel", *self.middle, deltaX=0, deltaY=-100))
        assert extent(near) > 1.05 * extent(down)

    def check_level(self, find: str) -> None:
        """A level so high that the large ball is not seen. `find`: a JavaScript expression of the element in
        which it is written."""
        old = extent(self.now())
        self.page.evaluate(f"({find}).id = 'level', 1")
        new = self.after(lambda: self.page.write("#level", "290"))
        assert extent(new) < 0.3 * old

    def check_switch(self, find: str) -> None:
        """Light that is turned on, for which another program is compiled. `find`: of its box."""
        self.page.evaluate(f"({find}).id = 'switch', 1")
        self.page.point_at("#switch", click=True)
        self.page.wait_for("document.body.innerText.includes('compil')", SECONDS)
        self.page.wait_for(REST, SECONDS)


def box_of(page: Page, selector: str, margin: int = 0) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of an element in the window."""
    found = f"document.querySelector({selector!r}).getBoundingClientRect()"
    x, y, width, height = page.evaluate(f"(r => [r.x, r.y, r.width, r.height])({found})")
    left, top, right, bottom = map(round, (x, y, x + width, y + height))
    return left + margin, top + margin, right - margin, bottom - margin


def test_the_page(tmp_path):
    volume, look = scene(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [
        "view",
        str(volume),
        "--transfer",
        str(look),
        "--no-shade",
        "--no-browser",
        "--port",
        str(port),
    ]
    server = subprocess.Popen(
        [sys.executable, "-m", "jaxvol", *command], stdout=subprocess.PIPE, text=True, cwd=tmp_path
    )
    try:
        assert server.stdout is not None
        url = server.stdout.readline().split()[1]
        assert url == f"http://localhost:{port}"
        with opened(url, 1200, 800) as page:
            page.wait_for("document.body.innerText.includes('slices')", SECONDS)
            face = Face(page, box_of(page, "canvas"))
            face.check_pointer()
            face.check_level(page_field("level"))
            face.check_switch(page_field("light"))
            assert page.faults == []
    finally:
        server.kill()
        server.wait()


def page_field(label: str) -> str:
    """The input beside a label of viser's."""
    same = f"l => l.innerText.replaceAll('\u200b', '') == '{label}'"
    row = f"[...document.querySelectorAll('label')].find({same}).closest('.mantine-Flex-root')"
    return f"{row}.querySelector('input:not([type=hidden])')"


def notebook_field(label: str) -> str:
    """The input of an ipywidget of this description."""
    row = f"[...document.querySelectorAll('.widget-inline-hbox')].find(w => w.innerText.includes('{label}'))"
    return f"{row}.querySelector('input, .widget-readout')"


def test_the_notebook(tmp_path):
    volume, look = scene(tmp_path)
    shown = f"jv.load({str(volume)!r}), jv.read_transfer({str(look)!r}), lit=False, size=(480, 360)"
    with notebook(["import jaxvol as jv", f"v = jv.view({shown})", "v"], tmp_path) as page:
        page.wait_for("document.querySelector('.renderview-view') && true", SECONDS)
        page.evaluate("document.querySelector('.renderview-view').scrollIntoView({block: 'center'})")
        face = Face(page, box_of(page, ".renderview-view", 2))
        face.check_pointer()
        face.check_level(notebook_field("level"))
        face.check_switch(notebook_field("light"))
        assert page.faults == []
