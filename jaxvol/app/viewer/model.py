"""A viewer without a face: its state, and a thread that draws it."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8

from .drawing import Content, Drawing, Pixels, place
from .pace import Pace
from .state import State
from .tiles import SIDE, Grid
from .worker import REST, Worker


EVERY = 0.25
"""Seconds between two looks at a fine image that is being drawn."""


@dataclass(frozen=True)
class Frame:
    """An image for a face to show.

    - `pixels`: sRGB; the face stretches them over the view.
    - `stage`: `"coarse"`; `"drawing"`, a fine image of which parts are missing, in whose place there is the
      coarse one; `"fine"`.
    - `state`: that it shows. `seconds`: that it took to draw; `latency`: from the request for it until it was
      drawn.
    - `step`: distance between its samples, voxels.
    """

    pixels: Pixels
    stage: Literal["coarse", "drawing", "fine"]
    state: State
    seconds: float
    latency: float
    step: float

    @property
    def quality(self) -> int:
        """Of the JPEG as which it is sent to a browser."""
        return {"coarse": 85, "drawing": 88, "fine": 94}[self.stage]


class Model:
    """The state of a viewer, drawn whenever it changes.

    **Arguments:**

    - `content`: what is looked at. `state`: how, at first.
    - `show`: called with each `Frame`, and `tell` with what there is to say, two lines, in the thread that
      draws.
    """

    def __init__(
        self,
        content: Content,
        state: State,
        show: Callable[[Frame], None],
        tell: Callable[[str], None],
        rest: float = REST,
    ):
        self.content, self.state = content, state
        self._faces = show, tell
        self._pace: dict[Any, Pace] = {}
        self._last: Frame | None = None
        self._worker = Worker(self._coarse, self._fine, self._failed, rest)

    def change(self, **changes: Any) -> None:
        """Replace fields of the state, and draw it."""
        self.state = replace(self.state, **changes)
        self._worker.ask(self.state)

    def apply(self, change: Callable[[State], State]) -> str | None:
        """Change the state by a function of it, and draw it. Bad input, such as points that make no transfer
        function, changes nothing: what is wrong with it is told, and returned."""
        try:
            changed = change(self.state)
            if changed.look is not self.state.look:
                changed.look.padded()
        except ValueError as fault:
            self._tell(str(fault))
            return str(fault)
        self.state = changed
        self._worker.ask(self.state)
        return None

    def drag(self, right: float, down: float, *, pan: bool = False) -> None:
        """A drag by these pixels of the view."""
        height = self.state.size[1]
        move = self.state.orbit.panned if pan else self.state.orbit.turned
        self.change(orbit=move(right / height, down / height))

    def zoom(self, factor: float) -> None:
        """What is seen grows by this factor."""
        self.change(orbit=self.state.orbit.zoomed(factor))

    def draw(self) -> None:
        """Draw the state again."""
        self._worker.ask(self.state)

    def wait(self, seconds: float = 600) -> bool:
        """Wait until the state is drawn, fine; False if that takes longer."""
        return self._worker.wait(seconds)

    def close(self, *, wait: bool = True) -> None:
        """Draw no more, and show no more. `wait` until a part that was begun is finished."""
        self._worker.close(wait=wait)

    def _show(self, frame: Frame) -> None:
        self._last = frame
        if not self._worker.closed:
            self._faces[0](frame)

    def _tell(self, text: str) -> None:
        if not self._worker.closed:
            self._faces[1](text)

    def _coarse(self, state: State, asked: float) -> None:
        drawing = Drawing(self.content, state)
        new = drawing.program not in self._pace
        pace = self._pace.setdefault(drawing.program, Pace())
        if new:
            self._tell("compiling …\nfor these transforms; the program is kept for the next time")
            begun = time.perf_counter()
            drawing.tile(Grid(1, 1, (SIDE, SIDE)), 0, 0)
            self._tell(f"compiled in {time.perf_counter() - begun:.1f} s\n")
        fine = Grid.fine(state.size)
        begun, coarser = time.perf_counter(), pace.coarser
        pixels = Drawing(self.content, state, coarser).image(Grid.coarse(state.size, pace.tiles))
        done = time.perf_counter()
        pace.took(done - begun, len(fine))
        frame = Frame(pixels, "coarse", state, done - begun, done - asked, state.step * coarser)
        self._show(frame)
        self._tell(_timing(frame))

    def _fine(self, state: State) -> Iterator[None]:
        drawing, grid, begun = Drawing(self.content, state), Grid.fine(state.size), time.perf_counter()
        assert self._last is not None
        pixels, shown = _stretched(self._last.pixels, grid), begun
        width, height = grid.size
        tiles = grid.inside_out()

        def show(stage: Literal["drawing", "fine"], more: str) -> None:
            took = time.perf_counter() - begun
            frame = Frame(pixels[:height, :width].copy(), stage, state, took, took, state.step)
            self._show(frame)
            self._tell(f"{_timing(frame)}{more}")

        for count, (column, row) in enumerate(tiles):
            if time.perf_counter() - shown > EVERY:
                shown = time.perf_counter()
                show("drawing", f", {count} of {len(tiles)} tiles")
            pixels[place(column, row)] = drawing.tile(grid, column, row)
            yield
        show("fine", ", estimating its error …")
        fine = self._last
        for error in drawing.error():
            yield
            if error is not None:
                self._tell(f"{_timing(fine)}, RMSE {error:.2g} (estimate)")

    def _failed(self, fault: Exception) -> None:
        self._tell(f"not drawn:\n{' '.join(str(fault).split())}")


def _timing(frame: Frame) -> str:
    height, width, _ = frame.pixels.shape
    return f"{frame.stage}: {width} x {height}, step {frame.step:.3g} voxels\n{1e3 * frame.seconds:.0f} ms"


def _stretched(pixels: Pixels, grid: Grid) -> UInt8[np.ndarray, "height width 3"]:
    """An image, as large as a grid of tiles, each pixel the nearest one."""
    (rows, columns, _), (width, height) = pixels.shape, grid.size
    row = np.minimum(np.arange(grid.rows * SIDE) * rows // height, rows - 1)
    column = np.minimum(np.arange(grid.columns * SIDE) * columns // width, columns - 1)
    return pixels[row[:, None], column[None, :]]
