"""Lee, Kwon and Shin: thin parts, which stand in for the paper's Fig. 5. A hand of flesh and bones, lit from
the left.

Phong's shading sees the surface alone: it shades a finger as it shades the palm, and lights what lies in
another finger's shadow. Templates see as far as light is scattered. In the third column photons are hidden as
published, and all samples of a material use one template; in the last one, occlusion is soft, and four
templates of more packets are blended. Photons are also tested at 2, 4 and 8 times their distance, since
without that fingers do not shade each other.
"""

from experiments.pictures.lee import lee_fig5

from .common import pictures


TITLE = "Lee, Kwon and Shin: a hand, light from the left"
main = pictures(__doc__, "lee_fig5.webp", TITLE, lee_fig5, size=512)

if __name__ == "__main__":
    main()
