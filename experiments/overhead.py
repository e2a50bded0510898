"""What do the paper's methods add to the time of a whole frame?

The four columns of Kye 2013, Table 1, on four real volumes and the head phantom, at a step of one voxel: ray
casting, jittered, empty-space jittered, and both proposed methods. Frames of all four are rendered in turn,
and times are given as the median of their ratios to ray casting, with each image's RMSE against a converged
one. The goal is a ratio of at most 1.02 for both proposed methods, in the geometric mean.

Real volumes are read from the folder that JAXVOL_DATA names; without one, only the phantom is measured.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv

from . import common, marches
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


METHODS = (marches.PLAIN, marches.JITTER, marches.EMPTY, marches.BOTH)
GOAL = 1.02
SIZES = 512, 1024


def measure(scene: Scene, repetitions: int, seed: int, termination: float | None) -> dict[str, Any]:
    """Time and error of a scene's frame under every march."""
    ends = () if termination is None else (jv.EarlyTermination(termination),)
    under = {name: jv.March(scene.step, (*marches.transforms(name, seed), *ends)) for name in METHODS}
    rows = common.compare(scene, under, repetitions)
    for name, march in under.items():
        rows[name]["aligned"] = float(np.mean(common.frame(scene, march).aligned))
    return rows


def draw(volumes: dict[str, Any], sizes: Sequence[int], path: Path) -> None:
    size = (5 * len(sizes) + 2, 0.55 * len(volumes) + 1.6)
    figure, (axes,) = plt.subplots(
        1, len(sizes), figsize=size, squeeze=False, sharex=True, sharey=True, layout="constrained"
    )
    for panel, pixels in zip(axes, sizes, strict=True):
        for number, rows in enumerate(of_size[str(pixels)] for of_size in volumes.values()):
            for shift, (name, color) in enumerate(zip(METHODS[1:], ("C3", "C0", "C1"), strict=True)):
                ratio, y = rows[name]["ratio"], number + 0.22 * (shift - 1)
                panel.plot((ratio["low"], ratio["high"]), (y, y), color=color, linewidth=2, alpha=0.5)
                label = name if number == 0 and panel is axes[0] else None
                panel.plot(ratio["median"], y, "o", color=color, label=label)
        panel.axvline(1, color="k", linewidth=0.8)
        panel.axvline(GOAL, color="k", linewidth=0.8, linestyle=":")
        panel.set_xlabel(f"{pixels} x {pixels} pixels", fontsize=9)
    axes[0].set_yticks(range(len(volumes)), list(volumes))
    axes[0].invert_yaxis()
    figure.supxlabel(
        f"time of a frame / ray casting: median of paired ratios, 95 % interval; dotted: {GOAL}", fontsize=9
    )
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    common.save(figure, path)


@common.experiment(
    "overhead",
    "What do empty-space jitter and alignment add to the time of a whole frame?",
    __doc__,
    repetitions=15,
    sizes={"nargs": "+", "type": int, "default": SIZES, "help": "pixels along a side; the paper's are 1024"},
    early_termination={"type": float, "metavar": "LEFT", "help": "in all marches, as in the paper"},
    only=common.some_of(SCENES, "VOLUME"),
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    more = {}
    if chosen.quick:
        chosen.sizes, chosen.repetitions, more = (32,), 2, {"resolution": 32}

    volumes: dict[str, dict[str, Any]] = {name: {} for name in names}
    means: dict[str, float] = {}
    for size in chosen.sizes:
        for name, of_size in volumes.items():
            scene = SCENES[name](folder, size, **more)
            of_size[str(size)] = measure(scene, chosen.repetitions, chosen.seed, chosen.early_termination)
            for march, row in of_size[str(size)].items():
                ratio = row["ratio"]
                print(
                    f"{name:16} {size:4}  {march:30} {row['seconds']:7.3f} s"
                    f"  {ratio['median']:.3f} x ray casting [{ratio['low']:.3f}, {ratio['high']:.3f}]"
                    f"  RMSE {row['rmse']:.5f}",
                    flush=True,
                )
        means[str(size)] = common.geometric_mean(
            of_size[str(size)][marches.BOTH]["ratio"]["median"] for of_size in volumes.values()
        )
    print(f"both proposed methods over ray casting, geometric means: {means}; the goal is {GOAL}")
    return {
        "sizes": chosen.sizes,
        "repetitions": chosen.repetitions,
        "early termination": chosen.early_termination,
        "goal": GOAL,
        "both, geometric means": means,
        "volumes": volumes,
    }, partial(draw, volumes, chosen.sizes)


if __name__ == "__main__":
    main()
