"""Are the figures of paper_figs/ made, and do page and README show what is recorded?"""

import re
from pathlib import Path

import pytest
from skimage.io import imread

from experiments import record
from experiments.marches import BOTH
from jaxvol.app import cli
from jaxvol.app.commands import pages
from paper_figs import common, contents, index, records


ROOT = Path(__file__).parents[2]


def test_scripts_compute_nothing():
    """What they draw is recorded, or rendered, by experiments."""
    for path in (ROOT / "paper_figs").glob("*.py"):
        imports = re.findall(r"^ *(?:from|import) (\S+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert not {name.split(".")[0] for name in imports} & {"jax", "jaxvol", "scipy", "skimage"}, path.name


def test_every_figure_has_an_entry_and_every_entry_a_file():
    assert set(index.FIGURES) == {entry.name for entry in contents.ENTRIES}
    assert set(records.RECORDS) == {entry.name for entry in contents.ENTRIES if entry.record}
    assert {entry.file for entry in contents.ENTRIES} == {path.name for path in common.OUTPUT.iterdir()}


def test_the_tables_in_the_readme_are_those_of_the_kept_records():
    text = (ROOT / "paper_figs" / "README.md").read_text(encoding="utf-8")
    assert records.table1(record.read(record.RESULTS / "overhead.json")["result"]) in text
    split = record.read(record.RESULTS / "bricks.json")["result"]
    for condition in split["conditions"]:
        assert records.kim_rows(split, condition) in text
    assert records.kim_once(record.read(record.RESULTS / "bricks_once.json")["result"]) in text
    assert records.lee_tables(record.read(record.RESULTS / "templates.json")["result"]) in text
    measured = record.read(record.RESULTS / "kisti.json")["result"]
    for table in (records.speed_ups(measured, part) for part in ("shaded", "scenes")):
        assert table in text
    assert records.tested_every(measured) in text


def test_the_page_shows_what_the_records_hold_beside_what_the_papers_report(tmp_path):
    """Of the entries that are drawn from records and take no time; the others are copied alike."""
    only = ["fig13", "table1", "chae_fig5", "kisti_table"]
    page = index.make(tmp_path, only=only, say=lambda text: None).read_text(encoding="utf-8")
    for entry in contents.ENTRIES:
        assert (f'id="{entry.name}"' in page) == (entry.name in only)
        assert (tmp_path / entry.file).is_file() == (entry.name in only)
    assert (tmp_path / "fig13.webp").read_bytes() == (common.OUTPUT / "fig13.webp").read_bytes()
    assert imread(tmp_path / "chae_fig5.webp").std() > 10
    row = record.read(record.RESULTS / "overhead.json")["result"]["conditions"]["all samples"]["volumes"]
    ratio = row["bonsai"]["512"][BOTH]["ratio"]["median"]
    assert f"<td>{ratio:.3f} [" in page  # ours
    assert "<td><i>paper: vessels</i></td><td>1024²</td><td>1.192 s</td>" in page
    assert record.read(record.RESULTS / "kisti.json")["commit"] in page
    for target in re.findall(r'(?:src|href)="([^"#]+)"', page):
        assert (tmp_path / target).is_file()


def test_the_command_writes_the_page_and_says_where_there_is_no_checkout(tmp_path, monkeypatch, capsys):
    assert cli.main(["figures", "-o", str(tmp_path / "made"), "--only", "fig12", "lee_fig1"]) == 0
    made = {path.name for path in (tmp_path / "made").iterdir()}
    assert made == {"fig12.webp", "index.html", "lee_fig1.webp"}
    assert str(tmp_path / "made" / "index.html") in capsys.readouterr().out
    monkeypatch.setattr(pages, "__file__", str(tmp_path / "site-packages/jaxvol/app/commands/pages.py"))
    monkeypatch.chdir(ROOT)
    assert pages.checkout() == ROOT
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figures"]) == 2
    assert "scripts of the repository. Run this in a checkout of it" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"only must be some of fig01.*; got fig02"):
        index.make(common.OUTPUT, only=["fig02"])


@pytest.mark.slow
def test_figures_are_measured_and_rendered_anew(tmp_path):
    only = ["fig13", "table1", "lee_tables"]
    page = index.make(tmp_path, run=True, quick=True, only=only, say=lambda text: None)
    result = record.read(tmp_path / "results" / "overhead.json")["result"]
    for condition in result["conditions"].values():
        for rows in (sizes[str(result["sizes"][0])] for sizes in condition["volumes"].values()):
            for row in rows.values():
                assert row["rmse"] > 0
                assert row["ratio"]["low"] <= row["ratio"]["median"] <= row["ratio"]["high"]
    assert "rendered for this page" in page.read_text(encoding="utf-8")
    assert imread(tmp_path / "fig13.webp").shape != imread(common.OUTPUT / "fig13.webp").shape
    assert (tmp_path / "lee_tables.md").read_text() == (common.OUTPUT / "lee_tables.md").read_text()


@pytest.mark.slow
def test_a_figure_is_drawn(tmp_path):
    index.FIGURES["fig09"](["--quick", "--output", str(tmp_path)])
    assert imread(tmp_path / "fig09.webp").std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["fig09.webp"]
