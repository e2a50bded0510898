"""Which image is drawn next? A thread draws what was asked for last, coarse at once and fine at rest."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar


T = TypeVar("T")

REST = 0.12
"""Seconds without a new request after which a fine image is begun."""


class Worker(Generic[T]):
    """A thread that draws. A newer request takes the place of one that has not been begun, and cancels a fine
    image between two of its parts. A coarse image that was begun is finished, so that images follow a drag
    however fast requests come.

    **Arguments:**

    - `coarse`: draws a request, given it and when it was made (`time.perf_counter`).
    - `fine`: draws it better, part by part: an iterator, which is closed where it is cancelled.
    - `failed`: what to do with an exception of these two. The thread goes on.
    - `rest`: seconds.
    """

    def __init__(
        self,
        coarse: Callable[[T, float], None],
        fine: Callable[[T], Iterator[None]],
        failed: Callable[[Exception], None],
        rest: float = REST,
    ):
        self._coarse, self._fine, self._failed, self._rest = coarse, fine, failed, rest
        self._changed = threading.Condition()
        self._next: tuple[T, float] | None = None
        self._idle, self._closed = True, False
        self._thread = threading.Thread(target=self._run, daemon=True, name="jaxvol viewer")
        self._thread.start()

    def ask(self, request: T) -> None:
        """Ask for an image, in place of all that was asked for before."""
        with self._changed:
            self._next, self._idle = (request, time.perf_counter()), False
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether it draws no more."""
        return self._closed

    def close(self, *, wait: bool = True) -> None:
        """Draw no more. `wait` until a part that was begun is finished."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if wait and threading.current_thread() is not self._thread:
            self._thread.join()

    def wait(self, seconds: float) -> bool:
        """Wait until all that was asked for is drawn, fine; False if that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: self._idle or self._closed, seconds)

    def _newer(self) -> bool:
        return self._next is not None or self._closed

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._newer)
                if self._closed:
                    return
                assert self._next is not None
                (request, asked), self._next = self._next, None
            try:
                self._draw(request, asked)
            except Exception as fault:  # told to the user, who may ask for another image
                self._failed(fault)
            with self._changed:
                self._idle = self._next is None
                self._changed.notify_all()

    def _draw(self, request: T, asked: float) -> None:
        self._coarse(request, asked)
        with self._changed:
            if self._changed.wait_for(self._newer, self._rest):
                return
        parts = self._fine(request)
        for _ in parts:
            if self._newer():
                break
        close = getattr(parts, "close", None)
        if close is not None:
            close()
