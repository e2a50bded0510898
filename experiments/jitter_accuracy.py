"""What do jitter and alignment do to the error, at different step lengths?

Five marches on two scenes: a block whose left half is cut by the box's faces and whose right half is an
inclined plane (its comb of rings has a known frequency), and the head phantom, its crown cut off, in
perspective. Measured against a converged image are wood grain, noise on cut faces and the whole error (RMSE);
also, the time of a frame over that of ray casting.

Jitter turns structure into noise and does not make an image more accurate: off the cut face its RMSE is about
that of ray casting. On the face, where the first sample of every ray lies at its entry under ray casting,
plain jitter can be nearer to the truth in the mean, or farther; it is noisier in any case.
"""

from argparse import Namespace
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxvol as jv
from jaxvol.metrics import boundary_noise, comb_frequency, wood_grain_energy

from . import charts, marches, timing
from .harness import entered, experiment, frame, show
from .scenes import Scene, cropped


METHODS = {
    marches.PLAIN: "k-",
    marches.JITTER: "C3--",
    marches.EMPTY: "C0-",
    marches.ALIGNED: "C2:",
    marches.BOTH: "C1-.",
}
"""With their styles in the chart."""
STEPS = (4.3, 2.3, 1.3, 0.7)
"""In voxels. Not whole or half ones: in the orthographic view the samples of all rays would then lie alike on
nodes, or between them, which has an error of its own that jitter would seem to lower."""
SLOPE = 0.35  # depth that the inclined plane gains per world length to the right
NOTE = "Jitter turns structure into noise; the size of the error stays about what it was."
PANELS = {
    "wood grain": "wood grain energy (where above 0)",
    "boundary noise": "noise on the cut face (where above 0)",
    "rmse off the face": "RMSE off the cut face",
    "time": "time / ray casting",
}


class Faced(NamedTuple):
    """A scene whose step is a voxel. `grain` measures the wood grain of an error at a step; `face` is where
    the box cuts material."""

    scene: Scene
    grain: Callable[[np.ndarray, float], float]
    face: np.ndarray


def cut_block(resolution: int, size: int) -> Faced:
    volume = jv.phantom("cut_block", resolution)
    points = [(0.05, (0.33, 0.33, 0.33), 0.0), (1.0, (0.9, 0.9, 0.9), 0.45)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.05)
    position = volume.center - np.array([0.0, 0.0, 3.0], np.float32)
    scale = 0.8
    camera = jv.Camera(position, volume.center, (0, 1, 0), size=(size, size), parallel_scale=scale)
    x = np.asarray(camera.rays()[0])[..., 0]
    rightwards = float(np.sign(x[0, -1] - x[0, 0]))
    plane = x > 0.1  # columns that do not see the step between the halves

    def grain(error: np.ndarray, step: float) -> float:
        frequency = comb_frequency(step, (rightwards * SLOPE, 0.0), 2 * scale / size)
        return wood_grain_energy(error[:, plane[0]], frequency)

    return Faced(Scene(volume, transfer, camera, float(volume.spacing[0])), grain, x < -0.1)


def head(resolution: int, size: int) -> Faced:
    volume = cropped(jv.phantom("head", resolution), (0, 0, 0), (1, 1, 0.62))
    camera = jv.Camera.looking_at(volume, (0.5, -1, 0.75), size=(size, size)).zoom(1.7, (0.52, 0.46))
    scene = Scene(volume, jv.preset("head", unit_distance=0.01), camera, float(volume.spacing[0]))
    face = entered(scene)
    below = int(np.flatnonzero(face.any(axis=1))[-1]) + 2  # below the cut face there is only skin
    return Faced(scene, lambda error, step: wood_grain_energy(error[below:]), face)


SCENES = {"cut block, orthographic": cut_block, "head, perspective": head}


def measure(of: Faced, steps: Sequence[float], repetitions: int, seed: int) -> list[dict[str, Any]]:
    """One row for each step and march."""
    scene, grain, face = of
    voxel = scene.step

    def image(rendering: jv.Rendering) -> np.ndarray:
        return np.asarray(rendering.rgba[..., :3], np.float64)

    truth = image(frame(scene, marches.converged(min(steps) * voxel)))
    rows = []
    for step in steps:
        under = {name: jv.March(step * voxel, marches.transforms(name, seed)) for name in METHODS}
        drawn = {name: partial(frame, scene, march) for name, march in under.items()}
        seconds = timing.interleaved(drawn, repetitions)
        for name in under:
            rendering = drawn[name]()
            assert not np.any(rendering.exhausted)
            error = image(rendering) - truth
            rows.append(
                {
                    "step": step,
                    "march": name,
                    "wood grain": grain(error, step * voxel),
                    "boundary noise": boundary_noise(error, face),
                    "rmse": float(np.sqrt(np.mean(error**2))),
                    "rmse off the face": float(np.sqrt(np.mean(error[~face] ** 2))),
                    "samples": int(np.sum(rendering.samples)),
                    "seconds": timing.median(seconds[name]),
                    "time": timing.ratio(seconds[name], seconds[marches.PLAIN]),
                }
            )
    return rows


def compared(result: dict[str, list[dict[str, Any]]]) -> str:
    """A sentence that compares the RMSE of both jitters with that of ray casting."""
    ratios: dict[str, list[float]] = {marches.JITTER: [], marches.EMPTY: []}
    for rows in result.values():
        errors = {(row["step"], row["march"]): row["rmse off the face"] for row in rows}
        for (step, march), error in errors.items():
            if march in ratios:
                ratios[march].append(error / errors[step, marches.PLAIN])
    said = (f"{name} {min(each):.2f} to {max(each):.2f}" for name, each in ratios.items())
    return f"RMSE off the cut face / ray casting: {', '.join(said)}."


def draw(result: dict[str, Any], path: Path) -> None:
    scenes = {name: rows for name, rows in result.items() if name != "note"}
    figure, axes = charts.panels(len(scenes), len(PANELS), 12, 2.9 * len(scenes))
    for line, (scene, rows) in zip(axes, scenes.items(), strict=True):
        for panel, (key, label) in zip(line, PANELS.items(), strict=True):
            for name, style in METHODS.items():
                mine = [row for row in rows if row["march"] == name]
                found = [row["time"]["median"] if key == "time" else row[key] for row in mine]
                panel.plot([row["step"] for row in mine], found, style, marker=".", label=name)
            panel.set_title(label, fontsize=9)
            panel.set_xscale("log", base=2)
            if key != "time":
                panel.set_yscale("log", nonpositive="mask")
            panel.set_xlabel("step, voxels", fontsize=8)
            panel.tick_params(labelsize=7, which="both")
            panel.xaxis.set_major_formatter("{x:g}")
        line[0].set_ylabel(scene, fontsize=9)
    figure.suptitle(result["note"], fontsize=9)
    charts.legend_below(figure, axes[0, 0], 5)
    charts.save(figure, path)


@experiment(
    draw,
    repetitions=5,
    size=192,
    resolution=128,
    steps=STEPS,
    quick={"size": 96, "resolution": 64, "repetitions": 1, "steps": (2.3, 1.9)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    result = {}
    for name, make in SCENES.items():
        scene = make(chosen.resolution, chosen.size)
        result[name] = measure(scene, chosen.steps, chosen.repetitions, chosen.seed)
        for row in result[name]:
            show(row, name)
    return {"note": f"{NOTE} {compared(result)}", **result}
