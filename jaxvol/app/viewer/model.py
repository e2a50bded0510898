"""The model of a viewer: its state, and a thread that draws it, coarse in motion and fine at rest."""

import logging
import math
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import fields, replace
from typing import Any, Literal

from ..._util.progress import every_second
from ..._util.srgb import png_of
from ...scene.transfer import TransferFunction
from ..recorded import text_of
from .marks import with_marks
from .state import PROGRAM, State, Vector, ViewerSetup
from .tiles import Grid, Pixels, TileRenderer, estimated_error


Stage = Literal["coarse", "drawing", "fine"]  # of an image; "drawing": fine, but coarse in unfinished tiles

JPEG_QUALITY: dict[Stage, int] = {"coarse": 85, "drawing": 88, "fine": 94}  # of images sent to a browser
MAX_SIDE = 2048  # pixels of a view's width and height
MAX_SAVED = 8192  # pixels of the larger side of a saved image
INTERVAL = 0.25  # seconds after which an unfinished fine image is shown again
BUDGET = 0.06  # seconds for a coarse image, of the 150 ms in which it follows the pointer

LEVELS = ((1, 4.0), (1, 2.0), (1, 1.0), (2, 1.0), (4, 1.0), (6, 1.0), (9, 1.0), (16, 1.0))
"""Levels of coarse images: number of tiles, and factor of the step. A level takes about twice the time of the
one before."""


def adapted(level: int, seconds: float, fine_tiles: int) -> int:
    """Level of the next coarse image, from the time of the last one; at most half of all tiles."""
    if seconds > BUDGET:
        level -= 2 if seconds > 2 * BUDGET else 1
    elif seconds < BUDGET / 2.5:
        level += 1
    allowed = sum(tiles <= max(1, fine_tiles // 2) for tiles, _ in LEVELS)
    return min(max(level, 0), allowed - 1)


class Model:
    """The state of a viewer, drawn by a thread when it changes. A newer state cancels a fine image between
    tiles, but no coarse image, so that images follow a drag. If a state needs another program, a second
    thread compiles it; until then the old program draws what it can.

    The thread calls `show`, with an image to stretch over the view and its `Stage`, and `set_status`, with
    two or three lines. `deliver` is called by another thread with the PNG of a saved image."""

    marked: Callable[[], None] = staticmethod(lambda: None)  # called after a point was marked
    idle_delay = 0.12  # seconds without a change before a fine image

    def __init__(
        self,
        scene: ViewerSetup,
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
        """Request an image, in place of all earlier requests."""
        with self._changed:
            self._next, self._idle = request, False
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True, name="jaxvol viewer")
                self._thread.start()
            self._changed.notify_all()

    def close(self, *, wait: bool = True) -> None:
        """Stop drawing. `wait`: until the current tile is finished."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if wait and self._thread is not None and threading.current_thread() is not self._thread:
            self._thread.join()

    def wait(self, seconds: float = 600) -> bool:
        """Wait until the last request is drawn, fine; False after a timeout."""
        with self._changed:
            return self._changed.wait_for(
                lambda: (self._idle and not self._compiling) or self._closed, seconds
            )

    def change(self, **changes: Any) -> None:
        """Replace fields of the state and draw it."""
        self.apply(lambda state: replace(state, **changes))

    def apply(self, change: Callable[[State], State]) -> None:
        """Replace the state by a function of it and draw it; bad input changes only the status."""
        try:
            self.state = change(self.state)
        except ValueError as fault:
            self._set_status(str(fault))
        else:
            self.ask(self.state)

    def resize(self, width: float, height: float, **changes: Any) -> None:
        """Set the size of the view in pixels, at most `MAX_SIDE`, and replace other fields of the state."""
        if math.isfinite(width) and math.isfinite(height) and min(width, height) >= 1:
            scale = min(1.0, MAX_SIDE / max(width, height))
            size = max(1, round(width * scale)), max(1, round(height * scale))
            self.change(size=size, **changes)

    def pick(self, across: float, down: float) -> None:
        """Mark the point visible at a fraction of the view's width and height, if any."""
        self._attempt("picked", self._pick, across, down)

    def _pick(self, across: float, down: float) -> None:
        if self._last is not None:  # its program is compiled
            point = TileRenderer(self.scene, self._last).picked(across, down)
            if point is not None:
                self.mark(point)

    def mark(self, point: Vector) -> None:
        """Mark a world point in the image."""
        self.state = replace(self.state, point=point)
        self.marked()
        with self._changed:
            self._marked = True
            self._changed.notify_all()

    def save(self, width: float) -> None:
        """Render an image of this width in another thread and deliver it as a PNG with its settings."""
        across, down = self.state.size
        scale = min(max(width, 1), MAX_SAVED, MAX_SAVED * across / down) / across
        state = replace(self.state, size=(round(across * scale), max(1, round(down * scale))))
        threading.Thread(target=self._attempt, args=("saved", self._save, state), daemon=True).start()

    def _save(self, state: State) -> None:
        renderer, grid, (width, height) = TileRenderer(self.scene, state), Grid.fine(state.size), state.size
        pixels = grid.empty()
        for count, (column, row) in enumerate(tiles := grid.tiles()):
            if self._closed:
                return
            self._set_status(f"saving {width} x {height}: {count} of {len(tiles)} tiles\n")
            renderer.draw(pixels, grid, column, row)
        # settings hold neither further files nor labels: `jaxvol render` could not repeat the picture
        repeatable = not self.scene.extra_pairs and isinstance(state.transfer, TransferFunction)
        text = text_of(self.scene.settings(state), "", state.transfer) if repeatable else {}
        self._set_status(f"saved {width} x {height}\n")
        self._deliver(png_of(pixels[:height, :width], text))

    def _attempt(self, outcome: str, action: Callable[..., object], *arguments: Any) -> bool:
        """Call a function, report an exception in the status, and return whether there was none."""
        try:
            action(*arguments)
        except Exception as fault:
            self._set_status(f"not {outcome}:\n{' '.join(str(fault).split())}")
            return False
        return True

    def _show(self, pixels: Pixels, stage: Stage, seconds: float, request: State, factor: float = 1) -> str:
        """Show an image of a state, rendered with `factor` times the step, and return its status."""
        self._shown = request, pixels, stage
        self._call_face(0, with_marks(pixels, replace(request, point=self.state.point)), stage)
        height, width, _ = pixels.shape
        step = request.step * factor
        return f"{stage}: {width} x {height}, step {step:.3g} voxels\n{1e3 * seconds:.0f} ms"

    def _set_status(self, text: str) -> None:
        self._status, compiling = text, self._compiling
        if compiling:
            text += f"\ncompiling for {compiling}: {time.monotonic() - self._begun:.0f} s"
        self._call_face(1, text)

    def _call_face(self, index: int, *arguments: Any) -> None:
        """Call `show` or `set_status`. An exception, as after a page was closed, does not end this thread."""
        if not self._closed:
            try:
                self._face[index](*arguments)
            except Exception:
                logging.getLogger("jaxvol").exception("a viewer's page or widget failed")

    def _newer(self) -> bool:
        return self._next is not None or self._closed

    def _cancelled(self, seconds: float) -> bool:
        """Wait for a newer request, and return whether there is one."""
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
                    self._call_face(0, with_marks(pixels, replace(old, point=self.state.point)), stage)
                continue
            self._attempt("drawn", self._draw_parts, request)
            with self._changed:
                self._idle = self._next is None
                self._changed.notify_all()

    def _draw_parts(self, request: State) -> None:
        for part, _ in enumerate(self._draw(request)):
            if self._cancelled(0 if part else self.idle_delay):
                break

    def _compile(self, request: State) -> None:
        """Compile the program of a state, then request the newest state."""
        renderer = TileRenderer(self.scene, request)
        done = self._attempt("compiled", renderer.overview)
        with self._changed:
            self._compiling = ""
            (self._compiled if done else self._failed).add(renderer.program_key)
            if done or self.state is not request:
                self._next, self._idle = self.state, False
            self._changed.notify_all()

    def _stand_in(self, request: State, last: State) -> State | None:
        """Start to compile a request's program. Return the state to draw meanwhile, or None for no change."""
        if not self._compiling and TileRenderer(self.scene, request).program_key not in self._failed:
            names = [text for name, text in PROGRAM.items() if getattr(request, name) != getattr(last, name)]
            names = [*sorted(request.enabled ^ last.enabled), *filter(None, names)]
            self._compiling = ", ".join(names) or "points"
            self._begun = time.monotonic()
            self._set_status(self._status)
            threading.Thread(target=self._compile, args=(request,), daemon=True).start()
        shown = replace(request, **{name: getattr(last, name) for name in PROGRAM})
        if TileRenderer(self.scene, shown).program_key not in self._compiled:
            shown = replace(shown, transfer=last.transfer)
        is_last = all(getattr(shown, field.name) is getattr(last, field.name) for field in fields(State))
        return None if is_last else shown

    def _draw(self, request: State) -> Generator[None]:
        """Draw a state; yield after the coarse image, and after each tile of the fine one."""
        renderer = TileRenderer(self.scene, request)
        if renderer.program_key not in self._compiled and self._last is None:
            text = "compiling …{}\nthe first image; the program is kept for the next time"
            self._set_status(text.format(""))
            with every_second(lambda seconds: self._set_status(text.format(f" {seconds:.0f} s"))):
                renderer.overview()
            self._compiled.add(renderer.program_key)
        elif renderer.program_key not in self._compiled:
            assert self._last is not None
            if (shown := self._stand_in(request, self._last)) is None:
                return
            request, renderer = shown, TileRenderer(self.scene, shown)
        self._last, grid = request, Grid.fine(request.size)
        tiles = grid.tiles()
        begun, (max_tiles, factor) = time.perf_counter(), LEVELS[self._level]
        coarse = TileRenderer(self.scene, request, factor).coarse(max_tiles)
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
        error = estimated_error(image, doubled, self.scene.initial_march.quadrature)
        self._set_status(f"{summary}, RMSE {error:.2g} (estimate)")
