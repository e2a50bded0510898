"""Which image is drawn next? A thread draws what was asked for last, coarse at once and fine at rest."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Generator
from typing import Generic, TypeVar


T = TypeVar("T")

REST = 0.12
"""Seconds without a new request after which a fine image is begun."""


class Worker(ABC, Generic[T]):
    """A thread that draws. A newer request replaces one that has not been begun, and cancels a fine image
    between two of its parts. A coarse image that was begun is finished, so that images follow a drag.

    **Arguments:** `rest`: seconds without a new request after which a fine image is begun.
    """

    def __init__(self, rest: float = REST):
        self._rest = rest
        self._changed = threading.Condition()
        self._next: T | None = None
        self._idle, self._closed = True, False
        self._thread = threading.Thread(target=self._run, daemon=True, name="jaxvol viewer")
        self._thread.start()

    @abstractmethod
    def _draw(self, request: T) -> Generator[None]:
        """Draw a request: yields after the coarse image, and after each part of the fine one."""

    @abstractmethod
    def _failed(self, fault: Exception) -> None:
        """Called with an exception of `_draw`. The thread goes on."""

    def ask(self, request: T) -> None:
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
                self._failed(fault)
            with self._changed:
                self._idle = self._next is None
                self._changed.notify_all()
