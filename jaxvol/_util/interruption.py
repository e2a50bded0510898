"""Ctrl-C ends `jaxvol` also while its modules load and Python shuts down, when a `KeyboardInterrupt` in a
callback of the garbage collector or of a weak reference would be lost: the signal then ends the process."""

import signal
import sys
import threading
from pathlib import PurePath
from typing import Any


def end_at_once() -> None:
    """From now on Ctrl-C ends the process, if that runs `jaxvol` or `python -m jaxvol`."""
    command = PurePath((sys.argv or [""])[0]).stem == "jaxvol" or sys.orig_argv[1:3] == ["-m", "jaxvol"]
    if command and threading.current_thread() is threading.main_thread():
        _replace(signal.default_int_handler, signal.SIG_DFL)


def raise_again() -> None:
    """From now on Ctrl-C raises `KeyboardInterrupt` again."""
    _replace(signal.SIG_DFL, signal.default_int_handler)


def _replace(handler: Any, by: Any) -> None:
    if signal.getsignal(signal.SIGINT) is handler:  # and not where the process was told to ignore it
        signal.signal(signal.SIGINT, by)


end_at_once()
