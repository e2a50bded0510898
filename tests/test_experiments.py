"""Do the scripts of experiments/ run, at tiny sizes, and write what it takes to run them again?"""

import importlib
import re
import tempfile
from argparse import Namespace
from pathlib import Path

import pytest
from skimage.io import imread

from experiments import charts, record, redraw
from experiments.harness import experiment, recorded


ROOT = Path(__file__).parent.parent
COMPARE = {"compare"}
"""An experiment that takes the commits which it compares, and so is not run by its name."""
RECORDS = {path.stem for path in record.RESULTS.glob("*.json")} - COMPARE
EXPERIMENTS = sorted(name for name in RECORDS if (ROOT / "experiments" / f"{name}.py").is_file())
"""Those whose record has their name."""


def draw(result):
    figure, ((panel,),) = charts.panels(1, 1, 4, 4)
    panel.plot(list(map(int, result["squares"])), list(result["squares"].values()))
    return figure


@experiment(size=3, sizes=(1, 2, 3), quick={"size": 2, "sizes": (1, 2)})
def squares(chosen):
    rows = {str(size): size**2 for size in chosen.sizes}
    rows |= recorded(chosen, "squares", (), {"size": 3})
    return {"size": chosen.size, "squares": rows}


def test_experiment_writes_its_result_and_all_that_it_takes_to_run_it_again(tmp_path):
    squares(["--quick", f"--output={tmp_path}", "--seed", "4"])
    name = __name__.split(".")[-1]
    found = record.read(tmp_path / f"{name}.json")
    assert found["command"] == f"python -m {__name__} --quick --seed 4"
    assert found["question"] == (__doc__ or "").strip()
    assert found["seed"] == 4
    assert found["versions"]["jaxvol"]
    assert found["device"]["platform"]
    assert found["result"] == {"size": 2, "squares": {"1": 1, "2": 4}}
    assert imread(tmp_path / f"{name}.png").std() > 10
    squares(["--output", str(tmp_path)])
    assert record.read(tmp_path / f"{name}.json")["result"]["squares"] == {"1": 1, "2": 4, "3": 9}


def test_quick_runs_overwrite_no_record(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = {path: path.stat().st_mtime_ns for path in record.RESULTS.iterdir()}
    squares(["--quick"])
    (made,) = tmp_path.iterdir()
    name = __name__.split(".")[-1]
    assert {path.name for path in made.iterdir()} == {f"{name}.json", f"{name}.png"}
    assert str(made) in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in record.RESULTS.iterdir()} == before


def test_what_is_not_measured_again_is_kept_with_its_commit_if_it_is_of_the_same_sizes(tmp_path):
    result = {"size": 3, "rows": {"a": {"seconds": 1}, "b": {"seconds": 2}}}
    path = record.write(tmp_path / "kept.json", "?", result, seed=0, command=["experiments.kept"])
    made = {key: record.read(path)[key] for key in ("commit", "command")}
    chosen = Namespace(path=path, quick=False)
    assert recorded(chosen, "rows", ["b", "c"], {"size": 3}) == {"b": {"measured": made, "seconds": 2}}
    assert recorded(chosen, "rows", ["b"], {"size": 4}) == {}
    chosen.quick = True
    assert recorded(chosen, "rows", ["b"], {"size": 3}) == {}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_takes_its_options(name, capsys):
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"experiments.{name}").main(["--help"])
    assert ended.value.code == 0
    assert "--quick" in capsys.readouterr().out


def test_charts_that_pages_show_can_be_drawn(tmp_path):
    drawn = set(redraw.DRAWN)
    for name in redraw.DRAWN:
        module = importlib.import_module(record.read(record.RESULTS / f"{name}.json")["command"].split()[2])
        assert callable(module.draw)
        drawn |= set(getattr(module, "more", {}))
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "paper_figs").glob("*.md")]
    shown = {name for page in pages for name in re.findall(r"results/(\w+)\.png", page.read_text("utf-8"))}
    kept = {path.stem for path in record.RESULTS.glob("*.png")}
    assert shown <= drawn | kept
    assert "speed" in shown
    redraw.main(["--only", "overhead", "--output", str(tmp_path)])
    assert min(imread(tmp_path / "overhead.png").shape[:2]) >= 256
