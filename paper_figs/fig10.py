"""Kye 2013, Fig. 10: the heart. The default is the engine phantom, cut open."""

from argparse import Namespace

from experiments.pictures.kye import fig10

from .common import pictures


def title(chosen: Namespace) -> str:
    shown = "bones of the chest" if chosen.data else "a cut engine"
    return f"Fig. 10: {shown} in place of the heart; boundary noise is that of the cut faces"


main = pictures(__doc__, "fig10.webp", title, fig10)

if __name__ == "__main__":
    main()
