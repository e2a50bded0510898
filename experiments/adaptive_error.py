"""Does adaptive sampling keep its tolerance, is its estimate of a pixel's error right, and does jitter still
break wood grain?

Five scenes, each from outside and from its widest empty place, at five tolerances. Compared with an image of
32 steps a voxel without early termination are the RMSE over white, relative to the tolerance, and each
pixel's error (root mean square of its channels), relative to `Rendering.error`: in four classes of equally
many pixels by estimate, and the share of pixels whose error is at most the estimate. The energy of what is
periodic in the error (`metrics.wood_grain_energy`) is measured without jitter and with `EmptySpaceJitter`;
it may come out slightly negative where there is none.
"""

from argparse import Namespace
from typing import Any

import numpy as np

import jaxvol as jv
from jaxvol.metrics import rmse, wood_grain_energy

from . import charts, programs
from .harness import chosen_scenes, experiment, frame, some_of
from .programs import FINEST_OF, LEFT, LONGEST
from .scenes import PHANTOM, SCENES, Scene, inside


FINER = 32


def measure(scene: Scene) -> dict[str, dict[str, Any]]:
    """By tolerance: what an image of this scene errs by, and what was estimated."""
    truth = programs.converged(scene, FINER)
    found = {}
    for tolerance, finest in FINEST_OF.items():
        sampling = jv.AdaptiveSampling(tolerance, LONGEST * finest)
        transforms = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(LEFT), sampling
        rendering, jittered = (
            frame(scene, jv.March(scene.step / finest, (*jitter, *transforms), "midpoint"))
            for jitter in ((), (jv.EmptySpaceJitter(1),))
        )
        error = np.sqrt(np.mean((np.asarray(rendering.image()) - truth) ** 2, axis=-1))
        known = np.asarray(rendering.error) > 0
        error, estimate = error[known], np.asarray(rendering.error)[known]
        classes = np.digitize(estimate, np.quantile(estimate, (0.25, 0.5, 0.75)))
        found[str(tolerance)] = {
            "rmse over tolerance": rmse(rendering.image(), truth) / tolerance,
            "samples": float(np.mean(rendering.samples)),
            "structured energy": wood_grain_energy(rendering.image() - truth),
            "structured energy, jittered": wood_grain_energy(jittered.image() - truth),
            "estimate": [_root(estimate[classes == k]) for k in range(4)],
            "error": [_root(error[classes == k]) for k in range(4)],
            "share below the estimate": float(np.mean(error <= estimate)),
        }
    return found


def _root(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def summary(scenes: dict[str, Any]) -> dict[str, Any]:
    """How many images keep their tolerance; and the largest part that jitter leaves of errors of which more
    than a hundredth is structured."""
    rows = [(float(t), row) for views in scenes.values() for of in views.values() for t, row in of.items()]
    left = [
        row["structured energy, jittered"] / row["structured energy"]
        for tolerance, row in rows
        if row["structured energy"] > 3 * (row["rmse over tolerance"] * tolerance) ** 2 / 100
    ]
    return {
        "images": len(rows),
        "within the tolerance": sum(row["rmse over tolerance"] <= 1 for _, row in rows),
        "images with structured errors": len(left),
        "of which jitter leaves at most": max(left, default=None),
    }


def draw(result: dict[str, Any]) -> Any:
    """Estimated against true errors of pixels, and the error of images over the tolerance."""
    figure, ((pixels, images),) = charts.panels(1, 2, 11, 4.6)
    for number, (name, views) in enumerate(result["scenes"].items()):
        for view, mark in (("outside", "o"), ("inside", "s")):
            rows, color = views[view], f"C{number}"
            for row in rows.values():
                pixels.plot(row["estimate"], row["error"], mark, color=color, alpha=0.7)
            ratios = [row["rmse over tolerance"] for row in rows.values()]
            how: dict[str, Any] = {"color": color, "linewidth": 1, "label": f"{name}, {view}"}
            images.plot([float(t) for t in rows], ratios, mark + "-", **how)
    pixels.set(xscale="log", yscale="log", xlabel="estimated error of a pixel (Rendering.error)")
    pixels.set(ylabel="true error, root mean square")
    pixels.axline((1e-3, 1e-3), (1e-2, 1e-2), color="k", linewidth=0.8, label="as estimated")
    pixels.set_title("below the line: estimates on the safe side (a point: a quarter of an image)")
    pixels.legend(loc="upper left")
    images.axhline(1, color="k", linewidth=0.8)
    images.set(xscale="log", xlabel="tolerance", ylabel="RMSE of the image / tolerance", ylim=(0, 1.5))
    images.set_title("below 1: within the tolerance")
    images.legend(fontsize=7, ncols=2)
    charts.plain_numbers(pixels)
    charts.plain_numbers(images)
    return figure


@experiment(size=256, resolution=256, only=some_of(SCENES, "VOLUME"), quick={"size": 32, "resolution": 32})
def main(chosen: Namespace) -> dict[str, Any]:
    scenes = {
        name: {"outside": measure(scene), "inside": measure(inside(scene))}
        for name, scene in chosen_scenes(chosen, SCENES, PHANTOM, chosen.size)
    }
    return {"summary": summary(scenes), "scenes": scenes}
