"""The command as a whole: its help, how it tells faults, and how it ends when it is interrupted."""

import ast
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

import jaxvol
from jaxvol._util.interruption import end_at_once, raise_again
from jaxvol._util.memory import require_room
from jaxvol.app.cli import main, parser_of_all
from jaxvol.app.commands.options import parsed


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


def test_help_and_version_import_nothing_that_takes_long():
    code = "import sys, jaxvol.app.cli as cli; cli.main([sys.argv[1]])"
    code = (
        f"import atexit, sys; atexit.register(lambda: print({{'jax', 'scipy'}} & sys.modules.keys())); {code}"
    )
    for word in ("--version", "--help"):
        ran = subprocess.run([sys.executable, "-c", code, word], capture_output=True, text=True)
        assert ran.stdout.endswith("\nset()\n"), ran


def zarr(folder, shape, chunks, names=None):
    header = {"zarr_format": 2, "shape": shape, "chunks": chunks, "dtype": "|u1", "compressor": None}
    folder.mkdir()
    (folder / ".zarray").write_text(json.dumps(header | {"fill_value": 0, "order": "F", "filters": None}))
    (folder / ".zattrs").write_text(json.dumps({"_ARRAY_DIMENSIONS": names}))


def written(folder):
    """Files, each of which is refused by a check of ours; those of sizes have small limits in the test."""
    nrrd = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n"
    head = b"{'descr': '|u1', 'fortran_order': False, 'shape': (True, 2, 2), }\n"
    contents = {
        "escapes.mhd": b"DimSize = 2 2 2\nElementType = MET_UCHAR\nElementDataFile = \x1b[2J\x07\n",
        "long.nrrd": nrrd + b"content: " + b"x" * 60 + b"\n\n" + bytes(8),
        "many.nrrd": nrrd + b"".join(b"k%d:=1\n" % i for i in range(12)) + b"\n" + bytes(8),
        "beside.nhdr": nrrd + b"data file: folder\n\n",
        "bool.npy": b"\x93NUMPY\x01\0" + len(head).to_bytes(2, "little") + head + bytes(4),
        "good.npy": b"\x93NUMPY\x01\0"
        + len(head).to_bytes(2, "little")
        + head.replace(b"True", b"   2")
        + bytes(8),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    (folder / "folder").mkdir()
    (folder / "circle_2x2x2_uint8.raw").symlink_to("circle_2x2x2_uint8.raw")
    zarr(folder / "names", [2, 2, 2], [2, 2, 2], [["x"], 1, None])
    zarr(folder / "chunks", [2, 2, 2], [4, 4, 4])
    zarr(folder / "large", [9, 9, 9], [9, 9, 9])


BAD_FILES = {
    "info escapes.mhd": r"there is no file of its voxels, '.*\\x1b\[2J\\x07'",
    "info \x1b[2J.npy": r"there is no file \\x1b\[2J.npy",
    "info long.nrrd": "its header has the field 'content: x+",
    "info many.nrrd": "its header has more than 8 fields",
    "info beside.nhdr": "holds its voxels, or names one file of them",
    "info bool.npy": r"no valid .npy header \(.*True, 2, 2",
    "render circle_2x2x2_uint8.raw": "there is no file circle",
    "render good.npy -o circle_2x2x2_uint8.raw/a.png": "--output: .* cannot be written",
    "render good.npy --size 99999999999999999999 8": "size must be .* fewer than",
    "animate good.npy --frames " + "9" * 400: "--frames must be an integer from 1 to",
    "info names": "_ARRAY_DIMENSIONS must be names",
    "info chunks": "chunks that are not much larger than it",
    "info large": "asks for .* GiB of memory",
}


def test_bad_files_are_told_in_one_line(tmp_path, monkeypatch, capsys):
    for module in ("SimpleITK", "tensorstore"):
        pytest.importorskip(module)
    monkeypatch.chdir(tmp_path)
    # the guards keep readers of other libraries from headers that ask for more than there is
    monkeypatch.setattr("jaxvol.io.formats.text_headers.LONGEST", 40)
    monkeypatch.setattr("jaxvol.io.formats.text_headers.MOST_FIELDS", 8)
    monkeypatch.setattr("jaxvol.bricks.opening.LARGE", 32)
    monkeypatch.setattr("jaxvol.bricks.opening.BEYOND", 2)
    monkeypatch.setattr(
        "jaxvol.bricks.opening.require_room", lambda wanted, of: require_room(wanted * 2**30, of)
    )
    written(tmp_path)
    for words, message in BAD_FILES.items():
        assert main(words.split()) == 2
        printed = capsys.readouterr().err
        assert re.search(message, printed), printed
        assert printed.removesuffix("\n").isprintable()


def test_words_in_short_and_small_negative_numbers_are_read():
    words = ["render", "a.raw", "--size", "40", "--background", "red", "--direction", "-1e-5", "-.5", "-1"]
    found = parsed(parser_of_all(), words)
    assert (found.size, found.background, found.direction) == ([40, 40], [1, 0, 0], [-1e-5, -0.5, -1])


def test_too_little_memory_is_told_in_one_line(volume_file, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 16 bytes.")

    monkeypatch.setattr("jaxvol.app.commands.render.with_march", full)
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


def test_ctrl_c_ends_the_process_before_and_after_the_command(monkeypatch):
    """While modules load and Python shuts down, where a `KeyboardInterrupt` may be lost."""
    tree = ast.parse(Path(jaxvol.__file__).read_text(encoding="utf-8"))
    first = next(each for each in tree.body if isinstance(each, ast.Import | ast.ImportFrom))
    assert ast.unparse(first) == "from ._util import interruption as _interruption"
    before = signal.getsignal(signal.SIGINT)
    try:
        for words, given, ended in (
            (["/bin/jaxvol", "info"], signal.default_int_handler, signal.SIG_DFL),
            (["-m", "jaxvol"], signal.default_int_handler, signal.SIG_DFL),
            (["/bin/pytest"], signal.default_int_handler, signal.default_int_handler),
            (["/bin/jaxvol"], signal.SIG_IGN, signal.SIG_IGN),  # as `nohup` and `&` ask for
        ):
            monkeypatch.setattr(sys, "argv", words)
            monkeypatch.setattr(sys, "orig_argv", ["python", *words])
            signal.signal(signal.SIGINT, given)
            end_at_once()
            assert signal.getsignal(signal.SIGINT) is ended
            raise_again()
            assert signal.getsignal(signal.SIGINT) is given
    finally:
        signal.signal(signal.SIGINT, before)


BUSY = """
import signal, sys
import jax, jax.numpy as jnp
import jaxvol.app.cli
from jaxvol.app import picture
from jaxvol.app.commands import animate
from tests.app.commands.conftest import Drawn

picture.render = Drawn()
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
