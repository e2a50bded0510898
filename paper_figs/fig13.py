"""Kye 2013, Fig. 13: the pixels that alignment changes, in green, on the vessels of Fig. 12. The square marks
the zoomed part of Fig. 12."""

from experiments.pictures.kye import fig13

from .common import pictures


main = pictures(__doc__, "fig13.webp", "Fig. 13: pixels that alignment changes", fig13)

if __name__ == "__main__":
    main()
