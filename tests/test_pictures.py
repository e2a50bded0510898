"""Are the pictures of the documentation, the figures and the results at least 256 x 256 pixels each?"""

from pathlib import Path

from PIL import Image

from paper_figs.pictures import PICTURES


ROOT = Path(__file__).parent.parent
DRAWN = "docs", "docs/pictures", "paper_figs/output", "experiments/results"
LEAST = 256

PANELS = {
    "paper_figs/output/chae_fig6.webp": (5, 5),
    "paper_figs/output/fig01.webp": (2, 4),
    "paper_figs/output/fig09.webp": (4, 4),
    "paper_figs/output/fig10.webp": (4, 4),
    "paper_figs/output/fig11.webp": (4, 4),
    "paper_figs/output/fig12.webp": (4, 4),
    "paper_figs/output/fig13.webp": (4, 1),
    "paper_figs/output/gallery.webp": (4, 7),
    "paper_figs/output/kim_fig8.webp": (5, 2),
    "paper_figs/output/kisti_fig.webp": (4, 2),
    "paper_figs/output/kye_conditions.webp": (4, 4),
    "paper_figs/output/lee_fig4.webp": (3, 2),
    "paper_figs/output/lee_fig6.webp": (4, 4),
    "paper_figs/output/lee_fig_steps.webp": (3, 4),
    "paper_figs/output/lee_hand.webp": (4, 1),
    "paper_figs/output/lee_printed.webp": (2, 2),
    "experiments/results/lit.png": (2, 1),
    "experiments/results/path_traced.webp": (4, 2),
    "experiments/results/tomography.png": (4, 2),
}
"""How many pictures of scenes stand side by side, and below each other, on pages of several."""


def test_no_picture_is_smaller():
    files = [
        path
        for folder in DRAWN
        for path in sorted((ROOT / folder).iterdir())
        if path.suffix in (".png", ".webp")
    ]
    names = {path.relative_to(ROOT).as_posix(): path for path in files}
    assert set(PANELS) <= set(names)
    for name, path in names.items():
        (width, height), (columns, rows) = Image.open(path).size, PANELS.get(name, (1, 1))
        assert width // columns >= LEAST, name
        assert height // rows >= LEAST, name


def test_every_page_of_several_pictures_is_listed():
    pages = set(PICTURES) - {"kim_fig6", "lee_fig5"}  # drawings
    assert pages == {Path(name).stem for name in PANELS if name.startswith("paper_figs")}
