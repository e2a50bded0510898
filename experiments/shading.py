"""What does shading by gradients cost, beside the unshaded frame and beside VTK's?

An engine and a bonsai, rendered with and without `Phong` by jaxvol, and with and without `ShadeOn` by VTK's
ray caster, all in turn, at steps of one voxel on as many threads as cores. Each shaded image's error is its
RMSE against the converged image of its own renderer, since the two shade by different rules: VTK lights nodes
and interpolates what that gives. The goals: 1.8 times the unshaded frame in the geometric mean, and half of
the time of VTK's shaded frame at no larger error.

Volumes are read from the folder that JAXVOL_DATA names; without one, the head phantom stands in. Without VTK
only jaxvol is measured.
"""

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.lighting import Phong
from jaxvol.metrics import rmse

from . import common, marches, peer_vtk, timing
from .accuracy import LEFT
from .common import plt
from .scenes import PHANTOM, SCENES, Scene
from .speed import THREADS


GOALS = {"over unshaded": 1.8, "VTK's shaded over ours": 2.0}
OURS, PLAIN, VTK, VTK_PLAIN = "Phong", "unshaded", "VTK, ShadeOn", "VTK, unshaded"


def frame(scene: Scene, lighting: Phong | None, step: float) -> Any:
    transforms = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT)
    march = jv.March(step, transforms, "midpoint")
    return jv.render(*scene[:3], march, lighting=lighting, outputs="rgba").rgba


def over_white(rgba: Any) -> np.ndarray:
    image = np.asarray(rgba)
    return image[..., :3] + 1 - image[..., 3:]


def by_vtk(scene: Scene, lighting: Phong | None, step: float) -> peer_vtk.Drawn:
    return peer_vtk.prepare(*scene[:3], step, THREADS, shade=lighting)


def measure(scene: Scene, repetitions: int, finer: int) -> dict[str, Any]:
    """Times, their ratios, and the errors of the shaded images."""
    phong = Phong()
    programs: dict[str, Callable[[], Any]] = {
        PLAIN: partial(frame, scene, None, scene.step),
        OURS: partial(frame, scene, phong, scene.step),
    }
    exact = jv.render(*scene[:3], marches.converged(scene.step, finer), lighting=phong, outputs="rgba").rgba
    errors = {OURS: rmse(over_white(programs[OURS]()), over_white(exact))}
    if find_spec("vtk") is not None:
        drawn = {VTK_PLAIN: by_vtk(scene, None, scene.step), VTK: by_vtk(scene, phong, scene.step)}
        programs |= {name: each.draw for name, each in drawn.items()}
        errors[VTK] = rmse(drawn[VTK].image(), by_vtk(scene, phong, scene.step / finer).image())
    seconds = timing.interleaved(programs, repetitions)
    found: dict[str, Any] = {
        "seconds": {name: round(float(np.median(all_)), 5) for name, all_ in seconds.items()},
        "over unshaded": timing.ratio(seconds[OURS], seconds[PLAIN]),
        "rmse": {name: float(error) for name, error in errors.items()},
    }
    if VTK in seconds:
        found["VTK's over unshaded"] = timing.ratio(seconds[VTK], seconds[VTK_PLAIN])
        found["VTK's shaded over ours"] = timing.ratio(seconds[VTK], seconds[OURS])
    return found


def draw(scenes: dict[str, Any], path: Path) -> None:
    figure, axes = plt.subplots(
        1, len(scenes), figsize=(4.6 * len(scenes), 3), squeeze=False, layout="constrained"
    )
    for panel, (name, row) in zip(axes[0], scenes.items(), strict=True):
        bars = {n: s * 1e3 for n, s in row["seconds"].items()}
        panel.bar(range(len(bars)), list(bars.values()), color=["#bbb", "C2", "#bbb", "C0"][: len(bars)])
        labels = [f"{n}\nRMSE {row['rmse'][n]:.4f}" if n in row["rmse"] else n for n in bars]
        panel.set_xticks(range(len(bars)), labels, fontsize=8)
        panel.set_title(name, fontsize=9)
    axes[0][0].set_ylabel("time of a frame, ms", fontsize=9)
    figure.suptitle("Frames shaded by the gradient (RMSE: of the shaded image), and unshaded", fontsize=9)
    common.save(figure, path)


@common.experiment(
    "shading",
    "What does shading by gradients cost, beside the unshaded frame and beside VTK's?",
    __doc__,
    repetitions=15,
    size=512,
    only=common.some_of(("engine", "bonsai"), "SCENE"),
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    finer, more = common.FINER, {}
    if chosen.quick:
        chosen.size, chosen.repetitions, finer, more = 32, 2, 2, {"resolution": 32}
    scenes = {}
    for name in names:
        row = scenes[name] = measure(SCENES[name](folder, chosen.size, **more), chosen.repetitions, finer)
        print(name, row, flush=True)
    means = {
        key: common.geometric_mean(row[key]["median"] for row in scenes.values())
        for key in GOALS
        if all(key in row for row in scenes.values())
    }
    print(means, "the goals are", GOALS)
    result = {"image": [chosen.size] * 2, "goals": GOALS, "geometric means": means, "scenes": scenes}
    return result, partial(draw, scenes)


if __name__ == "__main__":
    main()
