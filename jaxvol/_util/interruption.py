"""Handling of Ctrl-C while `jaxvol` loads and shuts down: the signal ends the process, since a
`KeyboardInterrupt` in a callback of the garbage collector or of a weak reference would be lost."""

import signal
import sys
import threading
from pathlib import PurePath
from typing import Any


def end_at_once() -> None:
    """Make Ctrl-C end the process from now on, if it runs `jaxvol` or `python -m jaxvol`."""
    command = PurePath((sys.argv or [""])[0]).stem == "jaxvol" or sys.orig_argv[1:3] == ["-m", "jaxvol"]
    if command and threading.current_thread() is threading.main_thread():
        _replace(signal.default_int_handler, signal.SIG_DFL)


def raise_again() -> None:
    """Make Ctrl-C raise `KeyboardInterrupt` again."""
    _replace(signal.SIG_DFL, signal.default_int_handler)


def _replace(handler: Any, new_handler: Any) -> None:
    if signal.getsignal(signal.SIGINT) is handler:  # not if the process ignores the signal
        signal.signal(signal.SIGINT, new_handler)


end_at_once()
