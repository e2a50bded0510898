"""Kye 2013, Fig. 9: empty-space jittering on the head. The default is the head phantom, its crown cut off."""

from argparse import Namespace
from pathlib import Path

import jaxvol as jv
from experiments.scenes import SKIN

from .common import View, comparison, cropped, figure


def phantom(resolution: int, size: int) -> View:
    volume = cropped(jv.phantom("head", resolution), (0, 0, 0), (1, 1, 0.62))
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.75), size=(size, size)).zoom(1.7, (0.52, 0.46))
    transfer = jv.TransferFunction.from_points(SKIN, unit_distance=0.03)
    return View(volume, transfer, camera, 1.5 * float(volume.spacing[0]), 3.3, (0.36, 0.48))


def real(folder: Path, size: int) -> View:
    """CT, the crown cut off; z grows towards the chin."""
    volume = jv.load(folder / "cthead_256x256x113_uint16le.raw.gz", spacing=(1, 1, 2))
    volume = cropped(volume, (0, 0, 0.35), (1, 1, 1))
    camera = jv.Camera.looking_at(volume, (-0.5, -1, -0.75), (0, 0, -1), size=(size, size)).zoom(1.4)
    transfer = jv.preset("ct_skin_bone", clim=(0, 4000), unit_distance=0.1)
    return View(volume, transfer, camera, 1.5, 3.3, (0.4, 0.45))


@figure(__doc__)
def main(chosen: Namespace) -> None:
    view = real(chosen.data, chosen.size) if chosen.data else phantom(chosen.resolution, chosen.size)
    comparison(view, "Fig. 9: the head; boundary noise is that of the cut face", chosen.output / "fig09.webp")


if __name__ == "__main__":
    main()
