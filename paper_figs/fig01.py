"""Kye 2013, Fig. 1: the artefacts. Ray casting draws wood grain on a head; jittering removes it, and adds
noise where the volume's bounds cut through the head."""

from experiments.pictures.kye import fig01

from .common import pictures


main = pictures(__doc__, "fig01.webp", "Fig. 1: wood grain, and noise on the cut face", fig01)

if __name__ == "__main__":
    main()
