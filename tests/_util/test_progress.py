"""Is what takes long told on standard error, where that is a terminal, and nowhere else?"""

import io
import sys
import time

import jax
import jax.numpy as jnp
import pytest

from jaxvol._util import progress as module
from jaxvol._util.progress import progress


class Terminal(io.StringIO):
    def __init__(self, is_terminal: bool):
        super().__init__()
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal


@pytest.mark.parametrize(("terminal", "quiet"), [(True, False), (True, True), (False, False)])
def test_a_task_is_told_while_it_takes_long(terminal, quiet, monkeypatch):
    monkeypatch.setattr(module, "INTERVAL", 0.02)
    stderr = Terminal(terminal)
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress("drawing frames", 8, quiet=quiet) as done:
        for number in range(4):
            done(f"frame {number}")
        time.sleep(0.1)
    with progress("reading", quiet=quiet):
        time.sleep(0.1)
    told = stderr.getvalue()
    assert bool(told) == (terminal and not quiet)
    if told:
        assert "drawing frames:  50%" in told
        assert "frame 3" in told
        assert "reading: 00:00" in told
        assert told.endswith("\r")  # the line is cleared at the end


def test_nothing_is_told_of_what_is_fast(monkeypatch):
    stderr = Terminal(True)
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress("planning"):
        pass
    assert "planning" not in stderr.getvalue()


def test_the_program_that_is_compiled_is_named(monkeypatch):
    monkeypatch.setattr(module, "INTERVAL", 0.001)
    stderr, programs = Terminal(True), module._compiled_now()
    monkeypatch.setattr(sys, "stderr", stderr)
    with progress("drawing"):

        @jax.jit
        def _a_long_march(x):
            for k in range(200):
                x = jnp.sin(x + k) @ x
            return x

        _a_long_march(jnp.ones((3, 3))).block_until_ready()
        assert programs == []
    assert "drawing, compiling a long march: 00:0" in stderr.getvalue()
