"""Kye 2013, Figs. 1 and 9 to 13: scenes under several marches, whole and zoomed, and measures of error."""

from argparse import Namespace
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

import jaxvol as jv
from jaxvol.metrics import boundary_noise, rmse, wood_grain_energy

from ..harness import entered, frame
from ..marches import BOTH, EMPTY, JITTER, PLAIN, converged, transforms
from ..scenes import SKIN, Scene, cropped
from . import BLACK, Panels, panel


METHODS = (PLAIN, JITTER, EMPTY, BOTH)
GREEN = (0.0, 0.8, 0.05)
METAL = [
    (50, (0.02, 0.03, 0.05), 0.0),
    (90, (0.15, 0.25, 0.40), 0.6),
    (150, (0.45, 0.55, 0.65), 0.9),
    (190, (0.85, 0.45, 0.10), 0.95),
    (240, (1.00, 0.85, 0.45), 0.95),
]
TISSUE = [
    (60, (0.10, 0.02, 0.02), 0.0),
    (120, (0.50, 0.15, 0.10), 0.5),
    (180, (0.90, 0.50, 0.40), 0.8),
    (230, (1.00, 0.80, 0.65), 0.9),
]
CONTRAST = [(60, (0.30, 0.02, 0.02), 0.0), (120, (0.80, 0.20, 0.12), 0.12), (230, (1.00, 0.60, 0.45), 0.25)]
"""Translucent, so that rays reach their exit."""


class View(NamedTuple):
    """A scene, and the part of its image that is zoomed: by how much, and its centre, as fractions of the
    image's width and height from the top left."""

    scene: Scene
    factor: float
    middle: tuple[float, float]

    def scenes(self) -> dict[str, Scene]:
        zoomed = self.scene.camera.zoom(self.factor, self.middle)
        return {"whole": self.scene, "zoomed": self.scene._replace(camera=zoomed)}


def camera(volume: jv.Volume, chosen: Namespace, direction: tuple, up: tuple = (0, 0, 1)) -> jv.Camera:
    return jv.Camera.looking_at(volume, direction, up, size=(chosen.size,) * 2)


def head(chosen: Namespace) -> View:
    """The crown is cut off."""
    volume = cropped(jv.phantom("head", chosen.resolution), (0, 0, 0), (1, 1, 0.62))
    seen = camera(volume, chosen, (0.5, -1, 0.75)).zoom(1.7, (0.52, 0.46))
    transfer = jv.TransferFunction.from_points(SKIN, unit_distance=0.03)
    return View(Scene(volume, transfer, seen, 1.5 * float(volume.spacing[0])), 3.3, (0.36, 0.48))


def heart(chosen: Namespace) -> View:
    """An engine, cut open."""
    volume = cropped(jv.phantom("engine", chosen.resolution), (0, 0, 0), (0.6, 1, 1))
    seen = camera(volume, chosen, (1, -0.8, 0.5)).zoom(1.4)
    transfer = jv.TransferFunction.from_points(METAL, unit_distance=0.03)
    return View(Scene(volume, transfer, seen, 2 * float(volume.spacing[0])), 4, (0.55, 0.72))


def kidney(chosen: Namespace) -> View:
    """A colon in soft tissue, cut across."""
    volume = cropped(jv.phantom("colon", chosen.resolution), (0, 0, 0), (1, 1, 0.6))
    seen = camera(volume, chosen, (0.4, -0.8, 1)).zoom(1.3)
    transfer = jv.TransferFunction.from_points(TISSUE, unit_distance=0.03)
    return View(Scene(volume, transfer, seen, 1.5 * float(volume.spacing[0])), 4, (0.79, 0.43))


def vessels(chosen: Namespace) -> View:
    """The lower face cuts their root."""
    volume = jv.phantom("vessels", chosen.resolution)
    seen = camera(volume, chosen, (0.5, -1, 0.6)).zoom(1.5, (0.5, 0.52))
    transfer = jv.TransferFunction.from_points(CONTRAST, unit_distance=0.03)
    return View(Scene(volume, transfer, seen, 2 * float(volume.spacing[0])), 6, (0.5, 0.84))


def left(scene: Scene) -> np.ndarray:
    """Pixels that alignment changes: their rays leave the volume within visible material."""
    return np.asarray(frame(scene, jv.March(scene.step, transforms(BOTH))).aligned)


def rendered(scene: Scene, march: jv.March) -> np.ndarray:
    rendering = frame(scene, march)
    assert not np.any(rendering.exhausted)
    return np.asarray(rendering.image(BLACK))


def comparison(
    view: View, methods: Sequence[str] = METHODS, region: Callable[[Scene], np.ndarray] = entered
) -> Panels:
    """The view under every method, whole above and zoomed below, with its measures. `region`: the pixels
    whose boundary noise is measured."""
    rows: Panels = []
    for look, scene in view.scenes().items():
        truth, mask, row = rendered(scene, converged(scene.step)), region(scene), []
        for method in methods:
            image = rendered(scene, jv.March(scene.step, transforms(method)))
            row.append(panel(image, measured(image, truth, mask), method if look == "whole" else ""))
        rows.append(row)
    return rows


def measured(image: np.ndarray, truth: np.ndarray, region: np.ndarray) -> str:
    """Three measures of an image's error, as text."""
    error = image - truth
    try:
        noise = f"{boundary_noise(error, region):.2g}"
    except ValueError:  # no 3 x 3 pixels of such a face in this image
        noise = "none"
    grain = wood_grain_energy(error)
    return f"wood grain {grain:.2g}\nboundary noise {noise}\nRMSE {rmse(image, truth):.2g}"


def fig01(chosen: Namespace) -> Panels:
    return comparison(head(chosen), (PLAIN, JITTER))


def fig09(chosen: Namespace) -> Panels:
    return comparison(head(chosen))


def fig10(chosen: Namespace) -> Panels:
    return comparison(heart(chosen))


def fig11(chosen: Namespace) -> Panels:
    return comparison(kidney(chosen))


def fig12(chosen: Namespace) -> Panels:
    return comparison(vessels(chosen), region=left)


def fig13(chosen: Namespace) -> Panels:
    """The pixels that alignment changes, in green."""
    view, row = vessels(chosen), []
    side = chosen.size / view.factor
    x, y = (middle * chosen.size - side / 2 for middle in view.middle)
    for look, scene in view.scenes().items():
        aligned = left(scene)
        image = np.where(aligned[..., None], GREEN, rendered(scene, jv.March(scene.step, transforms(BOTH))))
        caption = f"{aligned.sum()} of {aligned.size} pixels, {aligned.mean():.1%}"
        row.append(panel(image, caption, look, (x, y, side) if look == "whole" else None))
    return [row]
