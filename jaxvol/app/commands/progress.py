"""Shows what a command is doing: a line on stderr, once that has taken two seconds."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


PATIENCE, INTERVAL, IN_LOGS = 2.0, 0.25, 60.0
"""Seconds before the line is shown, between its changes on a terminal, and between lines elsewhere."""

Report = Callable[[int, int], None]
"""Called with how many are done, and of how many."""


@contextmanager
def show_progress(what: str) -> Iterator[Report]:
    """Show `what` with the seconds that it has taken on stderr, until the context ends; yields a function
    that adds how many are done of how many. A terminal's line is wiped away at the end. Where stderr is no
    terminal, such as a log, there is one line at first, and then one each minute."""
    begun, count, ended, terminal = time.monotonic(), "", threading.Event(), sys.stderr.isatty()

    def report(done: int, of: int) -> None:
        nonlocal count
        count = f"{done} of {of}, "

    def show(text: str, start: str, end: str) -> None:
        print(f"{start}{what}{text}", end=end, file=sys.stderr, flush=True)

    def run() -> None:
        if ended.wait(PATIENCE):
            return
        start, end, pause = ("\r\x1b[K", "", INTERVAL) if terminal else ("", "\n", IN_LOGS)
        if not terminal:
            show(" ...", start, end)
            ended.wait(pause)
        while not ended.is_set():
            show(f": {count}{time.monotonic() - begun:.0f} s", start, end)
            ended.wait(pause)
        if terminal:
            print(start, end="", file=sys.stderr, flush=True)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        ended.set()
        thread.join()
