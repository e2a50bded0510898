"""A viewer without a face: its state, and a thread that draws it, coarse at once and fine at rest."""

import logging
import math
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import fields, replace
from typing import Any, Literal

from ..._util.srgb import png_of
from ...scene.transfer import TransferFunction
from ..progress import every_second
from ..recorded import text_of
from .marks import with_marks
from .state import PROGRAM, Scene, State, Vector
from .tiles import Grid, Pixels, TileRenderer, estimated_error


Stage = Literal["coarse", "drawing", "fine"]
"""Of an image; `drawing`: fine, but for tiles in whose place there is the coarse one."""

JPEG_QUALITY: dict[Stage, int] = {"coarse": 85, "drawing": 88, "fine": 94}
"""With which images are sent to a browser."""

MAX_SIDE = 2048  # pixels of a view's width and height
MAX_SAVED = 8192  # pixels of the larger side of an image that is saved
INTERVAL = 0.25  # seconds after which an unfinished fine image is shown again
BUDGET = 0.06  # seconds that a coarse image may take, of the 150 ms in which it is to follow the pointer

LEVELS = ((1, 4.0), (1, 2.0), (1, 1.0), (2, 1.0), (4, 1.0), (6, 1.0), (9, 1.0), (16, 1.0))
"""Coarse images: tiles, and factors of the step. Each takes some two times as long as the one before."""


def adapted(level: int, seconds: float, fine_tiles: int) -> int:
    """Index of the next coarse image's level by the last one's time; at most half of all tiles."""
    if seconds > BUDGET:
        level -= 2 if seconds > 2 * BUDGET else 1
    elif seconds < BUDGET / 2.5:
        level += 1
    allowed = sum(tiles <= max(1, fine_tiles // 2) for tiles, _ in LEVELS)
    return min(max(level, 0), allowed - 1)


class Model:
    """The state of a viewer, drawn whenever it changes, by a thread of its own. A newer state cancels a fine
    image between two tiles. A coarse image that was begun is finished, so that images follow a drag. Where a
    state needs another program, that is compiled beside: until then the old one draws what it can.

    Args:
        scene: what is viewed.
        state: how, at first.
        show: called by that thread, until `close`, with an image to stretch over the view, and its `Stage`.
        set_status: called likewise with a status of two lines, or three.
        deliver: called by a thread of its own with the PNG of an image that is saved.
    """

    marked: Callable[[], None] = staticmethod(lambda: None)  # called when a point was marked
    rest = 0.12  # seconds without a change after which a fine image is begun

    def __init__(
        self,
        scene: Scene,
        state: State,
        show: Callable[[Pixels, Stage], None],
        set_status: Callable[[str], None],
        deliver: Callable[[bytes], None] = lambda content: None,
    ):
        self.scene, self.state, self.first = scene, state, state
        self._face, self._deliver = (show, set_status), deliver
        self._status, self._compiling, self._begun = "", "", 0.0
        self._last: State | None = None
        self._shown: tuple[State, Pixels, Stage] | None = None
        self._level = 2
        self._compiled: set[Any] = set()
        self._failed: set[Any] = set()
        self._changed = threading.Condition()
        self._next: State | None = None
        self._idle, self._closed, self._marked = True, False, False
        self._thread: threading.Thread | None = None

    def ask(self, request: State) -> None:
        """Ask for an image, in place of all that was asked for before."""
        with self._changed:
            self._next, self._idle = request, False
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True, name="jaxvol viewer")
                self._thread.start()
            self._changed.notify_all()

    def close(self, *, wait: bool = True) -> None:
        """Draw no more. `wait` until a tile that was begun is finished."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if wait and self._thread is not None and threading.current_thread() is not self._thread:
            self._thread.join()

    def wait(self, seconds: float = 600) -> bool:
        """Wait until all that was asked for is drawn, fine; False if that takes longer."""
        with self._changed:
            return self._changed.wait_for(
                lambda: (self._idle and not self._compiling) or self._closed, seconds
            )

    def change(self, **changes: Any) -> None:
        """Replace fields of the state, and draw it."""
        self.apply(lambda state: replace(state, **changes))

    def apply(self, change: Callable[[State], State]) -> None:
        """Change the state by a function of it, and draw it; bad input changes nothing but the status."""
        try:
            self.state = change(self.state)
        except ValueError as fault:
            self._set_status(str(fault))
        else:
            self.ask(self.state)

    def resize(self, width: float, height: float, **changes: Any) -> None:
        """Change the view to this many pixels, `MAX_SIDE` at most, and replace other fields of the state."""
        if math.isfinite(width) and math.isfinite(height) and min(width, height) >= 1:
            scale = min(1.0, MAX_SIDE / max(width, height))
            size = max(1, round(width * scale)), max(1, round(height * scale))
            self.change(size=size, **changes)

    def pick(self, across: float, down: float) -> None:
        """Mark the point that is seen at a fraction of the view's width and height, if there is one."""
        self._told("picked", self._pick, across, down)

    def _pick(self, across: float, down: float) -> None:
        if self._last is not None:  # whose program is compiled
            point = TileRenderer(self.scene, self._last).picked(across, down)
            if point is not None:
                self.mark(point)

    def mark(self, point: Vector) -> None:
        """Mark a point of the world in the image that is shown."""
        self.state = replace(self.state, point=point)
        self.marked()
        with self._changed:
            self._marked = True
            self._changed.notify_all()

    def save(self, width: float) -> None:
        """Render an image of this width in another thread, and deliver it as a PNG with its settings."""
        across, down = self.state.size
        scale = min(max(width, 1), MAX_SAVED, MAX_SAVED * across / down) / across
        state = replace(self.state, size=(round(across * scale), max(1, round(down * scale))))
        threading.Thread(target=self._told, args=("saved", self._save, state), daemon=True).start()

    def _save(self, state: State) -> None:
        renderer, grid, (width, height) = TileRenderer(self.scene, state), Grid.fine(state.size), state.size
        pixels = grid.empty()
        for count, (column, row) in enumerate(tiles := grid.tiles()):
            if self._closed:
                return
            self._set_status(f"saving {width} x {height}: {count} of {len(tiles)} tiles\n")
            renderer.draw(pixels, grid, column, row)
        # of several files, or of labels, none, as of `jaxvol render`: another picture would come back
        whole = not self.scene.others and isinstance(state.transfer, TransferFunction)
        text = text_of(self.scene.settings(state), "", state.transfer) if whole else {}
        self._set_status(f"saved {width} x {height}\n")
        self._deliver(png_of(pixels[:height, :width], text))

    def _told(self, what: str, do: Callable[..., object], *arguments: Any) -> bool:
        """Do something, and tell of a fault, after which the user may ask for something else."""
        try:
            do(*arguments)
        except Exception as fault:
            self._set_status(f"not {what}:\n{' '.join(str(fault).split())}")
            return False
        return True

    def _show(self, pixels: Pixels, stage: Stage, seconds: float, request: State, factor: float = 1) -> str:
        """Show an image of a state, with steps that are longer by a factor. Returns what there is to say."""
        self._shown = request, pixels, stage
        self._tell(0, with_marks(pixels, replace(request, point=self.state.point)), stage)
        height, width, _ = pixels.shape
        step = request.step * factor
        return f"{stage}: {width} x {height}, step {step:.3g} voxels\n{1e3 * seconds:.0f} ms"

    def _set_status(self, text: str) -> None:
        self._status, compiling = text, self._compiling
        if compiling:
            text += f"\ncompiling for {compiling}: {time.monotonic() - self._begun:.0f} s"
        self._tell(1, text)

    def _tell(self, which: int, *what: Any) -> None:
        """Tell the face. What fails there, as after a page was closed, does not end this thread."""
        if not self._closed:
            try:
                self._face[which](*what)
            except Exception:
                logging.getLogger("jaxvol").exception("a viewer's page or widget failed")

    def _newer(self) -> bool:
        return self._next is not None or self._closed

    def _cancelled(self, seconds: float) -> bool:
        """Whether a newer request comes within so many seconds."""
        with self._changed:
            return self._changed.wait_for(self._newer, seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newer() or self._marked, 1 if self._compiling else None)
                if self._closed:
                    return
                (request, self._next), marked, self._marked = (self._next, None), self._marked, False
            if request is None:
                self._set_status(self._status)
                if marked and self._shown is not None:
                    old, pixels, stage = self._shown
                    self._tell(0, with_marks(pixels, replace(old, point=self.state.point)), stage)
                continue
            self._told("drawn", self._draw_parts, request)
            with self._changed:
                self._idle = self._next is None
                self._changed.notify_all()

    def _draw_parts(self, request: State) -> None:
        for part, _ in enumerate(self._draw(request)):
            if self._cancelled(0 if part else self.rest):
                break

    def _compile(self, request: State) -> None:
        """Compile the program of a state, and have the newest state drawn then."""
        renderer = TileRenderer(self.scene, request)
        done = self._told("compiled", renderer.overview)
        with self._changed:
            self._compiling = ""
            (self._compiled if done else self._failed).add(renderer.program_key)
            if done or self.state is not request:
                self._next, self._idle = self.state, False
            self._changed.notify_all()

    def _stand_in(self, request: State, last: State) -> State | None:
        """Starts to compile a request's program. Returns what the last one draws until then, or None."""
        if not self._compiling and TileRenderer(self.scene, request).program_key not in self._failed:
            names = [told for name, told in PROGRAM.items() if getattr(request, name) != getattr(last, name)]
            names = [*sorted(request.enabled ^ last.enabled), *filter(None, names)]
            self._compiling = ", ".join(names) or "points"
            self._begun = time.monotonic()
            self._set_status(self._status)
            threading.Thread(target=self._compile, args=(request,), daemon=True).start()
        shown = replace(request, **{name: getattr(last, name) for name in PROGRAM})
        if TileRenderer(self.scene, shown).program_key not in self._compiled:
            shown = replace(shown, transfer=last.transfer)
        same = all(getattr(shown, field.name) is getattr(last, field.name) for field in fields(State))
        return None if same else shown

    def _draw(self, request: State) -> Generator[None]:
        """Yields after the coarse image, and after each tile of the fine one."""
        renderer = TileRenderer(self.scene, request)
        if renderer.program_key not in self._compiled and self._last is None:
            told = "compiling …{}\nthe first image; the program is kept for the next time"
            self._set_status(told.format(""))
            with every_second(lambda seconds: self._set_status(told.format(f" {seconds:.0f} s"))):
                renderer.overview()
            self._compiled.add(renderer.program_key)
        elif renderer.program_key not in self._compiled:
            assert self._last is not None
            if (shown := self._stand_in(request, self._last)) is None:
                return
            request, renderer = shown, TileRenderer(self.scene, shown)
        self._last, grid = request, Grid.fine(request.size)
        tiles = grid.tiles()
        begun, (most, factor) = time.perf_counter(), LEVELS[self._level]
        coarse = TileRenderer(self.scene, request, factor).coarse(most)
        seconds = time.perf_counter() - begun
        self._level = adapted(self._level, seconds, len(tiles))
        self._set_status(self._show(coarse, "coarse", seconds, request, factor))
        yield

        pixels, (width, height) = grid.canvas(coarse), grid.size
        begun = shown = time.perf_counter()

        def show(stage: Stage) -> str:
            seconds = time.perf_counter() - begun
            return self._show(pixels[:height, :width].copy(), stage, seconds, request)

        for count, (column, row) in enumerate(tiles):
            if time.perf_counter() - shown > INTERVAL:
                shown = time.perf_counter()
                self._set_status(f"{show('drawing')}, {count} of {len(tiles)} tiles")
            renderer.draw(pixels, grid, column, row)
            yield
        summary = show("fine")
        self._set_status(f"{summary}, estimating its error …")
        image = renderer.overview()
        yield
        doubled = TileRenderer(self.scene, request, 2.0).overview()
        error = estimated_error(image, doubled, self.scene.given.quadrature)
        self._set_status(f"{summary}, RMSE {error:.2g} (estimate)")
