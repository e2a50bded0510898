"""Kye 2013, Fig. 1: the artefacts. Ray casting draws wood grain on a head; jittering removes it, and adds
noise where the volume's bounds cut through the head."""

from argparse import Namespace

from experiments.marches import JITTER, PLAIN

from . import fig09
from .common import comparison, figure


@figure(__doc__)
def main(chosen: Namespace) -> None:
    size, resolution = chosen.size, chosen.resolution
    view = fig09.real(chosen.data, size) if chosen.data else fig09.phantom(resolution, size)
    title = "Fig. 1: wood grain, and noise on the cut face"
    comparison(view, title, chosen.output / "fig01.webp", (PLAIN, JITTER))


if __name__ == "__main__":
    main()
