"""Lee, Kwon and Shin, Fig. 1: a template grown from one packet of light, and from four.

Photons seen along z, lengths in mean free paths; the area of a dot is the photon's intensity. The cross marks
the sample that they light, and the ring the centre of their light.
"""

from experiments.templates import draw

from .common import from_record


main = from_record(__doc__, "lee_fig1.webp", "templates", draw)

if __name__ == "__main__":
    main()
