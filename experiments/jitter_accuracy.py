"""What do jitter and alignment do to the error, at different step lengths?

Five marches on two scenes: a block whose left half is cut by the box's faces and whose right half is an
inclined plane (its comb of rings has a known frequency), and the head phantom, its crown cut off, in
perspective. Measured against a converged image are wood grain, noise on cut faces and the whole error (RMSE);
also, the time of a frame over that of ray casting.

Jitter turns structure into noise and does not make an image more accurate: off the cut face its RMSE is about
that of ray casting. On the face, where the first sample of every ray lies at its entry under ray casting,
plain jitter can be nearer to the truth in the mean, or farther; it is noisier in any case.
"""

import textwrap
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import jaxvol as jv
from jaxvol.metrics import boundary_noise, comb_frequency, wood_grain_energy

from . import charts, marches, timing
from .harness import entered, experiment, frame
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


def measure(of: Faced, chosen: Namespace) -> list[dict[str, Any]]:
    """One row for each step and march."""
    scene, grain, face = of

    def image(march: jv.March) -> np.ndarray:
        return np.asarray(frame(scene, march).rgba[..., :3], np.float64)

    truth, rows = image(marches.converged(min(chosen.steps) * scene.step)), []
    for step in chosen.steps:
        length = step * scene.step
        under = {name: jv.March(length, marches.transforms(name, chosen.seed)) for name in METHODS}
        drawn = {name: partial(frame, scene, march) for name, march in under.items()}
        seconds = timing.interleaved(drawn, chosen.repetitions)
        for name, march in under.items():
            error = image(march) - truth
            rows.append(
                {
                    "step": step,
                    "march": name,
                    "wood grain": grain(error, length),
                    "boundary noise": boundary_noise(error, face),
                    "rmse": float(np.sqrt(np.mean(error**2))),
                    "rmse off the face": float(np.sqrt(np.mean(error[~face] ** 2))),
                    "seconds": timing.median(seconds[name]),
                    "time": timing.ratio(seconds[name], seconds[marches.PLAIN]),
                }
            )
    return rows


def draw(result: dict[str, Any]) -> Any:
    scenes = {name: rows for name, rows in result.items() if name != "note"}
    figure, axes = charts.panels(len(scenes), len(PANELS), 12, 2.9 * len(scenes))
    for line, (scene, rows) in zip(axes, scenes.items(), strict=True):
        for panel, (key, label) in zip(line, PANELS.items(), strict=True):
            for name, style in METHODS.items():
                by_step = {row["step"]: row[key] for row in rows if row["march"] == name}
                found = [each["median"] if key == "time" else each for each in by_step.values()]
                panel.plot(list(by_step), found, style, marker=".", markersize=6, label=name)
            panel.set(title=label, xlabel="step, voxels", xscale="log")
            if key != "time":
                panel.set_yscale("log", nonpositive="mask")
                charts.plain_numbers(panel)
            charts.numbered(panel, STEPS, [f"{step:g}" for step in STEPS])
        line[0].set_ylabel(scene)
    figure.suptitle(textwrap.fill(result["note"], 120))
    charts.legend_below(figure, axes[0, 0], 5)
    return figure


@experiment(
    repetitions=5,
    size=192,
    resolution=128,
    steps=STEPS,
    quick={"size": 96, "resolution": 64, "repetitions": 1, "steps": (2.3, 1.9)},
)
def main(chosen: Namespace) -> dict[str, Any]:
    result: dict[str, Any] = {"note": NOTE}
    for name, make in {"cut block, orthographic": cut_block, "head, perspective": head}.items():
        result[name] = measure(make(chosen.resolution, chosen.size), chosen)
    return result
