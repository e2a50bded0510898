"""The KISTI report's Fig. V-1 (2005): two volumes under two transfer functions."""

from argparse import Namespace

import jaxvol as jv
from jaxvol.lighting import Phong

from .. import kisti
from . import BLACK, Panels, panel


def kisti_fig(chosen: Namespace) -> Panels:
    """A head and an engine, shaded."""
    rows: Panels = []
    for name, make in (kisti.REAL if chosen.data else kisti.PHANTOMS).items():
        scene, row = make(chosen.data, chosen.size, chosen.resolution), []
        titles = ("low values translucent", "all visible values opaque")
        for number, seen in enumerate((scene, kisti.opaque(scene))):
            march = jv.March(scene.step / 2, (jv.AlphaCorrection(),), "midpoint")
            image = jv.render(*seen[:3], march, lighting=Phong(), outputs="rgba").image(BLACK)
            row.append(
                panel(image, f"{name}, transfer function {number + 1}", "" if rows else titles[number])
            )
        rows.append(row)
    return rows
