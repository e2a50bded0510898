"""Does `jaxvol demo` write its pictures, and a page with the code that makes them?"""

import html
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.app.cli import main
from jaxvol.app.commands import pages

from ...scenes import same_trees


SMALL = ["--size", "40", "30", "--resolution", "24"]


def codes(folder):
    """The code on the page, which needs no network."""
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "http" not in page
    return [html.unescape(code) for code in re.findall("<pre>(.*?)</pre>", page, re.DOTALL)]


def test_the_page_holds_the_code_that_made_its_pictures(tmp_path, capsys, monkeypatch, drawn):
    folder = tmp_path / "demo"
    monkeypatch.setattr(jv, "render", drawn)
    monkeypatch.setattr(pages, "PICTURES", {f: pages.PICTURES[f] for f in (pages.head, pages.grain)})
    assert main(["demo", "-o", str(folder), *SMALL]) == 0
    assert "demo: before, after\n" in capsys.readouterr().out
    names = {"head.png", "before.png", "after.png"}
    assert {path.name for path in folder.iterdir()} == {*names, "index.html"}
    assert set(re.findall(r'src="([^"]+)"', (folder / "index.html").read_text("utf-8"))) == names
    assert len(codes(folder)) == 2
    for name, code in zip(("head", "grain"), codes(folder), strict=True):
        defined: dict[str, Any] = {"Path": Path}
        exec(code, defined)
        defined[name](tmp_path, (40, 30), 24)
    assert same_trees(drawn.scenes[:3], drawn.scenes[3:])
    for name in names:
        assert imread(folder / name).shape == (30, 40, 3)
        np.testing.assert_array_equal(imread(tmp_path / name), imread(folder / name))


def test_nothing_is_left_where_the_code_fails(tmp_path, capsys, monkeypatch):
    def fails(*_, **__):
        raise ValueError("no light")

    monkeypatch.setattr(jv, "render", fails)
    assert main(["demo", "-o", str(tmp_path / "demo"), *SMALL]) == 2
    assert capsys.readouterr().err.endswith("error: no light\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_demo_renders_and_fits(tmp_path):
    """Compiled as users do, since the fit takes longer than its programs."""
    command = [sys.executable, "-m", "jaxvol", "demo", "-o", str(tmp_path), *SMALL]
    how = {**os.environ, "XLA_FLAGS": os.environ["FLAGS_OF_USERS"]}
    subprocess.run(command, env=how, capture_output=True, text=True, check=True)
    names = "head", "before", "after", "fit_true", "fit_found", "fit_start"
    images = {name: imread(tmp_path / f"{name}.png").astype(float) for name in names}
    for name, image in images.items():
        assert image.shape == (30, 40, 3)
        assert image.std() > (0 if name == "fit_start" else 5), name
    true = images["fit_true"]
    assert np.abs(images["fit_found"] - true).mean() < np.abs(images["fit_start"] - true).mean() / 5
