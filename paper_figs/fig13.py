"""Kye 2013, Fig. 13: the pixels that alignment changes, in green, on the vessels of Fig. 12. The square marks
the zoomed part of Fig. 12."""

from argparse import Namespace

import numpy as np
from matplotlib.patches import Rectangle

import jaxvol as jv
from experiments.marches import BOTH, transforms

from . import fig12
from .common import BLACK, Page, figure


GREEN = (0.0, 0.8, 0.05)


@figure(__doc__)
def main(chosen: Namespace) -> None:
    size, resolution = chosen.size, chosen.resolution
    view = fig12.real(chosen.data, size) if chosen.data else fig12.phantom(resolution, size)
    page = Page(2, 1, size, "Fig. 13: pixels that alignment changes")
    for column, (look, camera) in enumerate(view.cameras.items()):
        rendering = view.render(camera, jv.March(view.step, transforms(BOTH)))
        aligned = np.asarray(rendering.aligned)
        image = np.where(aligned[..., None], GREEN, np.asarray(rendering.image(BLACK)))
        caption = f"{aligned.sum()} of {aligned.size} pixels, {aligned.mean():.1%}"
        axes = page.draw(0, column, image, caption, look)
        if look == "whole":
            side = size / view.factor
            x, y = (middle * size - side / 2 for middle in view.middle)
            axes.add_patch(Rectangle((x, y), side, side, fill=False, color="white", linewidth=0.8))
        print(f"fig13 {look}: {caption}")
    page.save(chosen.output / "fig13.webp")


if __name__ == "__main__":
    main()
