"""Takes a picture from each notebook for `docs/notebooks.md`: `python docs/from_notebooks.py [NAME ...]`.

A notebook is executed up to the cell that shows the picture. Run it again when that shows something else.
"""

import base64
import io
import os
import sys
from pathlib import Path

import nbformat
import numpy as np
from nbclient import NotebookClient
from PIL import Image


ROOT = Path(__file__).parent.parent
WIDTH = 900
SHOWN_BY = {
    "volume_in_ten_lines": '"another camera"',
    "wood_grain": "seen(head, skin, close",
    "fit_a_transfer_function": '"difference × 20"',
    "radiance_field": "jv.show_images(images)",
    "ultrasound": '{"fetus": direct',
    "register": "panel.set_title(title)",
    "mean_free_path": '{"no light": unlit',
    "speed_and_accuracy": "| difference)",
    "write_a_transform": '"without a ball"',
}
"""Text of the cell that shows each notebook's picture."""


def picture(name: str) -> Image.Image:
    """The first picture of that cell."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    (last,) = (number for number, cell in enumerate(notebook.cells) if SHOWN_BY[name] in cell.source)
    notebook.cells = notebook.cells[: last + 1]
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": ROOT / "notebooks"}}).execute()
    outputs = (each.get("data", {}) for each in notebook.cells[last].outputs)
    png = next(data["image/png"] for data in outputs if "image/png" in data)
    return Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")


def save(found: Image.Image, path: Path) -> None:
    """As WebP, without its white margins."""
    rows, columns = np.nonzero((np.asarray(found) < 250).any(axis=2))
    found = found.crop((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
    found.thumbnail((WIDTH, WIDTH))
    found.save(path, quality=80, method=6)


if __name__ == "__main__":
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    for name in sys.argv[1:] or SHOWN_BY:
        save(picture(name), ROOT / "docs/pictures" / f"{name}.webp")
