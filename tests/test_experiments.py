"""Do the scripts of experiments/ run, at tiny sizes, and write what it takes to run them again?"""

import importlib
from itertools import product
from pathlib import Path

import jax
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from experiments import (
    again,
    elevation_angle,
    gradient_errors,
    record,
    redraw,
)
from experiments.voxel_distances import distances

from .scenes import slow


ROOT = Path(__file__).parent.parent
COMPARE = {"compare"}
"""An experiment that takes the commits which it compares, and so is not run by its name."""
RECORDS = {path.stem for path in record.RESULTS.glob("*.json")} - COMPARE
EXPERIMENTS = sorted(name for name in RECORDS if (ROOT / "experiments" / f"{name}.py").is_file())
"""Those whose record has their name."""


def gradients_miss_jumps_at_the_exit_alone(result):
    rows = result["relative errors"]["left"]
    plain, aligned = rows["ray casting"], rows["ray casting" + gradient_errors.CUT]
    assert plain["position"][0] < 1e-6  # a short difference crosses no jump
    assert aligned["position"][-1] < 0.05 < 0.5 < plain["position"][-1]
    assert plain["colours"][-1] < 1e-6


CHECKS = {
    "gradient_errors": gradients_miss_jumps_at_the_exit_alone,
    "elevation_angle": lambda result: None,
}
"""Experiments that are run, and what their results must show."""


@pytest.mark.parametrize("name", ["elevation_angle", *slow("gradient_errors")])
def test_experiment_writes_its_result_and_all_that_it_takes_to_run_it_again(name, tmp_path):
    importlib.import_module(f"experiments.{name}").main(["--quick", "--output", str(tmp_path)])
    jax.clear_caches()
    found = record.read(tmp_path / f"{name}.json")
    assert found["command"].startswith(f"python -m experiments.{name} --quick")
    assert found["question"].endswith("?")
    assert found["seed"] == 0
    assert found["versions"]["jaxvol"]
    assert found["device"]["platform"]
    assert found["result"]
    assert imread(tmp_path / f"{name}.png").std() > 10
    CHECKS[name](found["result"])


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_takes_its_options(name, capsys):
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"experiments.{name}").main(["--help"])
    assert ended.value.code == 0
    assert "--quick" in capsys.readouterr().out


def test_every_record_has_a_chart_that_can_be_drawn_and_can_be_made_again(tmp_path, capsys):
    images = {"elevation_angle", "path_traced", "tomography"}  # which no record holds
    assert set(redraw.DRAWN) - COMPARE == RECORDS - images
    redraw.main(["--only", "overhead", "--output", str(tmp_path)])
    assert min(imread(tmp_path / "overhead.png").shape[:2]) >= 256
    assert set(again.NAMES) - COMPARE == {*EXPERIMENTS, *again.ARGUMENTS} - COMPARE
    again.main(["--list", "--only", "speed"])
    assert "speed" in capsys.readouterr().out


def test_a_record_made_again_replaces_its_files_and_pictures_and_no_other(tmp_path, monkeypatch):
    def run(command, check):
        new = Path(command[-1])
        (new / "pareto" / "engine").mkdir(parents=True)
        for name in ("pareto.json", "pareto.png", "pareto/engine/left.webp", "pareto/engine/scene.json"):
            (new / name).write_text("new")

    monkeypatch.setattr(again.subprocess, "run", run)
    (tmp_path / "pareto.json").write_text("old")
    (tmp_path / "speed.json").write_text("old")
    again.recorded("pareto", tmp_path)
    files = {p.relative_to(tmp_path).as_posix(): p.read_text() for p in tmp_path.rglob("*") if p.is_file()}
    made = dict.fromkeys(("pareto.json", "pareto.png", "pareto/engine/left.webp"), "new")
    assert files == made | {"speed.json": "old"}


# -- what experiments compute themselves ------------------------------------------------------------------


def test_perfect_shells_tell_under_which_angle_they_were_made_unless_they_shift():
    """Planes shifted at random by a fifth of a sample: the readings differ by a hundredth."""
    rng, sample = np.random.default_rng(0), np.arange(elevation_angle.SHAPE[2])
    for reading, half in elevation_angle.READINGS.items():
        echo = elevation_angle.made(half, elevation_angle.SHAPE)
        found = elevation_angle.measure(echo)
        assert found["shape that leaves least"] == elevation_angle.COSINE
        assert found["reading"] == reading
        for plane in echo[1:]:
            plane[:] = np.interp(sample + 0.2 * rng.normal(), sample, plane[0])
        assert elevation_angle.measure(echo)["reading"] == "not settled"


def test_distances_of_voxels_are_those_to_the_nearest_cell_that_shows_anything():
    """Two small bright things, one of them at a corner."""
    data = np.zeros((14, 11, 9), np.float32)
    data[0, 0, 0], data[9:11, 5, 6] = 1, 0.4
    grid = distances(jv.Volume(data), jv.TransferFunction([0.1, 1], np.ones((2, 3)), [0, 2]))
    cells = list(product(*(range(n - 1) for n in data.shape)))
    shown = [c for c in cells if data[tuple(slice(i, i + 2) for i in c)].max() > 0.1]
    nearest = [np.abs(np.asarray(c) - shown).max(axis=1).min() for c in cells]
    np.testing.assert_array_equal(grid.distance(), nearest)
