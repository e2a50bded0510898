"""Kim, Kwon and Shin, Fig. 8: samples blended in the wrong order, and in the right one.

A phantom of a fetus as the paper's probe would see it, cut into bricks along the beams alone, and seen along
the fan. Left: each brick shows at once all that a ray meets in it (`method="naive"`), as the paper's Fig. 8
does on its left; middle: with overlap (`"overlap"`); right: the difference, amplified. Below, what is framed.
"""

from argparse import Namespace

import numpy as np
from matplotlib.patches import Rectangle

import jaxvol as jv
from experiments.bricks import phantom

from .common import BLACK, Page, figure


SPLIT = 1, 1, 4
AMPLIFIED = 3
FLESH = [(35, (0.9, 0.35, 0.25), 0.0), (70, (0.95, 0.6, 0.45), 0.05), (170, (1.0, 0.95, 0.85), 0.5)]
"""A transfer function in which skin is translucent."""
ZOOM, MIDDLE = 2.6, (0.5, 0.42)
EYE = (0.0, -290.0, 40.0)
TITLES = {"naive": "no overlap, each read once", "overlap": "overlap"}


@figure(__doc__, resolution=240)
def main(chosen: Namespace) -> None:
    volume, probe = phantom(chosen.resolution, "uint8")
    transfer = jv.TransferFunction.from_points(FLESH)
    first, last = probe.gamma_range
    march = jv.March(2 * float(last - first) / (volume.shape[2] - 1), (probe,))
    whole = jv.Camera(EYE, (0, 0, 105), (1, 0, 0), 26.0, size=(chosen.size,) * 2)
    page = Page(
        3, 2, chosen.size, "Kim, Kwon and Shin, Fig. 8: bricks of a scan, in the wrong and the right order"
    )
    for row, camera in enumerate((whole, whole.zoom(ZOOM, MIDDLE))):
        images = {}
        for column, (method, title) in enumerate(TITLES.items()):
            rendering = jv.render_bricks(
                volume, transfer, camera, march, bricks=SPLIT, method=method, outputs="rgba"
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
        page.draw(
            row, 2, np.clip(AMPLIFIED * off, 0, 1), caption, f"difference x {AMPLIFIED}" if row == 0 else ""
        )
        print(f"kim_fig8 {'zoomed' if row else 'whole'}: {', '.join(caption.splitlines())}")
    page.save(chosen.output / "kim_fig8.png")


if __name__ == "__main__":
    main()
