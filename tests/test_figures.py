"""Do the scripts of experiments/ and paper_figs/ run, at tiny sizes, and write the promised files?"""

import importlib
import json
import re
import subprocess
from functools import cache
from pathlib import Path

import jax
import pytest
from skimage.io import imread

from experiments import (
    again,
    bricks,
    fit_transfer,
    gradient_errors,
    kisti,
    lighting,
    minimum_distance,
    record,
    redraw,
    speed,
    tomography,
)
from experiments.changes import changed_since
from experiments.marches import BOTH, EMPTY, JITTER, PLAIN
from experiments.scenes import PHANTOM
from jaxvol import cli, figures
from paper_figs import (
    chae_fig5,
    common,
    contents,
    index,
    kim_fig9,
    kim_table1,
    kisti_table,
    lee_tables,
    table1,
)


ROOT = Path(__file__).parent.parent
FIGURES = sorted(
    {path.stem for path in (ROOT / "paper_figs").glob("*fig*.py")} - {"chae_fig5", "kim_fig9"} | {"gallery"}
)
"""Figures that need no recorded results."""
RECORDS = sorted(path.stem for path in record.RESULTS.glob("*.json"))
EXPERIMENTS = [name for name in RECORDS if (ROOT / "experiments" / f"{name}.py").is_file()]
"""Those whose record has their name."""
PLANS = "planning", "planning_seed_1"
"""Records of the experiment `planning`."""


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """From an experiment's name to a folder with its result, which is measured when it is first asked for."""
    folder = tmp_path_factory.mktemp("results")

    @cache
    def of(name: str) -> Path:
        importlib.import_module(f"experiments.{name}").main(["--quick", "--output", str(folder)])
        jax.clear_caches()  # a process cannot hold the programs of all
        return folder

    return of


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_figure_is_drawn(name, tmp_path):
    script = importlib.import_module(f"paper_figs.{name}")
    script.main(["--quick", "--output", str(tmp_path)])
    picture = imread(tmp_path / f"{name}.png")
    assert picture.std() > 10
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.png"]


def test_every_figure_in_the_readme_exists():
    text = (ROOT / "paper_figs" / "README.md").read_text(encoding="utf-8")
    lee = ["lee_fig1", "lee_fig4", "lee_fig5", "lee_fig6", "lee_fig_steps"]
    assert [
        "chae_fig6",
        "fig01",
        "fig09",
        "fig10",
        "fig11",
        "fig12",
        "fig13",
        "gallery",
        "kim_fig6",
        "kim_fig8",
        "kisti_fig",
        *lee,
    ] == FIGURES
    for name in FIGURES:
        assert f"output/{name}.png" in text
        large = name in ("gallery", "kisti_fig", "lee_fig5", "lee_fig6")
        assert (common.OUTPUT / f"{name}.png").stat().st_size < (1_500_000 if large else 600_000)


def test_every_script_has_an_entry_and_every_entry_a_file():
    entries = {entry.name for entry in contents.ENTRIES}
    scripts = {path.stem for path in (ROOT / "paper_figs").glob("*.py")}
    assert scripts - entries == {"__init__", "common", "contents", "index"}
    assert {entry.file for entry in contents.ENTRIES} == {path.name for path in common.OUTPUT.iterdir()}


def test_the_page_shows_what_the_records_hold_beside_what_the_papers_report(tmp_path):
    """Of the entries that are drawn from records and take no time; the others are copied alike."""
    only = ["fig13", "table1", "chae_fig5", "kisti_table"]
    page = index.make(tmp_path, only=only, say=lambda text: None).read_text(encoding="utf-8")
    for entry in contents.ENTRIES:
        assert (f'id="{entry.name}"' in page) == (entry.name in only)
        assert (tmp_path / entry.file).is_file() == (entry.name in only)
    assert (tmp_path / "fig13.png").read_bytes() == (common.OUTPUT / "fig13.png").read_bytes()
    assert imread(tmp_path / "chae_fig5.png").std() > 10
    row = record.read(record.RESULTS / "overhead.json")["result"]["conditions"]["all samples"]["volumes"]
    ratio = row["engine"]["512"][BOTH]["ratio"]["median"]
    assert f"<td>{ratio:.3f} [" in page  # ours
    assert "<td><i>paper: vessels</i></td><td>1024²</td><td>1.192 s</td>" in page
    assert "aligned as well 0.775 / 3.745 / 1.772 / 1.216" in page
    assert record.read(record.RESULTS / "kisti.json")["commit"] in page
    for target in re.findall(r'(?:src|href)="([^"#]+)"', page):
        assert (tmp_path / target).is_file()


@pytest.mark.slow
def test_all_figures_are_measured_and_rendered_anew(tmp_path):
    only = ["fig13", "table1", "lee_tables"]
    page = index.make(tmp_path, run=True, quick=True, only=only, say=lambda text: None)
    assert record.read(tmp_path / "results" / "overhead.json")["result"]
    assert "rendered for this page" in page.read_text(encoding="utf-8")
    assert imread(tmp_path / "fig13.png").shape != imread(common.OUTPUT / "fig13.png").shape
    assert (tmp_path / "lee_tables.md").read_text() == (common.OUTPUT / "lee_tables.md").read_text()


def test_charts_are_drawn_again_from_their_records(tmp_path):
    images = {"elevation_angle", "path_traced", "tomography"}  # which no record holds
    assert set(redraw.DRAWN) == set(RECORDS) - images
    redraw.main(["--only", "speed", "overhead", "--output", str(tmp_path)])
    for name in ("speed", "overhead"):
        assert imread(tmp_path / f"{name}.png").shape == imread(record.RESULTS / f"{name}.png").shape


def test_the_command_writes_the_page_and_says_where_there_is_no_checkout(tmp_path, monkeypatch, capsys):
    assert cli.main(["figures", "-o", str(tmp_path / "made"), "--only", "fig12", "lee_fig1"]) == 0
    assert {path.name for path in (tmp_path / "made").iterdir()} == {
        "fig12.png",
        "index.html",
        "lee_fig1.png",
    }
    assert str(tmp_path / "made" / "index.html") in capsys.readouterr().out
    assert cli.main(["figures", "--quick"]) == 2
    assert "--quick goes with --run" in capsys.readouterr().err
    monkeypatch.setattr(figures, "__file__", str(tmp_path / "site-packages" / "jaxvol" / "figures.py"))
    monkeypatch.chdir(ROOT)
    assert figures.checkout() == ROOT
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figures"]) == 2
    assert "Run this in a checkout of the repository" in capsys.readouterr().err


def test_an_unknown_figure_is_refused():
    with pytest.raises(ValueError, match=r"only must be some of fig01.*; got fig02"):
        index.make(common.OUTPUT, only=["fig02"])


@pytest.mark.slow
def test_a_result_is_recorded_again_under_its_name(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(again.ARGUMENTS, "accuracy", "jitter_accuracy --quick --seed 1")
    (tmp_path / "accuracy.json").write_text("old")
    again.main(["--only", "accuracy", "--output", str(tmp_path)])
    assert {file.name for file in tmp_path.iterdir()} == {"accuracy.json", "accuracy.png"}
    found = record.read(tmp_path / "accuracy.json")
    assert found["command"] == "python -m experiments.jitter_accuracy --quick --seed 1"
    assert found["seconds"] > 0
    assert found["commit"] in capsys.readouterr().out
    monkeypatch.setitem(again.ARGUMENTS, "accuracy", "jitter_accuracy --no-such-option")
    before = (tmp_path / "accuracy.json").read_bytes()
    with pytest.raises(subprocess.CalledProcessError):
        again.main(["--only", "accuracy", "--output", str(tmp_path)])
    assert (tmp_path / "accuracy.json").read_bytes() == before


def test_every_record_can_be_made_again(capsys):
    assert set(again.NAMES) == {*EXPERIMENTS, *again.ARGUMENTS}
    again.main(["--list"])
    assert len(capsys.readouterr().out.splitlines()) == len(again.NAMES)


def test_a_record_is_old_once_code_on_which_it_depends_is_changed(tmp_path):
    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        ran = subprocess.run(["git", "-C", str(tmp_path), *who, *words], check=True, capture_output=True)
        return ran.stdout.decode().strip()

    files = {"engine.py": '"""Of what."""\n\nA = 1  # why\n', "bricks/a.py": "B = 1\n", "cli.py": "C = 1\n"}
    for file, text in files.items():
        (tmp_path / "jaxvol" / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "jaxvol" / file).write_text(text)
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "--short", "HEAD")

    def old():
        return [name for name in ("bricks", "speed") if changed_since(f"{commit}+", name, tmp_path)]

    assert old() == []
    (tmp_path / "jaxvol" / "engine.py").write_text('"""Of something else."""\n\nA = 1\n\n"""One."""\n')
    (tmp_path / "jaxvol" / "cli.py").write_text("C = 2\n")
    assert old() == []
    (tmp_path / "jaxvol" / "bricks" / "a.py").write_text("B = 2\n")
    assert old() == ["bricks"]
    (tmp_path / "jaxvol" / "engine.py").unlink()
    assert old() == ["bricks", "speed"]
    assert changed_since(None, "speed", tmp_path)
    assert changed_since("0123456", "speed", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiment_writes_its_result_and_all_that_it_takes_to_run_it_again(measured, name):
    found = record.read(measured(name) / f"{name}.json")
    assert found["command"].startswith(f"python -m experiments.{name} --quick")
    assert found["question"].endswith("?")
    assert found["seed"] == 0
    assert found["versions"]["jaxvol"]
    assert found["device"]["platform"]
    assert found["result"]
    assert imread(measured(name) / f"{name}.png").std() > 10


@pytest.mark.slow
def test_jitter_breaks_the_comb_and_empty_space_jitter_spares_the_face(measured):
    result = record.read(measured("jitter_accuracy") / "jitter_accuracy.json")["result"]
    for rows in (rows for name, rows in result.items() if name.startswith("cut block")):
        for step in {row["step"] for row in rows}:
            at = {row["march"]: row for row in rows if row["step"] == step}
            for march in (JITTER, EMPTY, BOTH):
                assert at[march]["wood grain"] < at[PLAIN]["wood grain"] / 10
            assert at[EMPTY]["boundary noise"] <= at[PLAIN]["boundary noise"] + 1e-12
            assert at[JITTER]["boundary noise"] > 1e-7


@pytest.mark.slow
def test_overhead_is_a_ratio_of_pairs_with_an_error_beside_each_time(measured):
    result = record.read(measured("overhead") / "overhead.json")["result"]
    for condition in result["conditions"].values():
        rows = condition["volumes"][PHANTOM][str(result["sizes"][0])]
        assert rows[PLAIN]["ratio"]["median"] == 1
        for row in rows.values():
            assert row["rmse"] > 0
            assert row["ratio"]["low"] <= row["ratio"]["median"] <= row["ratio"]["high"]


@pytest.mark.slow
def test_only_the_published_starts_can_spoil_a_pixel(measured):
    scenes = record.read(measured("minimum_distance") / "minimum_distance.json")["result"]["scenes"]
    for rows in scenes.values():
        for method, row in rows.items():
            assert row["rmse"] > 0
            assert row["wrong"] == 0 or method.startswith(minimum_distance.PUBLISHED)


@pytest.mark.slow
def test_skipping_leaves_the_error_of_an_image_as_it_is(measured):
    result = record.read(measured("kisti") / "kisti.json")["result"]
    assert list(result["scenes"]) == list(result["shaded"]) == list(kisti.REPORT)
    tables = [*result["scenes"].values(), *result["shaded"].values()]
    for rows in (rows for of_size in tables for rows in of_size.values()):
        for same in {kisti.ESS, kisti.SKIPPED} & set(rows):
            assert rows[same]["rmse"] == pytest.approx(rows[kisti.NEITHER]["rmse"], rel=1e-3)
        assert rows[kisti.BOTH]["rmse"] < rows[kisti.NEITHER]["rmse"] + kisti.LEFT


@pytest.mark.slow
def test_speed_records_its_peers_and_an_error_with_each_time(measured):
    result = record.read(measured("speed") / "speed.json")["result"]
    assert set(result["peers"]) == {speed.VTK, speed.DRJIT}
    for rows in result["volumes"][PHANTOM].values():
        assert {speed.OURS, speed.PLAIN} <= set(rows)
        assert all(row["rmse"] > 0 for row in rows.values())
    assert result["first image"]["compiled before"]["import"] > 0


@pytest.mark.slow
def test_lighting_error_falls_with_more_photons_and_with_blending(measured):
    result = record.read(measured("lighting") / "lighting.json")["result"]
    few, whole = result["frames"][lighting.PHOTONS]
    (blended,) = result["frames"][lighting.BLENDED]
    assert blended["rmse"] < whole["rmse"] < few["rmse"]
    forms = result["energy"]["forms"]
    assert max(forms["conserving"]) <= 1 < max(forms["printed, without its factors of flight"])


@pytest.mark.slow
def test_fits_recover_what_was_hidden(measured):
    scenes = record.read(measured("fit_transfer") / "fit_transfer.json")["result"]["scenes"]
    for rows in scenes.values():
        for points in (fit_transfer.KNOWN, fit_transfer.EVEN):
            assert (
                min(rows[points]["psnr held out"])
                > fit_transfer.GOAL
                > max(rows[points]["psnr at the start"])
            )
            assert rows[points]["steps"] <= fit_transfer.STEPS
    # on such a coarse volume and image, not every start converges to the true pose
    reached = record.read(measured("fit_pose") / "fit_pose.json")["result"]["reached"]
    assert reached["from coarse to fine"] >= max(0.5, reached["as they are"])


@pytest.mark.slow
def test_a_gradient_misses_jumps_at_the_exit_alone(measured):
    rows = record.read(measured("gradient_errors") / "gradient_errors.json")["result"]["relative errors"][
        "left"
    ]
    plain, aligned = rows["ray casting"], rows["ray casting" + gradient_errors.CUT]
    assert plain["position"][0] < 1e-6  # a short difference crosses no jump
    assert aligned["position"][-1] < 0.05 < 0.5 < plain["position"][-1]
    assert plain["colours"][-1] < 1e-6


@pytest.mark.slow
def test_a_density_is_recovered_from_its_line_integrals(measured):
    result = record.read(measured("tomography") / "tomography.json")["result"]["photons"]
    for rows in result.values():
        errors = [row["rmse"] for row in rows[tomography.OURS]["all"]]
        assert min(errors) < errors[0] / 4
    clean = result["no noise"]
    assert clean[tomography.OURS]["rmse"] < clean[tomography.FBP]["rmse"]


@pytest.mark.slow
def test_chae_and_shin_s_figure_5_is_drawn_from_the_record(measured, tmp_path):
    chae_fig5.main(["--results", str(measured("minimum_distance")), "--output", str(tmp_path)])
    assert imread(tmp_path / "chae_fig5.png").std() > 10


@pytest.mark.slow
def test_bricks_are_read_once_with_overlap_and_again_without(measured, tmp_path):
    for row in record.read(measured("bricks") / "bricks.json")["result"]["splits"].values():
        once, again, naive = (row[method] for method in bricks.METHODS)
        assert once["loads"] == once["needed"] < again["loads"]
        assert max(once["largest error"], again["largest error"]) < 2e-5
        assert naive["loads"] == naive["needed"]
    kim_table1.main(["--results", str(measured("bricks")), "--output", str(tmp_path)])
    assert "| 2 × 1 × 2 | *7.58* |" in (tmp_path / "kim_table1.md").read_text(encoding="utf-8")
    kim_fig9.main(["--results", str(measured("bricks")), "--output", str(tmp_path)])
    assert imread(tmp_path / "kim_fig9.png").std() > 10


@pytest.mark.slow
def test_the_report_s_table_is_written_from_the_record(measured, tmp_path):
    kisti_table.main(["--results", str(measured("kisti")), "--output", str(tmp_path)])
    text = (tmp_path / "kisti_table.md").read_text(encoding="utf-8")
    assert "| *report: ERT + ESS* | 2.60 / 3.48 | 3.14 / 4.55 | 2.38 / 3.22 | 2.78 / 4.08 |" in text


@pytest.mark.slow
def test_table_1_is_written_from_the_record(measured, tmp_path):
    table1.main(["--results", str(measured("overhead")), "--output", str(tmp_path)])
    text = (tmp_path / "table1.md").read_text(encoding="utf-8")
    assert PHANTOM in text
    assert "| *paper: vessels* | 1024² | 1.192 s | 1.003 | 1.006 | 1.020 |" in text


def test_the_tables_in_the_readme_are_those_of_the_kept_records():
    text = (ROOT / "paper_figs" / "README.md").read_text(encoding="utf-8")
    assert table1.table(record.read(record.RESULTS / "overhead.json")) in text
    assert kim_table1.table(record.read(record.RESULTS / "bricks.json")) in text
    measured = record.read(record.RESULTS / "kisti.json")
    for table in (kisti_table.table(measured, part) for part in ("shaded", "scenes")):
        assert table in text
    assert kisti_table.tested_every(measured) in text


def test_what_is_said_of_plans_and_choices_is_in_the_records():
    text = " ".join((ROOT / "docs" / "features.md").read_text(encoding="utf-8").split())
    results = [record.read(record.RESULTS / f"{name}.json")["result"] for name in PLANS]
    rows = [row for result in results for row in result["summary"]["by tolerance"].values()]
    images, held, within, searched = (
        sum(row[key] for row in rows) for key in ("scenes", "held", "within 1.5 times", "searched")
    )
    assert f"Of {images} images" in text
    assert f"{held} were within the tolerance" in text
    assert f"{within} of {searched} images" in text
    assert held >= 0.95 * images
    assert max(result["summary"]["planning, in images: largest"] for result in results) <= 16.5
    choices = record.read(record.RESULTS / "model_choice.json")["result"]["problems"].values()
    noisy, clean = ([each["summary"][noise]["chosen"] for each in choices] for noise in ("0.02", "0"))
    assert f"true number of parameters in {sum(found['truth'] for found in noisy)}, and" in text
    assert min(found["truth"] for found in noisy) >= 9
    assert all(found == {"truth": 10, "more": 0} for found in clean)


@pytest.mark.slow
def test_the_templates_in_the_readme_are_those_that_grow():
    text = (ROOT / "paper_figs" / "README.md").read_text(encoding="utf-8")
    assert lee_tables.table() in text


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_kept_records_have_a_chart(name):
    path = record.RESULTS / f"{name}.json"
    assert json.loads(path.read_text(encoding="utf-8"))["device"]["kind"]
    assert path.with_suffix(".png").is_file()
