"""Pictures of scenes, as `experiments.pictures` renders them."""

from argparse import Namespace
from functools import partial

import numpy as np

from experiments import charts
from experiments.harness import QUICK, Main, command, left
from experiments.marches import JITTER, PLAIN
from experiments.pictures import chae, kisti, kye, lee, lee_steps, lee_wave
from experiments.pictures.kim import kim_fig8, order_of_bricks

from .common import OUTPUT, pictures


CHAE = "Chae and Shin, Fig. 6: part of an image of twice the size; wrong pixels are green"
FIG01 = "Fig. 1: wood grain, and noise on the cut face; phantom, and CT of a head"
FIG09 = "Fig. 9: the head, phantom and CT; boundary noise is that of the cut face"
LIT_GRAIN = "The head by Phong's shading, and pre-integrated; wood grain is that off the cut face"
FIG10 = "Fig. 10: a cut engine in place of the heart, and CT of a heart; boundary noise: of the cut faces"
FIG11 = "Fig. 11: a colon, and CT of a liver, in place of the kidney; boundary noise: of the cut faces"
FIG12 = "Fig. 12: vessels, phantom and CT of a lung; boundary noise: of the pixels that alignment changes"
KIM = "Kim, Kwon and Shin, Fig. 8: bricks of a scan, in the wrong and the right order"
KISTI = "KISTI report, Fig. V-1: a head and an engine under two transfer functions"
STEPS = (
    "Lee, Kwon and Shin: the steps of shading, one at a time. "
    "Numbers: mean linear red, green and blue of what is visible"
)
PRINTED = "Lee, Kwon and Shin: steps 4 and 5. Numbers: mean linear red, green and blue of what is visible"
EAR = "Lee, Kwon and Shin, Fig. 4: an ear, light from behind the head"
HAND = "A hand, light from the left"
LIT = "Lee, Kwon and Shin, Fig. 6: light from the left"


@command("Kim, Kwon and Shin, Fig. 6: the order of bricks.", OUTPUT, quick=QUICK)
def kim_fig6(chosen: Namespace) -> None:
    """The paper's scan in six bricks, in the plane of the motor's turn. The ray leaves a brick through its
    curved face and comes back to it (the paper's Fig. 4); K reaches to the dashed chord of that face."""
    found = order_of_bricks()
    figure, ((axes,),) = charts.panels(1, 1, 6.4, 4.4)
    blues, text = charts.plt.get_cmap("Blues"), {"textcoords": "offset points"}
    for turn, (edge, middle) in enumerate(zip(found.edges, found.middles, strict=True), 1):
        axes.fill(*edge.T, facecolor=blues(0.65 - 0.09 * turn), edgecolor="k", linewidth=1)
        axes.plot(*zip(found.eye, middle, strict=True), color="0.5", linewidth=0.7, linestyle=":")
        axes.plot(*middle, "k.", markersize=4)
        axes.annotate(str(turn), tuple(middle), (4, 4), **text | {"fontsize": "x-large", "weight": "bold"})
    axes.plot(*found.eye, "ks", markersize=8)
    axes.annotate("camera", tuple(found.eye), (0, 9), ha="center", **text)
    axes.plot(*found.chord[[0, 2]].T, "k--", linewidth=0.8)
    axes.plot(*found.ray.T, "C3-", linewidth=1.2)
    axes.annotate("ray", tuple(found.ray[1]), (-24, 6), color="C3", **text)
    axes.plot(0, 0, "k+", markersize=9)
    axes.annotate("motor axis", (0, 0), (6, -3), **text)
    axes.set_aspect("equal")
    axes.set(xlabel="y, mm", ylabel="z, mm", title="Fig. 6: bricks in the order of their centres' depth")
    charts.save(figure, chosen.output / "kim_fig6.webp")


@command("Lee, Kwon and Shin, Fig. 5: Snell's wave between two media.", OUTPUT, quick=QUICK)
def lee_fig5(chosen: Namespace) -> None:
    """Left, wave fronts from the sample (+), at equal times; dotted, where they would be in A alone. Right,
    the photons of a template that was grown in A: those that lie in B (rings) are moved (discs)."""
    found, plane = lee_wave.wave(), lee_wave.PLANE
    figure, ((waves, photons),) = charts.panels(1, 2, 9, 4.7)
    for before, after in zip(found.fronts, found.moved_fronts, strict=True):
        in_b = before[:, 0] > plane
        waves.plot(*np.where(in_b[:, None], before, np.nan).T, color="0.6", linewidth=0.8, linestyle=":")
        waves.plot(*np.where(in_b[:, None], np.nan, before).T, "C0-", linewidth=1.2)
        waves.plot(*np.where(in_b[:, None], after, np.nan).T, "C1-", linewidth=1.2)
    in_b, size = found.photons[:, 0] > plane, 4000 * found.intensity
    how = {"linewidths": 0, "alpha": 0.6}
    photons.scatter(*found.photons[~in_b].T, size[~in_b], "C0", label="in A, where they are", **how)
    photons.scatter(*found.photons[in_b].T, size[in_b], facecolors="none", edgecolors="0.6", linewidths=0.6)
    photons.scatter(*found.moved_photons[in_b].T, size[in_b], "C1", label="in B, moved", **how)
    for panel, title in ((waves, "wave fronts at equal times"), (photons, "photons of a template of A")):
        panel.axvspan(plane, 1, color="0.93", zorder=0)
        panel.plot(0, 0, "k+", markersize=10)
        panel.set(xlim=(-0.55, 0.75), ylim=(-0.65, 0.65), aspect="equal", xlabel="x", ylabel="y")
        panel.text(-0.5, -0.6, f"A: n = {lee_wave.INDICES[0]:g}", backgroundcolor="w")
        panel.text(0.74, -0.6, f"B: n = {lee_wave.INDICES[1]:g}", ha="right")
        panel.set_title(title)
    photons.legend(loc="upper left")
    ratio = lee_wave.INDICES[0] / lee_wave.INDICES[1]
    figure.suptitle(f"Lee, Kwon and Shin, Fig. 5: in B light travels {ratio:.4f} times as far as in A")
    charts.save(figure, chosen.output / "lee_fig5.webp")


PICTURES: dict[str, Main] = {
    "fig01": pictures("fig01", FIG01, partial(kye.comparison, "head", methods=(PLAIN, JITTER)), data=True),
    "fig09": pictures("fig09", FIG09, partial(kye.comparison, "head"), data=True),
    "kye_conditions": pictures("kye_conditions", LIT_GRAIN, partial(kye.conditions, "head"), data=True),
    "fig10": pictures("fig10", FIG10, partial(kye.comparison, "heart"), data=True),
    "fig11": pictures("fig11", FIG11, partial(kye.comparison, "kidney"), data=True),
    "fig12": pictures("fig12", FIG12, partial(kye.comparison, "vessels", region=left), data=True),
    "fig13": pictures("fig13", "Fig. 13: pixels that alignment changes", kye.fig13, data=True),
    "chae_fig6": pictures("chae_fig6", CHAE, chae.chae_fig6, resolution=256, data=True),
    "kim_fig6": kim_fig6,
    "kim_fig8": pictures("kim_fig8", KIM, kim_fig8, resolution=360),
    "kisti_fig": pictures("kisti_fig", KISTI, kisti.kisti_fig, resolution=192, data=True),
    "lee_fig_steps": pictures("lee_fig_steps", STEPS, lee_steps.lee_fig_steps, resolution=96),
    "lee_printed": pictures("lee_printed", PRINTED, lee_steps.lee_printed, resolution=96, size=320),
    "lee_fig4": pictures("lee_fig4", EAR, lee.lee_fig4, resolution=96, size=384, data=True),
    "lee_fig5": lee_fig5,
    "lee_fig6": pictures("lee_fig6", LIT, lee.lee_fig6, resolution=128, size=384, data=True),
    "lee_hand": pictures("lee_hand", HAND, lee.lee_hand, size=512),
    "gallery": pictures("gallery", "Kinds of light", lee.gallery, resolution=128, data=True),
}
"""By the name of what is written."""
