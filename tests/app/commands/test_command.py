"""The command as a whole: its help, how it tells faults, and how it ends when it is interrupted."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from jaxvol.app.cli import main


def test_version_and_help_are_told(capsys):
    told = {}
    for words in (["--version"], ["--help"], ["render", "--help"]):
        with pytest.raises(SystemExit) as stop:
            main(words)
        assert stop.value.code == 0
        told[words[0]] = capsys.readouterr().out
    assert re.fullmatch(r"jaxvol \d+\.\d+\S* \(jax \d+\.\S+\)\n", told["--version"])
    for word in ("demo", "render", "fit", "examples:"):
        assert word in told["--help"]
    for word in ("--preset", "ct_skin_bone", "--camera", "--step", "--view-angle"):
        assert word in told["render"]


BAD = [
    (["render", "x.raw", "--size", "many", "few"], "render: error: argument --size: invalid int value: 'm"),
    (
        ["render", "x.raw", "--memory", "lots"],
        "render: error: argument --memory: must be a number of bytes, such as 256M or 2G; got 'lots'",
    ),
    (
        ["render", "x.raw", "--memory", "0"],
        "--memory: must be a number of bytes, such as 256M or 2G; got '0'",
    ),
    (["fit", "x.raw", "--images", "a.png"], "fit: error: the following arguments are required: cameras (ja"),
    (
        ["render", "x.raw", "--sise", "9", "9"],
        "jaxvol render: error: unrecognized arguments: --sise 9 9 (jaxvol render -",
    ),
    (["info", "x.raw", "y.raw"], "jaxvol info: error: unrecognized arguments: y.raw (jaxvol info --help"),
    (["datasets"], "datasets: error: the following arguments are required: action"),
    (["paint"], "error: argument COMMAND: invalid choice: 'paint' (choose from"),
]


def test_invalid_options_are_named_in_one_line(capsys):
    for words, message in BAD:
        assert main(words) == 2
        printed = capsys.readouterr().err
        assert message in printed
        assert printed.count("\n") == 1
        assert "--help lists the options" in printed


def test_datasets_are_fetched_by_name(capsys):
    assert main(["datasets", "fetch"]) == 2
    assert capsys.readouterr().err.startswith("jaxvol datasets: error: fetch needs a NAME")


def test_too_little_memory_is_told_in_one_line(volume_file, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 16 bytes.")

    monkeypatch.setattr("jaxvol.app.commands.render.frames_of", full)
    assert main(["render", str(volume_file), "-o", str(tmp_path / "a.png")]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("jaxvol render: error: there is not enough memory (RESOURCE_EXHAUSTED")
    assert printed.count("\n") == 1


def test_a_reader_that_ends_early_leaves_no_traceback(monkeypatch, capsys):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as ended:
        monkeypatch.setattr(sys, "stdout", ended)
        assert main(["datasets", "list"]) == 1
    assert capsys.readouterr().err == ""


BUSY = """
import signal, sys
import jax, jax.numpy as jnp
import jaxvol.app.cli
from jaxvol.app.commands import animate, frames
from tests.app.commands.conftest import Drawn

frames.render = Drawn()
signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal, however the tests are run
def display(*_):
    print("under way", flush=True)
    return jax.jit(lambda x: jax.lax.fori_loop(0, 10**9, lambda i, x: jnp.sin(x), x))(1.0).block_until_ready()
animate.displayed = display
sys.exit(jaxvol.app.cli.main(sys.argv[1:]))
"""


def test_ctrl_c_ends_a_command_at_once_and_leaves_no_half_written_files(volume_file, tmp_path):
    """While XLA computes, which no signal stops."""
    folder = tmp_path / "there"
    folder.mkdir()
    (folder / "mine").write_text("kept")
    words = ["animate", str(volume_file), "--preset", "engine", "--no-shade", "--step", "0.4"]
    run = subprocess.Popen(
        [sys.executable, "-c", BUSY, *words, "--size", "16", "16", "-o", str(folder / "a.gif")],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    while "under way" not in run.stdout.readline():
        assert run.poll() is None
    time.sleep(0.5)
    run.send_signal(signal.SIGINT)
    begun = time.monotonic()
    printed = run.communicate(timeout=60)[1]
    assert time.monotonic() - begun < 2
    assert run.returncode == 130
    assert printed.endswith("\njaxvol animate: interrupted\n")  # after what it was doing, if that took long
    assert [path.name for path in folder.iterdir()] == ["mine"]
    assert {path.name for path in tmp_path.iterdir()} == {"there", volume_file.name}
