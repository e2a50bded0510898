"""Kim, Kwon and Shin, Fig. 8: samples blended in the wrong order, and in the right one.

A phantom of a fetus as the paper's probe would see it, without speckle, through the translucent tissue around
it, and cut into bricks along the beams alone. Left: each brick shows at once all that a ray meets in it
(`experiments.bricks.each_at_once`), as the paper's Fig. 8 does on its left. A ray meets tissue in a brick far from
the probe, then the fetus in one near it, and the far one again; the near one has the first turn, so that the
fetus stands before the tissue that covers it. Middle: with overlap (`"overlap"`); right: the difference.
Below, what is framed.
"""

from experiments.pictures.kim import kim_fig8

from .common import pictures


TITLE = "Kim, Kwon and Shin, Fig. 8: bricks of a scan, in the wrong and the right order"
main = pictures(__doc__, "kim_fig8.webp", TITLE, kim_fig8, resolution=360)

if __name__ == "__main__":
    main()
