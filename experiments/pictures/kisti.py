"""The KISTI report's Fig. V-1 (2005): two volumes under two transfer functions."""

from argparse import Namespace

import jaxvol as jv
from jaxvol.lighting import Phong

from .. import kisti
from . import BLACK, Panels, panel


def kisti_fig(chosen: Namespace) -> Panels:
    """A head and an engine, shaded: phantoms, and CT beside them. 1: low values translucent; 2: all that is
    visible opaque."""
    rows: Panels = []
    kinds = {"phantom": kisti.PHANTOMS} | ({"CT": kisti.REAL} if chosen.data else {})
    for name in kisti.PHANTOMS:
        row = []
        for kind, makes in kinds.items():
            scene = makes[name](chosen.data, chosen.size, chosen.resolution)
            march = jv.March(scene.step / 2, (jv.AlphaCorrection(),), "midpoint")
            for number, seen in enumerate((scene, kisti.opaque(scene)), 1):
                image = jv.render(*seen[:3], march, lighting=Phong(), outputs="rgba").image(BLACK)
                row.append(panel(image, f"{name}, {kind}", "" if rows else f"transfer function {number}"))
        rows.append(row)
    return rows
