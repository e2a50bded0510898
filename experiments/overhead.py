"""What do the paper's methods add to the time of a whole frame?

The four columns of Kye 2013, Table 1, on four real volumes and the head phantom, at a step of one voxel: ray
casting, jittered, empty-space jittered, and both proposed methods. Frames of all four are rendered in turn,
and times are given as the median of their ratios to ray casting, with each image's RMSE against a converged
one, and the part of its pixels that alignment changes. The goal is a ratio of at most 1.02 for both proposed
methods, in the geometric mean. Two of the volumes end in air on all sides, so that alignment would do nothing
there: a part of each is shown, enlarged, as the paper does. The same again as in the paper, where all four
marches leap over empty space and end rays early: frames are then shorter, and the goal is 1.05.
"""

from argparse import Namespace
from typing import Any

import jax

import jaxvol as jv

from . import charts, marches
from .harness import chosen_scenes, compare, experiment, geometric_mean, some_of
from .scenes import PHANTOM, SCENES, cut


METHODS = {marches.PLAIN: "k", marches.JITTER: "C3", marches.EMPTY: "C0", marches.BOTH: "C1"}  # with colours
CUT: dict[str, Any] = {
    "engine": ((0.4, 0, 0), (1, 1, 0.6), 1.5),
    "aneurism": ((0, 0, 0), (1, 0.4, 1), 2.5, (0.45, 0.45)),
}
"""What is left of a volume, and how its view is enlarged."""
VOLUMES = {
    f"{name}, cut" if name in CUT else name: cut(make, *CUT[name]) if name in CUT else make
    for name, make in SCENES.items()
}
CONDITIONS: dict[str, tuple[tuple[jv.Transform, ...], float]] = {
    "all samples": ((), 1.02),
    "as in the paper": ((jv.SpaceLeaping(), jv.EarlyTermination(1 / 255)), 1.05),
}
"""Transforms of all marches, and the goal."""


def draw(result: dict[str, Any]) -> Any:
    conditions, sizes = result["conditions"], result["sizes"]
    volumes = len(next(iter(conditions.values()))["volumes"])
    width, height = 5 * len(sizes) + 2, (0.55 * volumes + 0.7) * len(conditions) + 0.9
    figure, axes = charts.panels(len(conditions), len(sizes), width, height, sharex=True, sharey=True)
    panels = [(condition, size) for condition in conditions for size in sizes]
    for panel, (condition, pixels) in zip(axes.flat, panels, strict=True):
        measured, goal = conditions[condition]["volumes"], conditions[condition]["goal"]
        for number, rows in enumerate(of_size[str(pixels)] for of_size in measured.values()):
            for shift, (name, color) in enumerate(list(METHODS.items())[1:]):
                label = name if number == 0 and panel is axes[0, 0] else None
                charts.interval(panel, rows[name]["ratio"], number + 0.22 * (shift - 1), color, label)
        panel.axvline(1, color="k", linewidth=0.8)
        panel.axvline(goal, color="k", linewidth=0.8, linestyle=":")
        panel.set_title(f"{condition},\n{pixels} x {pixels} pixels; dotted: goal, {goal}")
        panel.set_yticks(range(volumes), list(measured))
    axes[0, 0].invert_yaxis()
    figure.supxlabel("time of a frame / that of ray casting: median of paired ratios, 95 % interval")
    figure.legend(loc="outside upper center", ncols=3)
    return figure


@experiment(
    repetitions=15,
    sizes={"nargs": "+", "type": int, "default": (512, 1024), "help": "pixels along a side"},
    resolution=192,
    only=some_of(VOLUMES, "VOLUME"),
    quick={"sizes": (32,), "repetitions": 2, "resolution": 32},
)
def main(chosen: Namespace) -> dict[str, Any]:
    conditions: dict[str, Any] = {}
    for said, (more, goal) in CONDITIONS.items():
        volumes: dict[str, dict[str, Any]] = {}
        means: dict[str, float] = {}
        for size in chosen.sizes:
            for name, scene in chosen_scenes(chosen, VOLUMES, PHANTOM, size):
                jax.clear_caches()  # a process cannot hold the programs of all scenes
                transforms = {n: (*marches.transforms(n, chosen.seed), *more) for n in METHODS}
                under = {n: jv.March(scene.step, each) for n, each in transforms.items()}
                rows = compare(scene, under, chosen.repetitions)
                assert chosen.quick or rows[marches.BOTH]["aligned"] > 0, name
                volumes.setdefault(name, {})[str(size)] = rows
            both = (of_size[str(size)][marches.BOTH]["ratio"]["median"] for of_size in volumes.values())
            means[str(size)] = geometric_mean(both)
        conditions[said] = {"goal": goal, "both, geometric means": means, "volumes": volumes}
    return {"sizes": chosen.sizes, "conditions": conditions}
