"""Kim, Kwon and Shin, Fig. 6: the order of bricks, by the depth of their centres.

The paper's scan cut into six bricks, in the plane of the motor's turn, and a camera beside it. The numbers
are the order in which `render_bricks` takes them; the lines lead from the camera to their centres.
The ray leaves a brick through its curved face and comes back to it (the paper's Fig. 4); the dashed chord of
that face is what K reaches to.
"""

from argparse import Namespace

from experiments import charts
from experiments.harness import QUICK, command
from experiments.pictures.kim import order_of_bricks

from .common import OUTPUT


@command(__doc__, OUTPUT, quick=QUICK)
def main(chosen: Namespace) -> None:
    found = order_of_bricks()
    figure, ((axes,),) = charts.panels(1, 1, 6.4, 4.4)
    blues, text = charts.plt.get_cmap("Blues"), {"textcoords": "offset points", "fontsize": 9}
    for turn, (edge, middle) in enumerate(zip(found.edges, found.middles, strict=True), 1):
        axes.fill(*edge.T, facecolor=blues(0.65 - 0.09 * turn), edgecolor="k", linewidth=1)
        axes.plot(*zip(found.eye, middle, strict=True), color="0.5", linewidth=0.7, linestyle=":")
        axes.plot(*middle, "k.", markersize=4)
        axes.annotate(str(turn), tuple(middle), (4, 4), **text | {"fontsize": 13, "weight": "bold"})
    axes.plot(*found.eye, "ks", markersize=8)
    axes.annotate("camera", tuple(found.eye), (0, 9), ha="center", **text)
    axes.plot(*found.chord[[0, 2]].T, "k--", linewidth=0.8)
    axes.plot(*found.ray.T, "C3-", linewidth=1.2)
    axes.annotate("ray", tuple(found.ray[1]), (4, 0), color="C3", **text)
    axes.plot(0, 0, "k+", markersize=9)
    axes.annotate("motor axis", (0, 0), (6, -3), **text)
    axes.set_aspect("equal")
    axes.set_xlabel("y, mm", fontsize=8)
    axes.set_ylabel("z, mm", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.set_title("Kim, Kwon and Shin, Fig. 6: bricks in the order of their centres' depth", fontsize=9)
    charts.save(figure, chosen.output / "kim_fig6.webp")


if __name__ == "__main__":
    main()
