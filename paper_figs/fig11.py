"""Kye 2013, Fig. 11: the kidney. The default is the colon phantom, soft tissue cut across."""

from argparse import Namespace

from experiments.pictures.kye import fig11

from .common import pictures


def title(chosen: Namespace) -> str:
    shown = "a cut engine" if chosen.data else "a colon in soft tissue"
    return f"Fig. 11: {shown} in place of the kidney; boundary noise is that of the cut face"


main = pictures(__doc__, "fig11.webp", title, fig11)

if __name__ == "__main__":
    main()
