"""Does a file appear whole or not at all?"""

import contextlib
import os
import threading
from pathlib import Path

import pytest

from jaxvol._util import whole_files
from jaxvol._util.checks import output_file
from jaxvol._util.whole_files import whole_file


def test_a_file_takes_its_place_at_the_end(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("old")
    with whole_file(path) as part:
        assert part.suffix == ".png"
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["a.png"]


def test_after_an_error_all_is_as_it_was(tmp_path):
    (tmp_path / "a.png").write_text("old")
    with contextlib.suppress(ZeroDivisionError), whole_file(tmp_path / "a.png") as part:
        part.write_text("new")
        raise ZeroDivisionError
    assert (tmp_path / "a.png").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.png"]


def test_folders_are_made_for_what_becomes_whole_and_not_left_behind_otherwise(tmp_path):
    with contextlib.suppress(ZeroDivisionError), whole_file(tmp_path / "deep" / "down" / "a") as part:
        part.write_text("half")
        raise ZeroDivisionError
    assert os.listdir(tmp_path) == []
    output_file("path", tmp_path / "deep" / "down" / "a")
    assert os.listdir(tmp_path) == []
    with whole_file(tmp_path / "deep" / "down" / "a") as part:
        part.write_text("whole")
    assert (tmp_path / "deep" / "down" / "a").read_text() == "whole"
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"file is not a folder"):
        output_file("path", tmp_path / "file" / "deep" / "a")


def test_after_an_interruption_nothing_appears(tmp_path, monkeypatch):
    """Not even by a thread that goes on, since the process ends at once."""
    monkeypatch.chdir(tmp_path)
    begun, removed, done = threading.Event(), threading.Event(), threading.Event()

    def write():
        gone = contextlib.suppress(FileNotFoundError)
        with gone, whole_file(Path("a.png")) as part:
            part.write_text("half")
            begun.set()
            removed.wait()
        done.set()

    threading.Thread(target=write, daemon=True).start()
    assert begun.wait(20)
    assert os.listdir(tmp_path)
    whole_files.remove_unfinished()
    removed.set()
    assert done.wait(20)
    assert os.listdir(tmp_path) == []


def test_a_link_stays_one_and_what_it_points_to_is_replaced(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a").write_text("old")
    (tmp_path / "link.png").symlink_to(tmp_path / "deep" / "a")
    with whole_file(tmp_path / "link.png") as part:
        assert part.suffix == ".png"  # by which writers choose a format
        part.write_text("new")
    assert (tmp_path / "link.png").is_symlink()
    assert (tmp_path / "deep" / "a").read_text() == "new"


def test_a_pipe_is_written_to_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with whole_file(pipe) as part:
        part.write_text("whole")
    assert os.read(reader, 100) == b"whole"
    os.close(reader)
    assert pipe.is_fifo()
    assert os.listdir(tmp_path) == ["pipe"]
