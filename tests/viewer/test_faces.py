"""Do both faces of the viewer, in a browser, show what is asked for by the pointer and the controls?

They are driven as by a hand: by events of the mouse and the keyboard, and judged by what the window shows.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ..browser import CHROMIUM, Page, opened


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed (Debian: chromium)"),
]

SEEN = 300, 460
"""Pixels of the window, (x, y), around which the object appears."""

SECONDS = 400


def object_in(window: np.ndarray) -> np.ndarray:
    """Where the window shows the object, left of the controls: what is far from white."""
    return (window < 200).any(axis=-1)


class Face:
    """A face of the viewer in a browser.

    - `left`, `top`, `right`, `bottom`: of the image in the window.
    """

    def __init__(self, page: Page, image: tuple[int, int, int, int]):
        self.page, self.image = page, image

    def shown(self) -> np.ndarray:
        """The image, as soon as the viewer is at rest."""
        self.page.wait_for("document.body.innerText.includes('(estimate)')", SECONDS)
        return self.now()

    def now(self) -> np.ndarray:
        left, top, right, bottom = self.image
        return self.page.screenshot()[top:bottom, left:right].astype(float)

    @property
    def middle(self) -> tuple[float, float]:
        left, top, right, bottom = self.image
        return (left + right) / 2, (top + bottom) / 2

    def changed_by(self, act, old: np.ndarray) -> np.ndarray:
        """The image once the act has shown and the viewer is at rest again."""
        act()
        end = time.monotonic() + SECONDS
        while np.abs(self.now() - old).mean() < 0.05:
            assert time.monotonic() < end, "the image does not change"
            time.sleep(0.05)
        self.page.wait_for("!document.body.innerText.includes('(estimate)') || 1", 1)
        time.sleep(1)
        return self.shown()


def middle_of(image: np.ndarray) -> np.ndarray:
    """Where the dark ball beside the center lies on average, (x, y)."""
    rows, columns = np.nonzero(image.max(axis=-1) < 140)
    return np.array([columns.mean(), rows.mean()])


def extent(image: np.ndarray) -> int:
    return int(np.count_nonzero((image < 245).any(axis=-1)))


SCENE = """
import numpy as np
x, y, z = np.mgrid[:40, :40, :40] - 19.5
ball = 250 - 30 * np.sqrt((x + 6) ** 2 + (y + 16) ** 2 + z**2)  # in front, to the left of the middle
body = 150 - 8 * np.sqrt(x**2 + y**2 + z**2)
data = np.clip(np.maximum(ball, body), 0, 255).astype(np.uint8)
"""
"""A light ball, and a small one of other values on its side towards the camera, left of the middle."""


def check(face: Face) -> None:
    """Drag, zoom, and leave the rest to the face."""
    start = face.shown()
    x, y = face.middle
    dragged = face.changed_by(lambda: face.page.drag((x, y), (60, 0)), start)
    assert middle_of(dragged)[0] > middle_of(start)[0] + 15  # the front goes where the pointer goes
    lower = face.changed_by(lambda: face.page.drag((x, y), (0, 50)), dragged)
    assert middle_of(lower)[1] > middle_of(dragged)[1] + 10
    nearer = face.changed_by(lambda: face.page.mouse("Wheel", x, y, deltaX=0, deltaY=-300), lower)
    assert extent(nearer) > 1.2 * extent(lower)
