"""Are the pictures of the documentation, the figures and the results at least 256 x 256 pixels each?"""

import re
from pathlib import Path

from PIL import Image


ROOT = Path(__file__).parent.parent
DRAWN = "docs", "paper_figs/output", "experiments/results"
LEAST = 256

PANELS = {
    "paper_figs/output/chae_fig6.png": (5, 2),
    "paper_figs/output/fig01.png": (2, 2),
    "paper_figs/output/fig09.png": (4, 2),
    "paper_figs/output/fig10.png": (4, 2),
    "paper_figs/output/fig11.png": (4, 2),
    "paper_figs/output/fig12.png": (4, 2),
    "paper_figs/output/fig13.png": (2, 1),
    "paper_figs/output/gallery.png": (4, 5),
    "paper_figs/output/kim_fig8.png": (3, 2),
    "paper_figs/output/kisti_fig.png": (2, 2),
    "paper_figs/output/lee_fig4.png": (3, 1),
    "paper_figs/output/lee_fig5.png": (4, 1),
    "paper_figs/output/lee_fig6.png": (3, 2),
    "paper_figs/output/lee_fig_steps.png": (6, 2),
    "experiments/results/lit.png": (2, 1),
    "experiments/results/path_traced.png": (4, 2),
    "experiments/results/tomography.png": (4, 2),
}
"""How many pictures of scenes stand side by side, and below each other, on pages of several."""


def test_no_picture_is_smaller():
    files = [path for folder in DRAWN for path in sorted((ROOT / folder).glob("*.png"))]
    names = {path.relative_to(ROOT).as_posix(): path for path in files}
    assert set(PANELS) <= set(names)
    for name, path in names.items():
        (width, height), (columns, rows) = Image.open(path).size, PANELS.get(name, (1, 1))
        assert width // columns >= LEAST, name
        assert height // rows >= LEAST, name


def test_every_page_of_several_pictures_is_listed():
    scripts = {path.stem: path.read_text(encoding="utf-8") for path in (ROOT / "paper_figs").glob("*.py")}
    pages = {name for name, text in scripts.items() if re.search(r"\b(Page|comparison)\(", text)}
    assert pages - {"common"} == {Path(name).stem for name in PANELS if name.startswith("paper_figs")}
