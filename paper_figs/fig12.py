"""Kye 2013, Fig. 12: the effect of alignment where vessels leave the volume. The default is the vessel
phantom, whose root the lower face cuts."""

from argparse import Namespace
from pathlib import Path

import jaxvol as jv

from .common import View, comparison, cropped, figure


CONTRAST = [
    (60, (0.30, 0.02, 0.02), 0.0),
    (120, (0.80, 0.20, 0.12), 0.12),
    (230, (1.00, 0.60, 0.45), 0.25),
]
"""Translucent, so that rays reach their exit."""


def phantom(resolution: int, size: int) -> View:
    volume = jv.phantom("vessels", resolution)
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.6), size=(size, size)).zoom(1.5, (0.5, 0.52))
    transfer = jv.TransferFunction.from_points(CONTRAST, unit_distance=0.03)
    return View(volume, transfer, camera, 2 * float(volume.spacing[0]), 6, (0.5, 0.84))


def real(folder: Path, size: int) -> View:
    """Angiography of an aneurism, cut through its arteries."""
    volume = cropped(jv.load(folder / "aneurism_256x256x256_uint8.raw.gz"), (0, 0, 0.35), (1, 1, 1))
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.6), (0, 0, 1), size=(size, size)).zoom(1.5)
    return View(volume, jv.TransferFunction.from_points(CONTRAST, 2.0), camera, 2.0, 6, (0.5, 0.84))


@figure(__doc__)
def main(chosen: Namespace) -> None:
    view = real(chosen.data, chosen.size) if chosen.data else phantom(chosen.resolution, chosen.size)
    title = "Fig. 12: vessels; boundary noise is that of the pixels that alignment changes"
    comparison(view, title, chosen.output / "fig12.webp", region=View.left)


if __name__ == "__main__":
    main()
