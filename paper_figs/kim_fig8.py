"""Kim, Kwon and Shin, Fig. 8: samples blended in the wrong order, and in the right one.

A phantom of a fetus as the paper's probe would see it, without speckle, through the translucent tissue around
it, and cut into bricks along the beams alone. Left: each brick shows at once all that a ray meets in it
(`experiments.naive_bricks`), as the paper's Fig. 8 does on its left. A ray meets tissue in a brick far from
the probe, then the fetus in one near it, and the far one again; the near one has the first turn, so that the
fetus stands before the tissue that covers it. Middle: with overlap (`"overlap"`); right: the difference.
Below, what is framed.
"""

from argparse import Namespace
from typing import Any

import numpy as np
from matplotlib.patches import Rectangle

import jaxvol as jv
from experiments.bricks import phantom
from experiments.naive_bricks import each_at_once

from .common import BLACK, Page, figure


SPLIT = 1, 1, 4
TISSUE, FLESH, SKIN, BONE = (0.06, 0.22, 0.5), (0.8, 0.1, 0.05), (1.0, 0.8, 0.6), (1.0, 1.0, 0.9)
POINTS = [
    *((12, TISSUE, 0.0), (24, TISSUE, 0.025), (40, TISSUE, 0.025)),
    *((55, FLESH, 0.08), (85, FLESH, 0.08)),
    *((105, SKIN, 0.15), (135, SKIN, 0.15)),
    *((150, BONE, 0.9), (170, BONE, 0.9)),
]
"""A transfer function in which fluid is transparent, and all but bone translucent."""
ZOOM, MIDDLE = 2.2, (0.29, 0.44)
EYE = (-220.0, -200.0, 40.0)
"""Beside the head, mm: rays pass the curved faces at small angles, and the fetus in between."""
TITLES = {"naive": "wrong order: no overlap", "overlap": "right order: overlap"}
METHODS: dict[str, Any] = {"naive": each_at_once, "overlap": "overlap"}


@figure(__doc__, resolution=360)
def main(chosen: Namespace) -> None:
    volume, probe = phantom(chosen.resolution, "uint8", speckle=False)
    transfer = jv.TransferFunction.from_points(POINTS)
    first, last = probe.gamma_range
    march = jv.March(2 * float(last - first) / (volume.shape[2] - 1), (probe,))
    whole = jv.Camera(EYE, (0, 0, 100), (0, 0, 1), 19.0, size=(chosen.size,) * 2)
    page = Page(
        3, 2, chosen.size, "Kim, Kwon and Shin, Fig. 8: bricks of a scan, in the wrong and the right order"
    )
    for row, camera in enumerate((whole, whole.zoom(ZOOM, MIDDLE))):
        images = {}
        for column, (method, title) in enumerate(TITLES.items()):
            rendering = jv.render_bricks(
                volume, transfer, camera, march, bricks=SPLIT, method=METHODS[method], outputs="rgba"
            )
            images[method] = np.asarray(rendering.image(BLACK))
            report = rendering.bricks
            assert report is not None
            axes = page.draw(
                row, column, images[method], f"{report.loads} bricks read", title if row == 0 else ""
            )
            if row == 0:
                side = chosen.size / ZOOM
                x, y = (chosen.size * middle - side / 2 for middle in MIDDLE)
                axes.add_patch(Rectangle((x, y), side, side, fill=False, edgecolor="w", linewidth=0.8))
        off = np.abs(images["naive"] - images["overlap"])
        share = np.mean(off.max(-1) > 1 / 255)
        caption = f"largest {off.max():.2f}\n{share:.0%} of the pixels by > 1/255"
        page.draw(row, 2, off, caption, "difference" if row == 0 else "")
        print(f"kim_fig8 {'zoomed' if row else 'whole'}: {', '.join(caption.splitlines())}")
    page.save(chosen.output / "kim_fig8.webp")


if __name__ == "__main__":
    main()
