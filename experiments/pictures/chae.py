"""Chae and Shin, Fig. 6: images under growing cells of a minimum-distance grid."""

from argparse import Namespace
from dataclasses import replace

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from .. import minimum_distance
from ..harness import frame
from . import BLACK, Panels, panel


CELLS = (8, 16, 32, 64)
WHOLE = 2  # size of the image over that of the part that is shown
MIDDLE = 0.38, 0.52
GREEN = (0.0, 0.7, 0.05)


def chae_fig6(chosen: Namespace) -> Panels:
    """A part of the image without leaping, and under growing cells. Below, wrong pixels are green."""
    side, size = chosen.size, round(chosen.size * WHOLE)
    scene = minimum_distance.colon(None, size, chosen.resolution)
    left, top = (round(middle * size - side / 2) for middle in MIDDLE)
    part = slice(top, top + side), slice(left, left + side)
    reference = frame(scene, minimum_distance.march(scene))
    whole = np.asarray(reference.image(BLACK))
    small = scene._replace(camera=replace(scene.camera, size=(side, side)))
    square = left * side / size, top * side / size, side / WHOLE
    upper = [panel(whole[part], "", "no leaping")]
    overview = frame(small, minimum_distance.march(small)).image(BLACK)
    lower = [panel(overview, "the whole image", "", square)]
    for cell in CELLS:
        rendering = frame(scene, minimum_distance.march(scene, jv.SpaceLeaping("min_distance", cell)))
        image, off = np.asarray(rendering.image(BLACK)), minimum_distance.wrong(rendering, reference)
        upper.append(panel(image[part], "", f"R = {cell}"))
        caption = f"wrong {off.mean():.3%}, {off[part].sum()} pixels here"
        caption += f"\nRMSE from no leaping {rmse(image, whole):.1e}"
        lower.append(panel(np.where(off[..., None], GREEN, image)[part], caption))
    return [upper, lower]
