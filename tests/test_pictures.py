"""Is a picture of the documentation, the figures or the results black, or smaller than 256 x 256 pixels?"""

from pathlib import Path

import numpy as np
from PIL import Image

from paper_figs.pictures import PICTURES


ROOT = Path(__file__).parent.parent
DRAWN = "docs", "docs/pictures", "paper_figs/output", "experiments/results"
LEAST = 256
CONTRAST = 5.0
"""The least standard deviation, of 255 grey levels in the middle of a picture. Those kept have 9."""

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

BLACK = {("paper_figs/output/kim_fig8.webp", 0, 4)}
"""Page, row and column of the difference of two images that are equal."""


def kept() -> dict[str, Path]:
    folders = [sorted((ROOT / folder).iterdir()) for folder in DRAWN]
    files = [path for folder in folders for path in folder if path.suffix in (".png", ".webp")]
    return {path.relative_to(ROOT).as_posix(): path for path in files}


def flat(picture: Image.Image, columns: int, rows: int) -> set[tuple[int, int]]:
    """Row and column of the panels in whose middle, half as wide and high, hardly anything is seen."""
    grey = np.asarray(picture.convert("L"), float)
    height, width = grey.shape[0] / rows, grey.shape[1] / columns

    def middle(number: int, size: float) -> slice:
        return slice(int((number + 0.25) * size), int((number + 0.75) * size))

    cells = [(row, column) for row in range(rows) for column in range(columns)]
    return {(r, c) for r, c in cells if grey[middle(r, height), middle(c, width)].std() < CONTRAST}


def test_no_picture_is_black():
    names = kept()
    assert len(names) > len(PANELS)
    found = {
        (name, *at)
        for name, path in names.items()
        for at in flat(Image.open(path), *PANELS.get(name, (1, 1)))
    }
    assert found == BLACK


def test_a_black_panel_is_seen_beside_others():
    picture = Image.open(ROOT / "paper_figs/output/lee_hand.webp").convert("RGB")
    width, height = picture.width // 4, picture.height
    picture.paste((0, 0, 0), (2 * width, height // 8, 3 * width, height - height // 8))
    assert flat(picture, *PANELS["paper_figs/output/lee_hand.webp"]) == {(0, 2)}


def test_no_picture_is_smaller():
    names = kept()
    assert set(PANELS) <= set(names)
    for name, path in names.items():
        (width, height), (columns, rows) = Image.open(path).size, PANELS.get(name, (1, 1))
        assert width // columns >= LEAST, name
        assert height // rows >= LEAST, name


def test_every_page_of_several_pictures_is_listed():
    pages = set(PICTURES) - {"kim_fig6", "lee_fig5"}  # drawings
    assert pages == {Path(name).stem for name in PANELS if name.startswith("paper_figs")}
