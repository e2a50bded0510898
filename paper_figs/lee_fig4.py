"""Lee, Kwon and Shin, Fig. 4: the exceptional case. An ear before a head that blocks all light from it.

The light comes from behind the head. Photons of a template reach through the thin ear into the gap before
the head, where nothing hides them, so the ear shines; if they are also tested farther out, they are hidden.
The text under each image is the mean brightness of the ear's pixels.
"""

from experiments.pictures.lee import lee_fig4

from .common import pictures


TITLE = "Lee, Kwon and Shin, Fig. 4: an ear, light from behind the head"
main = pictures(__doc__, "lee_fig4.webp", TITLE, lee_fig4, resolution=96)

if __name__ == "__main__":
    main()
