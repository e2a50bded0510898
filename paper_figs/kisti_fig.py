"""The KISTI report's Fig. V-1 (2005): a head and an engine under two transfer functions, shaded. Under the
first one low values are translucent and high ones opaque, under the second all visible values are opaque. The
defaults are phantoms; `--data` draws the volumes of `experiments/kisti.py`.
"""

from argparse import Namespace

import jaxvol as jv
from experiments.kisti import METHODS, NEITHER, PHANTOMS, REAL, opaque
from jaxvol.lighting import Phong

from .common import BLACK, Page, figure


@figure(__doc__, resolution=192, size=320)
def main(chosen: Namespace) -> None:
    makers, more = (REAL, {}) if chosen.data else (PHANTOMS, {"resolution": chosen.resolution})
    page = Page(
        2,
        len(makers),
        chosen.size,
        "KISTI report, Fig. V-1: a head and an engine under two transfer functions",
    )
    for row, (name, make) in enumerate(makers.items()):
        scene = make(chosen.data, chosen.size, **more)
        for column, look in enumerate((scene, opaque(scene))):
            march = jv.March(scene.step / 2, (*METHODS[NEITHER], jv.AlphaCorrection()), "midpoint")
            rendering = jv.render(*look[:3], march, lighting=Phong(), outputs="rgba")
            title = ("low values translucent", "all visible values opaque")[column]
            page.draw(
                row,
                column,
                rendering.image(BLACK),
                f"{name}, transfer function {column + 1}",
                title if row == 0 else "",
            )
    page.save(chosen.output / "kisti_fig.webp")


if __name__ == "__main__":
    main()
