"""How does a command show what it is doing? By a line on stderr, once that has taken two seconds."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


PATIENCE, INTERVAL, IN_LOGS = 2.0, 0.25, 60.0
"""Seconds before the line is shown, between its changes, and between lines where it is none of a terminal."""

Told = Callable[[int, int], None]
"""Called with how many are done, and of how many."""


@contextmanager
def working(what: str) -> Iterator[Told]:
    """Show `what` with the seconds that it has taken, on the terminal of stderr, until the context ends;
    yields a function that adds how many are done of how many. Where stderr is no terminal, such as a log,
    lines stay: `what` alone, and then, each minute, with what is done."""
    begun, count = time.monotonic(), ""

    def told(done: int, of: int) -> None:
        nonlocal count
        count = f"{done} of {of}, "

    def line() -> str:
        return f"{what}: {count}{time.monotonic() - begun:.0f} s"

    ended, terminal = threading.Event(), sys.stderr.isatty()

    def show() -> None:
        if ended.wait(PATIENCE):
            return
        if not terminal:
            print(f"{what} ...", file=sys.stderr, flush=True)
            while not ended.wait(IN_LOGS):
                print(line(), file=sys.stderr, flush=True)
            return
        while True:
            print(f"\r\x1b[K{line()}", end="", file=sys.stderr, flush=True)
            if ended.wait(INTERVAL):
                break
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield told
    finally:
        ended.set()
        thread.join()
