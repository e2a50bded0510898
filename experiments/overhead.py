"""What do the paper's methods add to the time of a whole frame?

The four columns of Kye 2013, Table 1, on four real volumes and the head phantom, at a step of one voxel: ray
casting, jittered, empty-space jittered, and both proposed methods. Frames of all four are rendered in
turn, and told as the median of their ratios to ray casting; beside each time, the image's RMSE against a
converged one. The goal is a ratio of at most 1.02 for both proposed methods.

Real volumes are read from the folder that JAXVOL_DATA names; without one, the phantom is measured alone.
"""

import argparse
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse

from . import marches, record, timing
from .scenes import PHANTOM, SCENES, Scene


matplotlib.use("Agg")
import matplotlib.pyplot as plt


METHODS = (marches.PLAIN, marches.JITTER, marches.EMPTY, marches.BOTH)
GOAL = 1.02
FINER = 8  # the converged image's step; in the middle of cells, its error is some hundred times as small


def measure(scene: Scene, repetitions: int, seed: int, termination: float | None) -> dict[str, Any]:
    """Time and error of a scene's frame under every march."""
    ends = () if termination is None else (jv.EarlyTermination(termination),)

    def frame(march: jv.March) -> jv.Rendering:
        return jv.render(scene.volume, scene.transfer, scene.camera, march)

    under = {name: jv.March(scene.step, (*marches.transforms(name, seed), *ends)) for name in METHODS}
    seconds = timing.interleaved({n: lambda m=m: frame(m) for n, m in under.items()}, repetitions)
    truth = frame(marches.converged(scene.step, FINER)).rgba
    rows = {}
    for name, march in under.items():
        rendering = frame(march)
        assert not np.any(rendering.exhausted)
        rows[name] = {
            "seconds": round(float(np.median(seconds[name])), 5),
            "ratio": timing.ratio(seconds[name], seconds[marches.PLAIN]),
            "rmse": rmse(rendering.rgba, truth),
            "samples": int(np.sum(rendering.samples)),
            "aligned": float(np.mean(rendering.aligned)),
            "all seconds": [round(s, 5) for s in seconds[name]],
        }
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
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=record.RESULTS, metavar="FOLDER")
    parser.add_argument("--size", type=int, default=256, help="pixels along a side; the paper's are 1024")
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--early-termination", type=float, metavar="LEFT", help="in all marches, as the paper"
    )
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES), metavar="VOLUME")
    parser.add_argument("--quick", action="store_true", help="tiny phantom, to see that the script runs")
    given = record.arguments(argv)
    chosen = parser.parse_args(given)
    data = os.environ.get("JAXVOL_DATA")
    folder = Path(data) if data else None
    names, more = chosen.only, {}
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
    mean = math.exp(np.mean([np.log(rows[marches.BOTH]["ratio"]["median"]) for rows in result.values()]))
    print(f"both proposed methods over ray casting, geometric mean: {mean:.3f}; the goal is {GOAL}")
    path = record.write(
        chosen.output / "overhead.json",
        "What do empty-space jitter and alignment add to the time of a whole frame?",
        {
            "image": [chosen.size, chosen.size],
            "repetitions": chosen.repetitions,
            "early termination": chosen.early_termination,
            "goal": GOAL,
            "both, geometric mean": round(mean, 4),
            "volumes": result,
        },
        seed=chosen.seed,
        command=["experiments.overhead", *given],
    )
    draw(result, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
