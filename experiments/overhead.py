"""What do the paper's methods add to the time of a whole frame?

The four columns of Kye 2013, Table 1, on four real volumes and the head phantom, at a step of one voxel: ray
casting, jittered, empty-space jittered, and both proposed methods. Frames of all four are rendered in
turn, and told as the median of their ratios to ray casting; beside each time, the image's RMSE against a
converged one. The goal is a ratio of at most 1.02 for both proposed methods.

Real volumes are read from the folder that JAXVOL_DATA names; without one, the phantom is measured alone.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv

from . import common, marches, record
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


METHODS = (marches.PLAIN, marches.JITTER, marches.EMPTY, marches.BOTH)
GOAL = 1.02


def measure(scene: Scene, repetitions: int, seed: int, termination: float | None) -> dict[str, Any]:
    """Time and error of a scene's frame under every march."""
    ends = () if termination is None else (jv.EarlyTermination(termination),)
    under = {name: jv.March(scene.step, (*marches.transforms(name, seed), *ends)) for name in METHODS}
    rows = common.compare(scene, under, repetitions)
    for name, march in under.items():
        rows[name]["aligned"] = float(np.mean(common.frame(scene, march).aligned))
    return rows


def draw(result: dict[str, dict[str, Any]], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(8, 0.55 * len(result) + 1.6), layout="constrained")
    for number, rows in enumerate(result.values()):
        for shift, (name, color) in enumerate(zip(METHODS[1:], ("C3", "C0", "C1"), strict=True)):
            ratio, y = rows[name]["ratio"], number + 0.22 * (shift - 1)
            axes.plot((ratio["low"], ratio["high"]), (y, y), color=color, linewidth=2, alpha=0.5)
            axes.plot(ratio["median"], y, "o", color=color, label=name if number == 0 else None)
    axes.axvline(1, color="k", linewidth=0.8)
    axes.axvline(GOAL, color="k", linewidth=0.8, linestyle=":")
    axes.set_yticks(range(len(result)), list(result))
    axes.invert_yaxis()
    axes.set_xlabel(f"time of a frame / ray casting: median of paired ratios, 95 % interval; dotted: {GOAL}")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    common.save(figure, path)


def main(argv: Sequence[str] | None = None) -> None:
    parser = common.options(__doc__, repetitions=15)
    parser.add_argument("--size", type=int, default=256, help="pixels along a side; the paper's are 1024")
    parser.add_argument(
        "--early-termination", type=float, metavar="LEFT", help="in all marches, as the paper"
    )
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES), metavar="VOLUME")
    given = record.arguments(argv)
    chosen = parser.parse_args(given)
    folder, names, more = common.data(), chosen.only, {}
    if folder is None or chosen.quick:
        names = [PHANTOM]
    if chosen.quick:
        chosen.size, chosen.repetitions, more = 32, 2, {"resolution": 32}

    result: dict[str, dict[str, Any]] = {}
    for name in names:
        scene = SCENES[name](folder, chosen.size, **more)
        result[name] = measure(scene, chosen.repetitions, chosen.seed, chosen.early_termination)
        for march, row in result[name].items():
            ratio = row["ratio"]
            print(
                f"{name:16} {march:30} {row['seconds']:7.3f} s  {ratio['median']:.3f} x ray casting"
                f" [{ratio['low']:.3f}, {ratio['high']:.3f}]  RMSE {row['rmse']:.5f}",
                flush=True,
            )
    mean = common.geometric_mean(rows[marches.BOTH]["ratio"]["median"] for rows in result.values())
    print(f"both proposed methods over ray casting, geometric mean: {mean:.3f}; the goal is {GOAL}")
    path = record.write(
        chosen.output / "overhead.json",
        "What do empty-space jitter and alignment add to the time of a whole frame?",
        {
            "image": [chosen.size, chosen.size],
            "repetitions": chosen.repetitions,
            "early termination": chosen.early_termination,
            "goal": GOAL,
            "both, geometric mean": mean,
            "volumes": result,
        },
        seed=chosen.seed,
        command=["experiments.overhead", *given],
    )
    draw(result, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
