"""Lee, Kwon and Shin, Fig. 6: without light, and lit by scatterer templates. The defaults are the head
phantom, and a frog whose translucent body and organs are a material each; `--data` adds CT of a head.

In the middle column hidden photons are left out, as published (hard occlusion), and each pixel uses one of
eight templates, chosen at random; the paper makes eight for each material, and does not say which of them a
sample uses. In the right column occlusion is soft, and four templates of more packets are blended. The lights
are the same.
"""

from experiments.pictures.lee import lee_fig6

from .common import pictures


TITLE = "Lee, Kwon and Shin, Fig. 6: light from the left"
main = pictures(__doc__, "lee_fig6.webp", TITLE, lee_fig6, resolution=128, size=512)

if __name__ == "__main__":
    main()
