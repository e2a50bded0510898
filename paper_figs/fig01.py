"""Kye 2013, Fig. 1: the artefacts. Ray casting draws wood grain on a head; jittering removes it, and adds
noise where the volume's bounds cut through the head."""

from collections.abc import Sequence

from experiments.marches import JITTER, PLAIN

from . import fig09
from .common import comparison, options


def main(argv: Sequence[str] | None = None) -> None:
    chosen = options(argv, __doc__)
    size, resolution = chosen.size, chosen.resolution
    view = fig09.real(chosen.data, size) if chosen.data else fig09.phantom(resolution, size)
    title = "Fig. 1: wood grain, and noise on the cut face"
    comparison(view, title, chosen.output / "fig01.png", (PLAIN, JITTER))


if __name__ == "__main__":
    main()
