"""What does it take to cut cells at the faces of a segmentation, and what does it gain?

Kye names segmented volumes as future work. Frames of a segmented head (the phantom, in four classes by value)
and of a real segmentation (tissues of a frog), each label of one colour and extinction, with cells that are
cut at the exit alone, and at the faces of labels, too. They are jittered, which turns what is left out or
added at a face into noise. Times are taken in turn; error and noise of what is seen are against short steps
with cells cut at the faces, whose image is compared with that of short steps without.
"""

from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

import jaxvol as jv
from jaxvol.metrics import boundary_noise, rmse

from . import charts, harness, timing
from .harness import experiment, frame, image
from .scenes import Scene


FINER = 16
STEPS = (0.5, 1.0, 2.0)
"""In voxels."""
MARCHES: dict[str, tuple[jv.Transform, ...]] = {
    "all samples": (),
    "leaps and early ends": (jv.SpaceLeaping(), jv.EarlyTermination()),
}
CUTS = {"exit": jv.AlphaCorrection(), "exit and labels": jv.AlphaCorrection(labels=True)}
CLASSES = (40, 90, 150)
"""Values of the head phantom at which another class begins."""


def head(_: Path | None, size: int, resolution: int) -> Scene:
    phantom = jv.phantom("head", resolution)
    labels = np.digitize(np.asarray(phantom.data), CLASSES).astype(np.uint8)
    return seen(jv.Volume(phantom.data, phantom.spacing, phantom.origin, labels), (0.65, -1, 0.15), size)


def frog(folder: Path | None, size: int, _: int) -> Scene:
    assert folder is not None
    tissues = jv.load(folder / "frogtissue.mhd")
    labels = np.asarray(tissues.data).astype(np.uint8)
    smooth = gaussian_filter((labels > 0).astype(np.float32), 1.0)
    return seen(jv.Volume(smooth, tissues.spacing, tissues.origin, labels), (1, 0.4, 0.3), size)


def seen(volume: jv.Volume, view: Any, size: int) -> Scene:
    """Labels from 1 on, in colours of their own, from translucent to dense."""
    step, random = float(np.min(np.asarray(volume.spacing))), np.random.default_rng(0)
    functions = {
        label: jv.TransferFunction([0.0, 1e6], [random.random(3)] * 2, [0.06 * (1 + label % 5) / step] * 2)
        for label in range(1, int(np.asarray(volume.labels).max()) + 1)
    }
    camera = jv.Camera.looking_at(volume, view, size=(size, size)).zoom(1.2)
    transfer: Any = jv.LabelTransferFunction(functions)
    return Scene(volume, transfer, camera, step)


def measured(scene: Scene, chosen: Namespace) -> dict[str, Any]:
    """A row for each march, step and cut, and by how much two converged images differ."""
    short = min(chosen.steps) * scene.step / chosen.finer
    fine, other = (frame(scene, jv.March(short, (cut,), "midpoint")).rgba for cut in CUTS.values())
    truth, rows = np.asarray(other, float), {}
    visible = truth[..., 3] > 0
    for name, transforms in MARCHES.items():
        for step in chosen.steps:
            under = {
                cut: jv.March(step * scene.step, (jv.Jitter(chosen.seed), cells, *transforms))
                for cut, cells in CUTS.items()
            }
            drawn = {cut: lambda march=march: image(scene, march).rgba for cut, march in under.items()}
            seconds = timing.interleaved(drawn, chosen.repetitions)
            for cut, march in under.items():
                rendering = frame(scene, march)
                error = np.asarray(rendering.rgba, float) - truth
                rows[f"{name}, {step:g} voxels, cut at {cut}"] = {
                    **harness.row(seconds[cut], seconds["exit"], rmse(rendering.rgba, truth)),
                    "noise": boundary_noise(error[..., :3], visible),
                    "samples": int(np.sum(np.asarray(rendering.samples), dtype=np.int64)),
                }
    return {"rows": rows, "difference of the converged images": float(rmse(fine, truth))}


def draw(result: dict[str, Any]) -> Any:
    """Error against time, a line for each cut, a panel for each scene."""
    figure, axes = charts.panels(1, len(result), 5 * len(result), 3.6)
    for panel, (name, found) in zip(axes.flat, result.items(), strict=True):
        for march, marker in zip(MARCHES, "os", strict=True):
            for number, cut in enumerate(CUTS):
                named = found["rows"].items()
                rows = [row for of, row in named if of.startswith(march) and of.endswith(f"at {cut}")]
                times, errors = ([row[key] for row in rows] for key in ("seconds", "rmse"))
                panel.loglog(times, errors, f"C{number}-{marker}", label=f"{march}; cut at {cut}")
        panel.set(title=name, xlabel="seconds a frame, steps of 2, 1 and half a voxel", ylabel="RMSE")
        charts.plain_numbers(panel)
    charts.legend_below(figure, axes[0, 0], 2)
    return figure


SCENES: dict[str, Callable[..., Scene]] = {"head phantom": head, "frog": frog}


@experiment(
    repetitions=9,
    size=256,
    resolution=160,
    steps=STEPS,
    finer=FINER,
    quick={"size": 32, "repetitions": 2, "resolution": 32, "steps": (1.0,), "finer": 4},
)
def main(chosen: Namespace) -> dict[str, Any]:
    folder = None if chosen.quick else harness.data()
    made = {name: make for name, make in SCENES.items() if folder is not None or make is head}
    found = {}
    for name, make in made.items():
        found[name] = measured(make(folder, chosen.size, chosen.resolution), chosen)
        harness.show(found[name]["rows"], name)
    return found
