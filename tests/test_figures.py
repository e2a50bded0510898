"""The scripts of experiments/ and paper_figs/ run, tiny, and write what they say."""

import importlib
import json
from pathlib import Path

import pytest
from skimage.io import imread

from experiments import jitter_accuracy, overhead, record
from experiments.marches import BOTH, EMPTY, JITTER, PLAIN
from experiments.scenes import PHANTOM
from paper_figs import common, table1


ROOT = Path(__file__).parent.parent
FIGURES = sorted(path.stem for path in (ROOT / "paper_figs").glob("fig*.py"))
EXPERIMENTS = sorted(path.stem for path in (ROOT / "experiments" / "results").glob("*.json"))


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A folder into which both experiments have written."""
    folder = tmp_path_factory.mktemp("results")
    for experiment in (jitter_accuracy, overhead):
        experiment.main(["--quick", "--output", str(folder)])
    return folder


@pytest.mark.parametrize(
    "name", [n if n == "fig13" else pytest.param(n, marks=pytest.mark.slow) for n in FIGURES]
)
def test_figure_is_drawn(name, tmp_path):
    script = importlib.import_module(f"paper_figs.{name}")
    script.main(["--quick", "--output", str(tmp_path)])
    picture = imread(tmp_path / f"{name}.png")
    assert picture.std() > 10
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.png"]


def test_every_figure_that_is_told_of_is_there():
    told = (ROOT / "paper_figs" / "README.md").read_text(encoding="utf-8")
    assert FIGURES == ["fig01", "fig09", "fig10", "fig11", "fig12", "fig13"]
    for name in FIGURES:
        assert f"output/{name}.png" in told
        assert (common.OUTPUT / f"{name}.png").stat().st_size < 300_000


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jitter_accuracy", "overhead"])
def test_experiment_writes_its_result_and_all_that_it_takes_to_run_it_again(measured, name):
    found = record.read(measured / f"{name}.json")
    assert found["command"].startswith(f"python -m experiments.{name} --quick")
    assert found["question"].endswith("?")
    assert found["seed"] == 0
    assert found["versions"]["jaxvol"]
    assert found["device"]["platform"]
    assert found["result"]
    assert imread(measured / f"{name}.png").std() > 10


@pytest.mark.slow
def test_jitter_breaks_the_comb_and_empty_space_jitter_spares_the_face(measured):
    result = record.read(measured / "jitter_accuracy.json")["result"]
    for rows in (rows for name, rows in result.items() if name.startswith("cut block")):
        for step in {row["step"] for row in rows}:
            at = {row["march"]: row for row in rows if row["step"] == step}
            for march in (JITTER, EMPTY, BOTH):
                assert at[march]["wood grain"] < at[PLAIN]["wood grain"] / 10
            assert at[EMPTY]["boundary noise"] <= at[PLAIN]["boundary noise"] + 1e-12
            assert at[JITTER]["boundary noise"] > 1e-7


@pytest.mark.slow
def test_overhead_is_a_ratio_of_pairs_with_an_error_beside_each_time(measured):
    rows = record.read(measured / "overhead.json")["result"]["volumes"][PHANTOM]
    assert rows[PLAIN]["ratio"]["median"] == 1
    for row in rows.values():
        assert row["rmse"] > 0
        assert row["ratio"]["low"] <= row["ratio"]["median"] <= row["ratio"]["high"]


@pytest.mark.slow
def test_table_1_is_told_from_the_record(measured, tmp_path):
    table1.main(["--results", str(measured), "--output", str(tmp_path)])
    told = (tmp_path / "table1.md").read_text(encoding="utf-8")
    assert PHANTOM in told
    assert "| *paper: vessels* | 1.192 s | 1.003 | 1.006 | 1.020 |" in told


def test_the_table_in_the_readme_is_that_of_the_kept_record():
    told = (ROOT / "paper_figs" / "README.md").read_text(encoding="utf-8")
    assert table1.table(record.read(record.RESULTS / "overhead.json")) in told


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_kept_records_have_a_chart(name):
    path = record.RESULTS / f"{name}.json"
    assert json.loads(path.read_text(encoding="utf-8"))["device"]["kind"]
    assert path.with_suffix(".png").is_file()
