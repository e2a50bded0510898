"""Chae and Shin, Fig. 6: images against the grid's cells. The default is the colon phantom.

A part of the image without leaping, and of images whose rays start at the nearest first hit of the corner
rays of their cell of R x R pixels. Below, wrong pixels are green: those that differ by more than 1/255 in any
channel.
"""

from argparse import Namespace

from experiments.pictures.chae import WHOLE, chae_fig6

from .common import pictures


def title(chosen: Namespace) -> str:
    size = chosen.size * WHOLE
    return f"Chae and Shin, Fig. 6: part of an image of {size} x {size} pixels"


main = pictures(__doc__, "chae_fig6.webp", title, chae_fig6, resolution=256)

if __name__ == "__main__":
    main()
