"""What do the paper's methods add to the time of a whole frame?

The four columns of Kye 2013, Table 1, on four real volumes and the head phantom, at a step of one voxel: ray
casting, jittered, empty-space jittered, and both proposed methods. Frames of all four are rendered in turn,
and times are given as the median of their ratios to ray casting, with each image's RMSE against a converged
one. The goal is a ratio of at most 1.02 for both proposed methods, in the geometric mean.

The same again as in the paper: where all four marches leap over empty space and end rays early. Frames are
then shorter, and the goal is 1.05.

Real volumes are read from the folder that JAXVOL_DATA names; without one, only the phantom is measured.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxvol as jv

from . import common, marches
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


METHODS = (marches.PLAIN, marches.JITTER, marches.EMPTY, marches.BOTH)
SIZES = 512, 1024
ENDED = 1 / 255


class Condition(NamedTuple):
    """Transforms of all marches, and the goal."""

    transforms: tuple[jv.Transform, ...]
    goal: float


CONDITIONS = {
    "all samples": Condition((), 1.02),
    "as in the paper": Condition((jv.SpaceLeaping(), jv.EarlyTermination(ENDED)), 1.05),
}
SHOWN = {"as in the paper": "leaps and early ends, as in the paper"}
"""How a condition is called in the chart, where not as in the record."""


def measure(scene: Scene, repetitions: int, seed: int, condition: Condition) -> dict[str, Any]:
    """Time and error of a scene's frame under every march."""
    jax.clear_caches()  # a process cannot hold the programs of all scenes
    under = {
        name: jv.March(scene.step, (*marches.transforms(name, seed), *condition.transforms))
        for name in METHODS
    }
    rows = common.compare(scene, under, repetitions)
    for name, march in under.items():
        rows[name]["aligned"] = float(np.mean(common.frame(scene, march).aligned))
    return rows


def draw(conditions: dict[str, Any], sizes: Sequence[int], path: Path) -> None:
    volumes = len(next(iter(conditions.values()))["volumes"])
    panels = [(condition, size) for condition in conditions for size in sizes]
    figure, axes = plt.subplots(
        len(conditions),
        len(sizes),
        figsize=(5 * len(sizes) + 2, (0.55 * volumes + 0.7) * len(conditions) + 0.9),
        squeeze=False,
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for panel, (condition, pixels) in zip(axes.flat, panels, strict=True):
        measured, goal = conditions[condition]["volumes"], conditions[condition]["goal"]
        for number, rows in enumerate(of_size[str(pixels)] for of_size in measured.values()):
            for shift, (name, color) in enumerate(zip(METHODS[1:], ("C3", "C0", "C1"), strict=True)):
                ratio, y = rows[name]["ratio"], number + 0.22 * (shift - 1)
                panel.plot((ratio["low"], ratio["high"]), (y, y), color=color, linewidth=2, alpha=0.5)
                label = name if number == 0 and panel is axes[0, 0] else None
                panel.plot(ratio["median"], y, "o", color=color, label=label)
        panel.axvline(1, color="k", linewidth=0.8)
        panel.axvline(goal, color="k", linewidth=0.8, linestyle=":")
        panel.set_title(
            f"{SHOWN.get(condition, condition)}, {pixels} x {pixels} pixels; dotted: goal, {goal}", fontsize=9
        )
        panel.set_yticks(range(volumes), list(measured))
    axes[0, 0].invert_yaxis()
    figure.supxlabel(
        "time of a frame / that of ray casting: median of paired ratios, 95 % interval", fontsize=9
    )
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    common.save(figure, path)


@common.experiment(
    "overhead",
    "What do empty-space jitter and alignment add to the time of a whole frame?",
    __doc__,
    repetitions=15,
    sizes={"nargs": "+", "type": int, "default": SIZES, "help": "pixels along a side; the paper's are 1024"},
    only=common.some_of(SCENES, "VOLUME"),
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    more = {}
    if chosen.quick:
        chosen.sizes, chosen.repetitions, more = (32,), 2, {"resolution": 32}

    conditions: dict[str, Any] = {}
    for said, condition in CONDITIONS.items():
        volumes: dict[str, dict[str, Any]] = {name: {} for name in names}
        means: dict[str, float] = {}
        for size in chosen.sizes:
            for name, of_size in volumes.items():
                scene = SCENES[name](folder, size, **more)
                of_size[str(size)] = measure(scene, chosen.repetitions, chosen.seed, condition)
                for march, row in of_size[str(size)].items():
                    ratio = row["ratio"]
                    print(
                        f"{said}: {name:16} {size:4}  {march:30} {row['seconds']:7.3f} s"
                        f"  {ratio['median']:.3f} x ray casting [{ratio['low']:.3f}, {ratio['high']:.3f}]"
                        f"  RMSE {row['rmse']:.5f}",
                        flush=True,
                    )
            means[str(size)] = common.geometric_mean(
                of_size[str(size)][marches.BOTH]["ratio"]["median"] for of_size in volumes.values()
            )
        print(f"{said}: both proposed methods, geometric means: {means}; the goal is {condition.goal}")
        conditions[said] = {"goal": condition.goal, "both, geometric means": means, "volumes": volumes}
    result = {"sizes": chosen.sizes, "repetitions": chosen.repetitions, "conditions": conditions}
    return result, partial(draw, conditions, chosen.sizes)


if __name__ == "__main__":
    main()
