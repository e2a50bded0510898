"""Do the examples in documents run, as they stand there?"""

import importlib
import inspect
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxvol as jv
from docs import registry

from .reference import ROOT


BLOCK = re.compile(r"^( *)```python\n(.*?)^\1```", re.DOTALL | re.MULTILINE)


def examples(name):
    """Blocks of Python code in a document, which share one namespace."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return [textwrap.dedent(block) for _, block in BLOCK.findall(text)]


PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))
DOCUMENTS = {name: found for name in ("README.md", "CONTRIBUTING.md", *PAGES) if (found := examples(name))}
LONG = "jv.fit(", "jv.plan("

FEWER = {"96": "24", "(256, 256)": "(20, 16)", "(96, 96)": "(20, 16)"}
"""Voxels and pixels of README's examples, with which they take seconds."""


def run(blocks, **names):
    """What the blocks define, of which an image, `rendering` or `image`, shows something."""
    for block in blocks:
        exec(block, names)
    image = names["rendering"].rgba if "rendering" in names else names["image"]
    assert float(np.asarray(image).max()) > 0.1
    assert_tells_something(image)
    return names


def assert_tells_something(value):
    """Every float is finite, and some are not 0."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(value) if hasattr(leaf, "dtype")]
    floats = [leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.inexact)]
    assert all(np.isfinite(leaf).all() for leaf in floats)
    assert any(leaf.any() for leaf in floats)


TEXTS = ["README.md", "CONTRIBUTING.md", "paper_figs/README.md", "experiments/results/README.md", *PAGES]
SOURCES = [path.relative_to(ROOT).as_posix() for path in (ROOT / "jaxvol").rglob("*.py")]
NOTEBOOKS = [path.relative_to(ROOT).as_posix() for path in (ROOT / "notebooks").glob("*.ipynb")]
MADE = "jaxvol-demo/"
"""A folder that a command makes."""


def is_there(name):
    """Whether a dotted name is that of a module, or of something in one; `jv` for `jaxvol`."""
    parts = name.replace("jv.", "jaxvol.").split(".")
    for end in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:end]))
        except ImportError:
            continue
        for part in parts[end:]:
            kinds = found.__mro__ if inspect.isclass(found) else ()
            fields = [name for kind in kinds for name in inspect.get_annotations(kind)]
            if not hasattr(found, part):  # a field, or what a subclass must have
                abstract = getattr(found, "__abstractclassvars__", ()), getattr(found, "__abstractvars__", ())
                return part in fields or any(part in names for names in abstract)
            found = getattr(found, part)
        return True
    return False


def is_file(path, page):
    """Whether a path is one of the repository, from its root, a folder of code, or the page's folder."""
    folders = (".", "jaxvol", "tests", "experiments", (ROOT / page).parent)
    return path == MADE or any((ROOT / folder / path).exists() for folder in folders)


def missing(text, page):
    """Names and files of a text that are not there. Words in capitals, and pictures, stand for others."""
    names = re.findall(r"(?<![\w/.-])(?:jv|jaxvol)(?:\.[A-Za-z_]\w*)+", text)
    members = (
        f"jv.{name}" for name in re.findall(r"`([A-Z]\w+\.\w+)", text) if is_there(f"jv.{name.split('.')[0]}")
    )
    modules = re.findall(r"python -m ((?:experiments|tests|docs|paper_figs)[\w.]*\w)", text)
    paths = re.findall(r"`([\w./-]+(?:\.(?:py|pyi|md|ipynb|sh)|/))`", text)
    paths += re.findall(
        r"(?<![\w/])(?:experiments|tests|docs|paper_figs|notebooks)/[\w/]+\.(?:py|md|ipynb)\b", text
    )
    gone = {name for name in (*names, *members, *modules) if not is_there(name)}
    gone |= {path for path in paths if not is_file(path, page) and Path(path).parts[0] != ".."}
    others = r"(?<![a-z])(NAME|FILE|FOLDER)|\.(png|gif)$"
    return sorted(name for name in gone if not re.search(others, name))


@pytest.mark.parametrize("page", TEXTS)
def test_a_page_names_what_is_there(page):
    assert missing((ROOT / page).read_text(encoding="utf-8"), page) == []


def test_docstrings_comments_and_notebooks_name_what_is_there():
    for file in (*SOURCES, *NOTEBOOKS):
        assert missing((ROOT / file).read_text(encoding="utf-8"), file) == [], file


def test_what_is_gone_is_told():
    text = (
        "`tests/gone.py`, `jv.render`, `jv.gone`, `Camera.zoom`, `Camera.gone`, `python -m experiments.gone`"
    )
    assert missing(text, "README.md") == ["experiments.gone", "jv.Camera.gone", "jv.gone", "tests/gone.py"]


def test_the_table_of_transforms_in_readme_is_that_of_their_docstrings():
    """`python -m docs.registry` writes it."""
    assert registry.of_readme() in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_first_example_of_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, first, *others = DOCUMENTS["README.md"]
    assert [sum(call in each for each in others) for call in LONG] == [1, 1]
    for many, few in FEWER.items():
        first = first.replace(many, few)
    names = run([first])
    assert names["camera"].size == (20, 16)
    assert_tells_something(names["gradient"].colors)
    assert_tells_something(names["gradient"].extinction)
    assert (tmp_path / "head.png").stat().st_size > 200


@pytest.mark.slow
@pytest.mark.parametrize("name", DOCUMENTS)
def test_python_in_the_documents_runs(name, tmp_path):
    """Compiled as users do, since some take longer than their programs."""
    code = f"from tests.test_documents import check; check({name!r})"
    how = {**os.environ, "XLA_FLAGS": os.environ["FLAGS_OF_USERS"], "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=how, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr[-3000:]


def check(name):
    names = run(DOCUMENTS[name], path=jv.save(jv.phantom("head", 24), "scan.npz"))
    if name == "README.md":
        assert names["found"].losses[-1] < 0.1 * names["found"].losses[0]
        assert_tells_something(names["found"].parameters)
        assert isinstance(names["plan"], jv.Plan)
