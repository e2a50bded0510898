"""Chae and Shin, Fig. 6: images against the grid's cells. The default is the colon phantom; wrong pixels, which
differ from the reference by more than 1/255 in any channel, are green in the lower row."""

from collections.abc import Sequence

import numpy as np

from experiments.minimum_distance import PUBLISHED, airway, colon, march, wrong
from jaxvol.metrics import rmse

from .common import BLACK, Page, options


CELLS = (8, 16, 32, 64)
GREEN = (0.0, 0.6, 0.1)


def main(argv: Sequence[str] | None = None) -> None:
    chosen = options(argv, __doc__)
    scene = (
        airway(chosen.data, chosen.size) if chosen.data else colon(None, chosen.size, chosen.resolution)
    )
    camera = scene.camera
    page = Page(len(CELLS) + 1, 2, camera.size[0], "Chae and Shin, Fig. 6: starts shared by R x R pixels")
    reference = render(scene, None)
