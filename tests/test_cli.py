"""The command line, run as a user would."""

import subprocess
import sys

import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.cli import main


@pytest.fixture(autouse=True)
def programs(tmp_path, monkeypatch):
    """Compiled programs are kept in a folder of the test's own."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "programs"))


@pytest.fixture
def volume_file(tmp_path):
    volume = jv.phantom("engine", 24)
    path = tmp_path / "engine_24x24x24_uint8.raw"
    path.write_bytes(np.asarray(volume.data).transpose(2, 1, 0).tobytes())
    return path


def test_demo_writes_pictures_and_says_what_it_took(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path), "--size", "40", "30", "--resolution", "24"]) == 0
    told = capsys.readouterr().out
    for name in ("head.png", "before.png", "after.png"):
        image = imread(tmp_path / name)
        assert image.shape == (30, 40, 3)
        assert image.std() > 5
        assert str(tmp_path / name) in told
    assert "compilation" in told
    assert "cpu" in told.lower() or "gpu" in told.lower()


def test_render_writes_what_the_library_renders(volume_file, tmp_path, capsys):
    output = tmp_path / "folder" / "engine.png"
    camera = [
        "--camera",
        "40",
        "-30",
        "20",
        "11.5",
        "11.5",
        "11.5",
        "--view-up",
        "0",
        "0",
        "1",
        "--zoom",
        "1.5",
    ]
    look = ["--preset", "engine", "--size", "32", "24", "--step", "0.4", "--background", "0", "0", "0"]
    assert main(["render", str(volume_file), *camera, *look, "-o", str(output)]) == 0
    assert "million samples" in capsys.readouterr().out
    view = jv.Camera((40, -30, 20), (11.5,) * 3, (0, 0, 1), size=(32, 24)).zoom(1.5)
    march = jv.March(0.4, (jv.AlphaCorrection(), jv.EarlyTermination()), "midpoint")
    linear = jv.render(jv.load(volume_file), jv.preset("engine"), view, march).image((0, 0, 0))
    assert np.abs(imread(output) - np.asarray(jv.to_srgb(linear)) * 255).max() <= 1


def test_render_needs_nothing_but_a_file(volume_file, tmp_path):
    output = tmp_path / "out.png"
    assert main(["render", str(volume_file), "-o", str(output), "--size", "16", "16"]) == 0
    assert imread(output).std() > 5


BAD = {
    "no file": (["nowhere.raw"], "there is no file"),
    "preset": (["FILE", "--preset", "moon"], "preset must be one of"),
    "step": (["FILE", "--step", "0"], "step must be greater than 0; got 0"),
    "size": (["FILE", "--size", "0", "5"], "size must be"),
    "camera": (["FILE", "--camera", "1", "1", "1", "1", "1", "1"], "position must differ from focal_point"),
    "spacing": (["FILE", "--spacing", "1", "1", "-1"], "spacing must be positive"),
    "shape": (["FILE", "--shape", "24", "24", "25"], "cut short"),
    "dtype": (["FILE", "--dtype", "uint7"], "dtype must be"),
    "clim": (["FILE", "--preset", "engine", "--clim", "5", "4"], "clim must be"),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_are_one_line_and_exit_code_2(case, volume_file, tmp_path, capsys):
    arguments, message = BAD[case]
    arguments = [str(volume_file) if a == "FILE" else a for a in arguments]
    output = tmp_path / "x.png"
    assert main(["render", *arguments, "-o", str(output)]) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert told.err.startswith("jaxvol render: error: ")
    assert message in told.err
    assert not output.exists()


def test_a_slip_in_the_options_is_told_by_usage(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["render", "x.raw", "--size", "many", "few"])
    assert stop.value.code == 2
    assert "--size" in capsys.readouterr().err


def test_help_names_commands_presets_and_examples():
    told = subprocess.run(
        [sys.executable, "-m", "jaxvol", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for word in ("demo", "render", "examples:"):
        assert word in told
    told = subprocess.run(
        [sys.executable, "-m", "jaxvol", "render", "--help"], capture_output=True, text=True, check=True
    ).stdout
    for word in ("--preset", "ct_skin_bone", "--camera", "--step", "--view-angle"):
        assert word in told


def test_as_a_program_a_fault_leaves_no_traceback(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "jaxvol", "render", "nowhere.raw"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 2
    assert "Traceback" not in run.stderr
