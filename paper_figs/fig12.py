"""Kye 2013, Fig. 12: the effect of alignment where vessels leave the volume. The default is the vessel
phantom, whose root the lower face cuts."""

from experiments.pictures.kye import fig12

from .common import pictures


TITLE = "Fig. 12: vessels; boundary noise is that of the pixels that alignment changes"
main = pictures(__doc__, "fig12.webp", TITLE, fig12)

if __name__ == "__main__":
    main()
