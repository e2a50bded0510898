"""Lee, Kwon and Shin, the six steps of shading with a template: the effect of each on an image.

For each step, a scene in which only that step matters: as it is above, and with one thing changed below.
"""

from experiments.pictures.lee_steps import lee_fig_steps

from .common import pictures


TITLE = (
    "Lee, Kwon and Shin: the steps of shading, one at a time. "
    "Numbers: mean linear red, green and blue of what is visible"
)

main = pictures(__doc__, "lee_fig_steps.webp", TITLE, lee_fig_steps, resolution=96)

if __name__ == "__main__":
    main()
