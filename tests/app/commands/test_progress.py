"""Is it shown on a terminal, and only there, what a command is doing?"""

import io
import time

import pytest

from jaxvol.app.commands import progress
from jaxvol.app.commands.progress import show_progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def shown(monkeypatch):
    """What is written, by a progress of so much patience."""

    def run(stream, *, patience, seconds):
        monkeypatch.setattr(progress, "PATIENCE", patience)
        monkeypatch.setattr(progress, "INTERVAL", 0.01)
        monkeypatch.setattr(progress, "IN_LOGS", 0.05)
        monkeypatch.setattr("sys.stderr", stream)
        with show_progress("rendering a.png, frames") as report:
            report(3, 7)
            time.sleep(seconds)
        return stream.getvalue()

    return run


def test_what_takes_long_is_shown_and_wiped_away(shown):
    text = shown(Terminal(), patience=0.01, seconds=0.3)
    assert "rendering a.png, frames: 3 of 7, 0 s" in text
    assert text.endswith("\r\x1b[K")
    assert "\n" not in text
    assert shown(Terminal(), patience=30, seconds=0) == ""


def test_a_log_has_lines_of_what_takes_long(shown):
    first, second, *_ = shown(io.StringIO(), patience=0.01, seconds=0.3).splitlines()
    assert first == "rendering a.png, frames ..."
    assert second == "rendering a.png, frames: 3 of 7, 0 s"
    assert shown(io.StringIO(), patience=30, seconds=0) == ""


def test_it_ends_with_an_error(monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal())
    with pytest.raises(ZeroDivisionError), show_progress("x"):
        raise ZeroDivisionError
