"""Chae and Shin, Fig. 6: images against the grid's cells. The default is the colon phantom.

A part of the image without leaping, and of images whose rays start at the nearest first hit of the corner
rays of their cell of R x R pixels. Below, wrong pixels are green: those that differ by more than 1/255 in any
channel.
"""

from argparse import Namespace
from dataclasses import replace

import numpy as np
from matplotlib.patches import Rectangle

from experiments.common import frame
from experiments.minimum_distance import PUBLISHED, airway, colon, march, wrong
from jaxvol.metrics import rmse

from .common import BLACK, Page, figure


CELLS = (8, 16, 32, 64)
WHOLE = 2  # size of the image over that of the part that is shown
MIDDLE = 0.38, 0.52
GREEN = (0.0, 0.7, 0.05)


@figure(__doc__, resolution=256)
def main(chosen: Namespace) -> None:
    side, folder = chosen.size, chosen.data
    size = round(side * WHOLE)
    scene = airway(folder, size) if folder else colon(None, size, chosen.resolution)
    left, top = (round(middle * size - side / 2) for middle in MIDDLE)
    part = slice(top, top + side), slice(left, left + side)

    page = Page(1 + len(CELLS), 2, side, f"Chae and Shin, Fig. 6: part of an image of {size} x {size} pixels")
    reference = frame(scene, march(scene, None))
    whole = np.asarray(reference.image(BLACK))
    page.draw(0, 0, whole[part], "", "no leaping")
    small = scene._replace(camera=replace(scene.camera, size=(side, side)))
    axes = page.draw(1, 0, frame(small, march(scene, None)).image(BLACK), "the whole image")
    corner = left * side / size, top * side / size
    shown = side / WHOLE
    axes.add_patch(Rectangle(corner, shown, shown, fill=False, color="white", linewidth=0.8))
    for column, cell in enumerate(CELLS, 1):
        rendering = frame(scene, march(scene, PUBLISHED, cell))
        image, off = np.asarray(rendering.image(BLACK)), wrong(rendering, reference)
        page.draw(0, column, image[part], "", f"R = {cell}")
        marked = np.where(off[..., None], GREEN, image)[part]
        caption = f"wrong {off.mean():.3%}, {off[part].sum()} pixels here"
        caption += f"\nRMSE from no leaping {rmse(image, whole):.1e}"
        page.draw(1, column, marked, caption)
        print(f"chae_fig6 R = {cell}: {', '.join(caption.splitlines())}")
    page.save(chosen.output / "chae_fig6.webp")


if __name__ == "__main__":
    main()
