"""Is a transfer function recovered from four views, and do other views agree?

A hidden transfer function of eight points renders four reference images of a volume. Starting from flat grey,
a fit recovers colours and extinction by Levenberg–Marquardt: once at the points of the truth, and once at 32
evenly spaced points, as if nothing were known of the truth. The result is judged by the PSNR of held-out
views.
"""

import warnings
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.metrics import psnr

from . import charts, harness
from .harness import experiment
from .scenes import ENGINE


GOAL = 40.0
SEEN = ((0.65, -1, 0.15), (-1, -0.3, 0.4), (0.2, 1, 0.3), (1, 0.4, -0.5))
HELD_OUT = ((1, -0.2, 0.6), (-0.5, 1, -0.2), (-0.3, -1, -0.6))
KNOWN, EVEN = "points of the truth", "32 even points"
HEAD_POINTS = [
    (0, (0.2, 0.1, 0.1), 0.0),
    (40, (0.4, 0.2, 0.15), 0.0),
    (78, (0.85, 0.5, 0.35), 0.08),
    (100, (0.8, 0.35, 0.25), 0.03),
    (130, (0.7, 0.65, 0.3), 0.05),
    (185, (0.9, 0.85, 0.7), 0.5),
    (225, (0.95, 0.95, 0.9), 0.8),
    (255, (0.8, 0.9, 0.98), 0.9),
]
ENGINE_POINTS = [
    (0, (0.1, 0.1, 0.1), 0.0),
    (50, (0.3, 0.2, 0.2), 0.0),
    (80, (0.6, 0.5, 0.4), 0.01),
    (120, (0.7, 0.55, 0.35), 0.03),
    (150, (0.6, 0.3, 0.2), 0.02),
    (190, (0.2, 0.5, 0.8), 0.2),
    (220, (0.3, 0.6, 0.9), 0.5),
    (255, (0.9, 0.95, 0.98), 0.7),
]

Scene = tuple[jv.Volume, jv.TransferFunction, jv.March]


def _scene(volume: jv.Volume, points: list[Any], unit_distance: float) -> Scene:
    march = jv.March(float(volume.spacing.min()), (jv.AlphaCorrection(),), "midpoint")
    return volume, jv.TransferFunction.from_points(points, unit_distance), march


def engine(folder: Path, resolution: int) -> Scene:
    """Real data, subsampled to about `resolution` voxels along the longest axis."""
    whole = jv.load(folder / ENGINE)
    every = max(whole.shape) // resolution
    data = np.asarray(whole.data)[::every, ::every, ::every]
    return _scene(jv.Volume(data, np.asarray(whole.spacing) * every, whole.origin), ENGINE_POINTS, 4.0)


def measure(scene: Scene, size: int) -> dict[str, Any]:
    """Fits at the points of the truth and at even points: losses, PSNR of fitted and of held-out views."""
    volume, truth, march = scene

    def camera(direction: tuple[float, float, float]) -> jv.Camera:
        return jv.Camera.looking_at(volume, direction, size=(size, size)).zoom(1.3)

    def image(transfer: jv.TransferFunction, view: jv.Camera) -> np.ndarray:
        return np.asarray(jv.render(volume, transfer, view, march).image())

    views = [(camera(direction), image(truth, camera(direction))) for direction in SEEN]
    residual = jv.ImageResidual(lambda transfer, view: (volume, transfer, view, march), views)
    even = jv.flat_grey(volume, 32, (0, 255))
    extinction = np.full(truth.values.shape, float(even.extinction[0]))
    known = jv.TransferFunction(truth.values, np.full((len(extinction), 3), 0.5), extinction)
    rows: dict[str, Any] = {"truth": {k: getattr(truth, k).tolist() for k in ("values", "extinction")}}
    for name, start in ((KNOWN, known), (EVEN, even)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # undetermined colours of transparent points: recorded
            found = jv.fit(residual, start, max_steps=40)
        assert found.uncertainty is not None

        def quality(directions: Any, fitted: jv.TransferFunction = found.parameters) -> list[float]:
            return [psnr(image(fitted, view), image(truth, view)) for view in map(camera, directions)]

        rows[name] = {
            "steps": len(found.losses),
            "message": found.message,
            "losses": found.losses.tolist(),
            "psnr at the start": quality(HELD_OUT, start),
            "psnr seen": quality(SEEN),
            "psnr held out": quality(HELD_OUT),
            "undetermined": found.uncertainty.undetermined,
            "values": start.values.tolist(),
            "extinction": found.parameters.extinction.tolist(),
        }
    return rows


def draw(result: dict[str, Any]) -> Any:
    scenes = result["scenes"]
    figure, axes = charts.panels(len(scenes), 2, 9, 3 * len(scenes))
    for (left, right), (scene, rows) in zip(axes, scenes.items(), strict=True):
        truth = rows["truth"]
        right.plot(truth["values"], truth["extinction"], "k-", linewidth=3, alpha=0.3, label="the truth")
        for name, style in ((KNOWN, "C0.-"), (EVEN, "C3.-")):
            row = rows[name]
            left.plot(range(1, row["steps"] + 1), -10 * np.log10(2 * np.asarray(row["losses"])), style)
            label = f"{name}:\nheld out ≥ {min(row['psnr held out']):.1f} dB"
            right.plot(row["values"], row["extinction"], style, label=label)
        left.axhline(GOAL, color="k", linestyle=":", linewidth=0.8)
        how: dict[str, Any] = {"ha": "right", "va": "top"}
        left.text(0.99, GOAL, f"goal, {GOAL:g} dB", transform=left.get_yaxis_transform(), **how)
        left.set(xlabel="step of the fit", ylabel=f"{scene}\nPSNR of the views seen, dB")
        right.set(xlabel="value", ylabel="extinction, 1/length")
        right.legend()
    return figure


@experiment(size=96, resolution=96, quick={"size": 24, "resolution": 24})
def main(chosen: Namespace) -> dict[str, Any]:
    head = _scene(jv.phantom("head", chosen.resolution), HEAD_POINTS, 0.1)
    folder, scenes = harness.data(), {"head phantom": measure(head, chosen.size)}
    if folder is not None and not chosen.quick:
        scenes["engine"] = measure(engine(folder, chosen.resolution), chosen.size)
    return {"goal": GOAL, "scenes": scenes}
