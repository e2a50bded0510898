"""Does `jaxvol demo` write its pictures, and a page with the code that makes them?"""

import html
import os
import re
import subprocess
import sys

import equinox as eqx
import numpy as np
import pytest
from skimage.io import imread

import jaxvol as jv
from jaxvol.cli import main


SMALL = ["--size", "40", "30", "--resolution", "24"]


def codes(folder):
    """The code on the page, which needs no network."""
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "http" not in page
    return [html.unescape(code) for code in re.findall("<pre>(.*?)</pre>", page, re.DOTALL)]


def test_the_code_on_the_page_makes_the_same_pictures(tmp_path, capsys, monkeypatch, drawn):
    folder = tmp_path / "demo"
    assert main(["demo", "-o", str(folder), *SMALL, "--only", "head", "grain"]) == 0
    assert "compiling and rendering" in capsys.readouterr().out
    names = {"head.png", "before.png", "after.png"}
    assert {path.name for path in folder.iterdir()} == {*names, "index.html"}
    assert set(re.findall(r'src="([^"]+)"', (folder / "index.html").read_text("utf-8"))) == names
    assert len(codes(folder)) == 2
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jv, "render", drawn)
    for code in codes(folder):
        exec(code, {})
    assert eqx.tree_equal(drawn.scenes[:3], drawn.scenes[3:])
    for name in names:
        assert imread(name).shape == (30, 40, 3)
        np.testing.assert_array_equal(imread(name), imread(folder / name))
    assert main(["render", "--like", str(folder / "head.png")]) == 2
    made = "by jaxvol 'demo --only head grain --resolution 24 --size 40 30'"
    assert f"not made by jaxvol render, but, as it says, {made}" in capsys.readouterr().err


@pytest.mark.slow
def test_the_demo_renders_and_fits(tmp_path):
    """Compiled as users do, since the fit takes longer than its programs."""
    command = [sys.executable, "-m", "jaxvol", "demo", "-o", str(tmp_path), *SMALL]
    how = {**os.environ, "XLA_FLAGS": os.environ["FLAGS_OF_USERS"]}
    said = subprocess.run(command, env=how, capture_output=True, text=True, check=True).stdout
    *_, code = codes(tmp_path)
    compile(code, "page", "exec")
    names = "head", "before", "after", "fit_true", "fit_found", "fit_start"
    images = {name: imread(tmp_path / f"{name}.png").astype(float) for name in names}
    for name, image in images.items():
        assert image.shape == (30, 40, 3)
        assert image.std() > (0 if name == "fit_start" else 5), name
    true = images["fit_true"]
    assert np.abs(images["fit_found"] - true).mean() < np.abs(images["fit_start"] - true).mean() / 5
    assert "RMSE of this view" in said
