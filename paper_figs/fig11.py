"""Kye 2013, Fig. 11: the kidney. The default is the colon phantom, soft tissue cut across."""

from argparse import Namespace
from pathlib import Path

import jaxvol as jv

from .common import View, comparison, cropped, figure


TISSUE = [
    (60, (0.10, 0.02, 0.02), 0.0),
    (120, (0.50, 0.15, 0.10), 0.5),
    (180, (0.90, 0.50, 0.40), 0.8),
    (230, (1.00, 0.80, 0.65), 0.9),
]


def phantom(resolution: int, size: int) -> View:
    volume = cropped(jv.phantom("colon", resolution), (0, 0, 0), (1, 1, 0.6))
    camera = jv.Camera.looking_at(volume, (0.4, -0.8, 1), size=(size, size)).zoom(1.3)
    transfer = jv.TransferFunction.from_points(TISSUE, unit_distance=0.03)
    return View(volume, transfer, camera, 1.5 * float(volume.spacing[0]), 4, (0.79, 0.43))


def real(folder: Path, size: int) -> View:
    """The industrial CT of an engine, cut open."""
    volume = cropped(jv.load(folder / "engine_256x256x128_uint8.raw.gz"), (0, 0.3, 0), (1, 1, 1))
    camera = jv.Camera.looking_at(volume, (0.5, -1, -0.7), (0, 0, -1), size=(size, size)).zoom(1.4)
    return View(volume, jv.preset("engine", unit_distance=0.2), camera, 1.5, 4, (0.45, 0.5))


@figure(__doc__)
def main(chosen: Namespace) -> None:
    view = real(chosen.data, chosen.size) if chosen.data else phantom(chosen.resolution, chosen.size)
    shown = "a cut engine" if chosen.data else "a colon in soft tissue"
    title = f"Fig. 11: {shown} in place of the kidney; boundary noise is that of the cut face"
    comparison(view, title, chosen.output / "fig11.webp")


if __name__ == "__main__":
    main()
