"""Do the notebooks run from the first cell to the last, and are their pictures large enough?"""

import json
import os
import re
import sys
from pathlib import Path

import pytest


ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.fixture
def this_python(tmp_path, monkeypatch):
    """Use the tests' interpreter as the kernel, whatever kernels are installed."""
    from jupyter_client.kernelspec import KernelSpec, KernelSpecManager

    argv = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = KernelSpec(argv=argv, display_name="this Python", language="python")
    monkeypatch.setattr(KernelSpecManager, "get_kernel_spec", lambda self, name: spec)
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    monkeypatch.setenv("XLA_FLAGS", os.environ["FLAGS_OF_USERS"])
    for scheme in ("http_proxy", "https_proxy"):  # data that are not here are not fetched
        monkeypatch.setenv(scheme, "http://127.0.0.1:9")


LARGE = """
import numpy
from matplotlib.backend_bases import FigureCanvasBase

_print_figure = FigureCanvasBase.print_figure


def _checked(self, *args, **kwargs):
    self.figure.draw_without_rendering()
    for axes in self.figure.axes:
        for image in axes.images:
            box, shape = axes.get_window_extent(), numpy.shape(image.get_array())
            assert min(box.width, box.height) > 255.5, f"a picture is drawn {box.width} x {box.height} large"
            assert len(shape) == 2 or min(shape[:2]) >= 256, f"a picture has {shape} pixels"
    return _print_figure(self, *args, **kwargs)


FigureCanvasBase.print_figure = _checked
"""
"""Refuses pictures of scenes that have fewer than 256 x 256 pixels, and any that are drawn smaller than that.
(Data that are drawn as they are, such as a fan of ultrasound, have one channel, and as many samples as they
have.)"""


OWN = {
    "radiance_field": ["class Decoded(jv.Field):"],
    "write_a_transform": ["class BallCut(jv.Transform):", "class Roulette(jv.Transform):"],
}
"""Classes that notebooks define, where that is what they are about."""


def test_every_notebook_is_in_the_list_of_the_documentation():
    text = (ROOT / "docs" / "notebooks.md").read_text(encoding="utf-8")
    listed = re.findall(r"\(\.\./notebooks/(\w+)\.ipynb\)", text)
    assert sorted(listed) == [path.stem for path in NOTEBOOKS]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, this_python, tmp_path):
    # here, since they take seconds to import
    nbformat = pytest.importorskip("nbformat", reason="pip install -e '.[notebooks]'")
    nbclient = pytest.importorskip("nbclient", reason="pip install -e '.[notebooks]'")
    pytest.importorskip("ipykernel", reason="pip install -e '.[notebooks]'")
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(LARGE))
    nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()  # raises a failing cell's error, with its source
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert all(output.output_type != "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_kept_without_outputs_and_defines_no_library(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)
    lines = "\n".join("".join(cell["source"]) for cell in code).splitlines()
    defined = [line for line in lines if line.startswith("class ")]
    assert defined == OWN.get(path.stem, [])
