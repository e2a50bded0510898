"""A canvas of rendercanvas that hands events on, and sends images, when they come.

rendercanvas does both at ticks of a scheduler, at most `max_fps` a second, and none while an image waits for
the browser: some 10 ms for the event, and as many for the image, of the 150 in which a coarse image is to
follow the pointer. The browser's part keeps a move of the pointer back for 20 ms, to join it with those that
follow. There is no need for this here: browsers report one move for each of their frames, and the viewer
merges events itself, since a newer request replaces an older one.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from rendercanvas.anywidget import RenderCanvas

from .drawing import Pixels


class PromptCanvas(RenderCanvas):
    """Calls handlers of events at once, and sends an image as soon as fewer than two wait for the browser.

    rendercanvas sends what has been shown for 0.3 s once more, without loss, and its compression holds up
    events for 25 ms. Here images are sent once, as JPEG, those that are to stay in a better quality.

    `pixels`: of the next image.
    """

    _esm = RenderCanvas._esm.replace("setThrottle(20)", "setThrottle(0)")
    pixels: Pixels | None = None

    def __init__(self, **how: Any):
        super().__init__(**how)
        self._bitmap = self.get_bitmap_context()
        self.request_draw(self._set_bitmap)

    def show(self, pixels: Pixels, quality: int) -> None:
        """Send an image, in place of those that have not been sent. In the thread of the event loop.
        `quality`: of JPEG, below 100."""
        self.pixels, self._quality = pixels, quality
        self.request_draw()

    def request_draw(self, draw_function: Callable[[], None] | None = None) -> None:
        super().request_draw(draw_function)
        self._rc_request_draw()

    def submit_event(self, event: dict[str, Any]) -> None:
        super().submit_event(event)
        self._events.flush()

    def _set_bitmap(self) -> None:
        if self.pixels is not None:
            opaque = np.full((*self.pixels.shape[:2], 1), 255, np.uint8)
            self._bitmap.set_bitmap(np.concatenate([self.pixels, opaque], axis=-1))

    def _rfb_schedule_lossless_draw(self, array: Any, delay: float = 0.3) -> None:
        pass
