"""Chae and Shin, Fig. 6: images under growing cells of a minimum-distance grid."""

from argparse import Namespace
from dataclasses import replace

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from .. import minimum_distance
from ..harness import frame
from ..scenes import Scene
from . import BLACK, Panels, panel


CELLS = (8, 16, 32, 64)
WHOLE = 2  # size of the image over that of the part that is shown
MIDDLE, OF_AIRWAY, OF_VESSELS = (0.38, 0.52), (0.5, 0.5), (0.5, 0.5)
GREEN = (0.0, 0.7, 0.05)


def chae_fig6(chosen: Namespace) -> Panels:
    """A part of the image without leaping, and under growing cells. Below, wrong pixels are green, as in the
    row of CT; of vessels both."""
    rows = under_cells(minimum_distance.colon(None, chosen.size * WHOLE, chosen.resolution), MIDDLE, "colon")
    if chosen.data is None:
        return rows
    airway = minimum_distance.airway(chosen.data, chosen.size * WHOLE, chosen.resolution)
    vessels = minimum_distance.vessels(chosen.data, chosen.size * WHOLE, chosen.resolution)
    rows.append(under_cells(airway, OF_AIRWAY, "CT airway")[1])
    return [*rows, *under_cells(vessels, OF_VESSELS, "vessels")]


def under_cells(scene: Scene, middle: tuple[float, float], name: str) -> Panels:
    """Two rows: images, and the whole one with those whose wrong pixels are green."""
    size = scene.camera.size[0]
    side = size // WHOLE
    left, top = (round(at * size - side / 2) for at in middle)
    part = slice(top, top + side), slice(left, left + side)
    reference = frame(scene, minimum_distance.march(scene))
    whole = np.asarray(reference.image(BLACK))
    small = scene._replace(camera=replace(scene.camera, size=(side, side)))
    square = left * side / size, top * side / size, side / WHOLE
    upper = [panel(whole[part], "", "no leaping")]
    overview = frame(small, minimum_distance.march(small)).image(BLACK)
    lower = [panel(overview, f"{name}, whole image", "", square)]
    for cell in CELLS:
        rendering = frame(scene, minimum_distance.march(scene, jv.SpaceLeaping("min_distance", cell)))
        image, off = np.asarray(rendering.image(BLACK)), minimum_distance.wrong(rendering, reference)
        upper.append(panel(image[part], "", f"R = {cell}"))
        caption = f"{off.mean():.3%} wrong\nRMSE {rmse(image, whole):.1e}"
        lower.append(panel(np.where(off[..., None], GREEN, image)[part], caption))
    return [upper, lower]
