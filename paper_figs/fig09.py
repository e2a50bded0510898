"""Kye 2013, Fig. 9: empty-space jittering on the head. The default is the head phantom, its crown cut off."""

from experiments.pictures.kye import fig09

from .common import pictures


main = pictures(__doc__, "fig09.webp", "Fig. 9: the head; boundary noise is that of the cut face", fig09)

if __name__ == "__main__":
    main()
