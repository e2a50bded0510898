"""Which photons do scatterer templates hold, and how far from their sample is the centre of their light?

Tables 1 to 3 of Lee, Kwon and Shin 2016: the brightest photons of templates, in the conserving form, which
the paper's own tables have, with lengths in mean free paths; and how many there are under a threshold of 0.01
on whole levels, of which the paper has 56 to 63 at an opacity of 50 %. And its Fig. 1: all photons of a
template grown from one packet of light, and of one from four, down to fainter ones.
"""

from argparse import Namespace
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.lighting import scatterer_templates

from . import charts
from .harness import experiment


INDEX = 1.4
ROWS = 8
TABLES = {
    "Table 1: opacity 50 %, one packet": (0.5, 1),
    "Table 2: opacity 50 %, four packets": (0.5, 4),
    "Table 3, material A: opacity 30 %": (0.3, 4),
    "Table 3, material B: opacity 70 %": (0.7, 4),
}
"""Opacity, and number of packets."""
OPACITY, THRESHOLD, MANY = 0.5, 0.002, 64
REACH = 5
"""Mean free paths from the middle to the edge of a panel."""


def brightest(opacity: float, packets: int, seed: int) -> dict[str, Any]:
    """The first photons of a template, brightest first, as x, y, z and intensity; how many it has, their
    energy, and the fewest and most photons of many such templates, which differ by what is merged."""
    material, how = jv.Material(opacity, 1.0, INDEX), {"packets": packets, "threshold_on": "level"}
    template = jv.scatterer_template(material, seed, **how)
    many = np.sum(np.asarray(scatterer_templates(material, seed, count=MANY, **how).intensity) > 0, axis=-1)
    offset, intensity = np.asarray(template.offset), np.asarray(template.intensity)
    photons = np.column_stack([offset, intensity])[:ROWS]
    count, energy = int(np.sum(intensity > 0)), float(intensity.sum())
    found = {"photons": photons[photons[:, 3] > 0].tolist(), "count": count, "energy": energy}
    return found | {"counts of many": [int(many.min()), int(many.max())]}


def centres(template: Any) -> np.ndarray:
    """Mean position of the photons, weighted by their intensity; one for each of several templates."""
    intensity = np.asarray(template.intensity)[..., None]
    return (np.asarray(template.offset) * intensity).sum(-2) / intensity.sum(-2)


def grown(packets: int, seed: int) -> dict[str, Any]:
    """All photons of one template, their centre, and how far such centres are from the sample in the mean."""
    skin, how = jv.Material(OPACITY, 1.0, INDEX), {"packets": packets, "threshold": THRESHOLD}
    template = jv.scatterer_template(skin, seed, **how)
    seen = np.asarray(template.intensity) > 0
    photons = np.column_stack([np.asarray(template.offset), np.asarray(template.intensity)])[seen]
    many = centres(scatterer_templates(skin, seed, count=MANY, **how))
    return {
        "photons": np.round(photons, 5).tolist(),
        "centre": centres(template).tolist(),
        "aside, mean": float(np.linalg.norm(many, axis=-1).mean()),
    }


def draw(result: dict[str, Any]) -> Any:
    """Photons seen along z; the area of a dot is the photon's intensity. The cross marks the sample that they
    light, and the ring the centre of their light."""
    figure, (axes,) = charts.panels(1, 2, 9, 4.6)
    figure.suptitle("Discs: photons, as large as their light; +: the sample; red ring: the centre of light")
    dots = None
    for panel, (packets, found) in zip(axes, result["grown"].items(), strict=True):
        x, y, z, intensity = np.array(found["photons"]).T
        how = {"cmap": "viridis", "alpha": 0.75, "vmin": -3, "vmax": 3, "linewidths": 0}
        dots = panel.scatter(x, y, 1500 * intensity, z, **how)
        panel.plot(0, 0, "k+", markersize=14, markeredgewidth=1.5)
        ring = {"color": "C3", "markersize": 11, "fillstyle": "none", "markeredgewidth": 1.5}
        panel.plot(*found["centre"][:2], "o", **ring)
        panel.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal", xlabel="x / λ", ylabel="y / λ")
        panel.set_title(
            f"{packets}: centre of light {np.linalg.norm(found['centre']):.2f} λ aside,\n"
            f"{found['aside, mean']:.2f} λ in the mean of {MANY} of them"
        )
    figure.colorbar(dots, ax=axes, label="z / λ")
    return figure


@experiment()
def main(chosen: Namespace) -> dict[str, Any]:
    tables = {name: brightest(*how, chosen.seed) for name, how in TABLES.items()}
    packets = {"one packet": 1, "four packets": 4}
    return {"tables": tables, "grown": {name: grown(n, chosen.seed) for name, n in packets.items()}}
