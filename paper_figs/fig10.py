"""Kye 2013, Fig. 10: the heart. The default is the engine phantom, cut open."""

from argparse import Namespace
from pathlib import Path

import jaxvol as jv

from .common import View, comparison, cropped, figure


METAL = [
    (50, (0.02, 0.03, 0.05), 0.0),
    (90, (0.15, 0.25, 0.40), 0.6),
    (150, (0.45, 0.55, 0.65), 0.9),
    (190, (0.85, 0.45, 0.10), 0.95),
    (240, (1.00, 0.85, 0.45), 0.95),
]


def phantom(resolution: int, size: int) -> View:
    volume = cropped(jv.phantom("engine", resolution), (0, 0, 0), (0.6, 1, 1))
    camera = jv.Camera.looking_at(volume, (1, -0.8, 0.5), size=(size, size)).zoom(1.4)
    transfer = jv.TransferFunction.from_points(METAL, unit_distance=0.03)
    return View(volume, transfer, camera, 2 * float(volume.spacing[0]), 4, (0.55, 0.72))


def real(folder: Path, size: int) -> View:
    """Bones of a chest CT, whose faces all cut tissue."""
    volume = jv.load(folder / "lidc0314_airway_256x192x200_int16le.raw.gz", spacing=(0.78125, 0.78125, 1))
    camera = jv.Camera.looking_at(volume, (0.4, -1, -0.6), (0, 0, 1), size=(size, size)).zoom(1.4)
    return View(volume, jv.preset("ct_bone", unit_distance=0.2), camera, 1.5, 3.5, (0.5, 0.4))


@figure(__doc__)
def main(chosen: Namespace) -> None:
    view = real(chosen.data, chosen.size) if chosen.data else phantom(chosen.resolution, chosen.size)
    shown = "bones of the chest" if chosen.data else "a cut engine"
    title = f"Fig. 10: {shown} in place of the heart; boundary noise is that of the cut faces"
    comparison(view, title, chosen.output / "fig10.webp")


if __name__ == "__main__":
    main()
