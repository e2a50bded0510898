"""Do the examples in documents run, as they stand there?"""

import os
import re
import subprocess
import sys
import textwrap

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
