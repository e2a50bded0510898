"""How does a command show what it is doing? By a line on stderr, once that has taken two seconds."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


PATIENCE, INTERVAL = 2.0, 0.25
"""Seconds before the line is shown, and between its changes."""

Told = Callable[[int, int], None]
"""Called with how many are done, and of how many."""


@contextmanager
def working(what: str) -> Iterator[Told]:
    """Show `what` with the seconds that it has taken, on the terminal of stderr, until the context ends;
    yields a function that adds how many are done of how many. Where stderr is no terminal, such as a log, the
    line is `what` alone, once, and stays."""
    begun, count = time.monotonic(), ""

    def told(done: int, of: int) -> None:
        nonlocal count
        count = f"{done} of {of}, "

    ended, terminal = threading.Event(), sys.stderr.isatty()

    def show() -> None:
        wait = PATIENCE
        if not terminal:
            if not ended.wait(wait):
                print(f"{what} ...", file=sys.stderr, flush=True)
            return
        while not ended.wait(wait):
            wait = INTERVAL
            line = f"{what}: {count}{time.monotonic() - begun:.0f} s"
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
        if wait == INTERVAL:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield told
    finally:
        ended.set()
        thread.join()
