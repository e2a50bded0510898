"""A viewer without a face: its state, and a thread that draws it, coarse at once and fine at rest."""

import math
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import replace
from typing import Any, Literal

from .state import Scene, State
from .tiles import Grid, Pixels, TileRenderer, estimated_error


Stage = Literal["coarse", "drawing", "fine"]
"""Of an image: coarse; fine, but for parts in whose place there is the coarse one; fine."""

JPEG_QUALITY: dict[Stage, int] = {"coarse": 85, "drawing": 88, "fine": 94}
"""With which images are sent to a browser."""

REST = 0.12
"""Seconds without a change after which a fine image is begun."""

MAX_SIDE = 2048
"""Pixels of a view's width and height."""

INTERVAL = 0.25
"""Seconds after which an unfinished fine image is shown again."""

BUDGET = 0.06
"""Seconds that a coarse image may take, of the 150 ms in which it is to follow the pointer."""

LEVELS = ((1, 4.0), (1, 2.0), (1, 1.0), (2, 1.0), (4, 1.0), (6, 1.0), (9, 1.0), (16, 1.0))
"""Coarse images, from the coarsest on: tiles, and how many times as long their steps are. One takes up to
some two times as long as the one before."""


def adapted(level: int, seconds: float, fine_tiles: int) -> int:
    """The index of `LEVELS` of the next coarse image, after one that took so long. A coarse image has at most
    half as many tiles as the fine one."""
    if seconds > BUDGET:
        level -= 2 if seconds > 2 * BUDGET else 1
    elif seconds < BUDGET / 2.5:
        level += 1
    allowed = sum(tiles <= max(1, fine_tiles // 2) for tiles, _ in LEVELS)
    return min(max(level, 0), allowed - 1)


class Model:
    """The state of a viewer, drawn whenever it changes, by a thread of its own. A newer state cancels a fine
    image between two tiles. A coarse image that was begun is finished, so that images follow a drag.

    **Arguments:**

    - `scene`: what is viewed. `state`: how, at first.
    - `show`: called with an image, which is to be stretched over the view, and its `Stage`; and `tell` with a
      status of two lines. In the thread that draws, and no more once it is closed.
    - `rest`: seconds without a change after which a fine image is begun.
    """

    def __init__(
        self,
        scene: Scene,
        state: State,
        show: Callable[[Pixels, Stage], None],
        tell: Callable[[str], None],
        rest: float = REST,
    ):
        self.scene, self.state = scene, state
        self._face = show, tell
        self._level = 2
        self._compiled: set[Any] = set()
        self._rest = rest
        self._changed = threading.Condition()
        self._next: State | None = None
        self._idle, self._closed = True, False
        self._thread = threading.Thread(target=self._run, daemon=True, name="jaxvol viewer")
        self._thread.start()

    def ask(self, request: State) -> None:
        """Ask for an image, in place of all that was asked for before."""
        with self._changed:
            self._next, self._idle = request, False
            self._changed.notify_all()

    def close(self, *, wait: bool = True) -> None:
        """Draw no more. `wait` until a part that was begun is finished."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if wait and threading.current_thread() is not self._thread:
            self._thread.join()

    def wait(self, seconds: float = 600) -> bool:
        """Wait until all that was asked for is drawn, fine; False if that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: self._idle or self._closed, seconds)

    def change(self, **changes: Any) -> None:
        """Replace fields of the state, and draw it."""
        self.apply(lambda state: replace(state, **changes))

    def apply(self, change: Callable[[State], State]) -> None:
        """Change the state by a function of it, and draw it. Bad input, such as points that make no transfer
        function, changes nothing: what is wrong with it is told."""
        try:
            self.state = change(self.state)
        except ValueError as fault:
            self._tell(str(fault))
        else:
            self.ask(self.state)

    def resize(self, width: float, height: float, **changes: Any) -> None:
        """Change the view to this many pixels, or to fewer if it is wider or higher than `MAX_SIDE`; and
        replace other fields of the state."""
        if math.isfinite(width) and math.isfinite(height) and min(width, height) >= 1:
            scale = min(1.0, MAX_SIDE / max(width, height))
            size = max(1, round(width * scale)), max(1, round(height * scale))
            self.change(size=size, **changes)

    def _show(self, pixels: Pixels, stage: Stage, seconds: float, step: float) -> str:
        """Show an image. Returns what there is to say of it. `step`: voxels."""
        if not self._closed:
            self._face[0](pixels, stage)
        height, width, _ = pixels.shape
        return f"{stage}: {width} x {height}, step {step:.3g} voxels\n{1e3 * seconds:.0f} ms"

    def _tell(self, text: str) -> None:
        if not self._closed:
            self._face[1](text)

    def _newer(self) -> bool:
        return self._next is not None or self._closed

    def _cancelled(self, seconds: float) -> bool:
        """Whether a newer request comes within so many seconds."""
        with self._changed:
            return self._changed.wait_for(self._newer, seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._newer)
                if self._closed:
                    return
                assert self._next is not None
                request, self._next = self._next, None
            try:
                for part, _ in enumerate(self._draw(request)):
                    if self._cancelled(0 if part else self._rest):
                        break
            except Exception as fault:  # told to the user, who may ask for another image
                self._tell(f"not drawn:\n{' '.join(str(fault).split())}")
            with self._changed:
                self._idle = self._next is None
                self._changed.notify_all()

    def _draw(self, request: State) -> Generator[None]:
        """Yields after the coarse image, and after each part of the fine one."""
        renderer, grid = TileRenderer(self.scene, request), Grid.fine(request.size)
        if renderer.program_key not in self._compiled:
            self._tell("compiling …\nfor these transforms; the program is kept for the next time")
            begun = time.perf_counter()
            renderer.overview()
            self._compiled.add(renderer.program_key)
            self._tell(f"compiled in {time.perf_counter() - begun:.1f} s\n")
        begun, (tiles, factor) = time.perf_counter(), LEVELS[self._level]
        coarse = TileRenderer(self.scene, request, factor).image(Grid.coarse(request.size, tiles))
        seconds = time.perf_counter() - begun
        self._level = adapted(self._level, seconds, len(grid))
        self._tell(self._show(coarse, "coarse", seconds, request.step * factor))
        yield

        pixels, (width, height) = grid.canvas(coarse), grid.size
        begun = shown = time.perf_counter()

        def show(stage: Stage) -> str:
            seconds = time.perf_counter() - begun
            return self._show(pixels[:height, :width].copy(), stage, seconds, request.step)

        for count, (column, row) in enumerate(grid.center_first()):
            if time.perf_counter() - shown > INTERVAL:
                shown = time.perf_counter()
                self._tell(f"{show('drawing')}, {count} of {len(grid)} tiles")
            renderer.draw(pixels, grid, column, row)
            yield
        summary = show("fine")
        self._tell(f"{summary}, estimating its error …")
        image = renderer.overview()
        yield
        doubled = TileRenderer(self.scene, request, 2.0).overview()
        error = estimated_error(image, doubled, self.scene.quadrature)
        self._tell(f"{summary}, RMSE {error:.2g} (estimate)")
