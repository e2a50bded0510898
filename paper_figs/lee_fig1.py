"""Lee, Kwon and Shin, Fig. 1: a template grown from one packet of light, and from four.

Photons seen along z, lengths in mean free paths; the area of a dot is the photon's intensity. The cross marks
the sample that they light, and the ring the centre of their light.
"""

from argparse import Namespace

import numpy as np
from matplotlib.axes import Axes

import jaxvol as jv
from experiments.common import plt, save
from jaxvol.lighting import ScattererTemplate, scatterer_templates

from .common import figure


OPACITY, INDEX, THRESHOLD = 0.5, 1.4, 0.002
TEMPLATES = 64
REACH = 5  # mean free paths from the middle to the edge of a panel


def centre(template: ScattererTemplate) -> np.ndarray:
    """Mean position of the photons, weighted by their intensity; one for each of several templates."""
    intensity = np.asarray(template.intensity)[..., None]
    return (np.asarray(template.offset) * intensity).sum(-2) / intensity.sum(-2)


def draw(axes: Axes, template: ScattererTemplate) -> None:
    seen = np.asarray(template.intensity > 0)
    (x, y, z), intensity = np.asarray(template.offset)[seen].T, np.asarray(template.intensity)[seen]
    axes.scatter(x, y, 1500 * intensity, z, cmap="viridis", alpha=0.75, vmin=-3, vmax=3, linewidths=0)
    axes.plot(0, 0, "k+", markersize=14, markeredgewidth=1.5)
    axes.plot(*centre(template)[:2], "o", color="C3", markersize=11, fillstyle="none", markeredgewidth=1.5)
    axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal", xlabel="x / λ", ylabel="y / λ")


@figure(__doc__)
def main(chosen: Namespace) -> None:
    skin = jv.Material(OPACITY, 1.0, INDEX)
    page, axes = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
    page.suptitle(
        "Discs: photons, as large as their light; +: the sample; red ring: the centre of light", fontsize=9
    )
    for panel, packets, title in zip(axes, (1, 4), ("one packet", "four packets"), strict=True):
        template = jv.scatterer_template(skin, 0, packets=packets, threshold=THRESHOLD)
        draw(panel, template)
        many = scatterer_templates(skin, 0, count=TEMPLATES, packets=packets, threshold=THRESHOLD)
        aside, mean = (np.linalg.norm(centre(t), axis=-1).mean() for t in (template, many))
        caption = (
            f"{title}: centre of light {aside:.2f} λ aside,\n{mean:.2f} λ in the mean of {TEMPLATES} of them"
        )
        panel.set_title(caption, fontsize=10)
        print(f"lee_fig1 {' '.join(caption.split())}; {np.sum(template.intensity > 0)} photons")
    page.colorbar(axes[-1].collections[0], ax=axes, label="z / λ")
    save(page, chosen.output / "lee_fig1.webp")


if __name__ == "__main__":
    main()
