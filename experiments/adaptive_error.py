"""Does adaptive sampling keep its tolerance, is its estimate of a pixel's error right, and does jitter still
break wood grain?

Five scenes, each from outside and from inside (the camera stands in the widest empty place of the volume's
middle), at five tolerances. Compared with an image of 32 steps a voxel without early termination are the RMSE
over white, relative to the tolerance, and each pixel's error (root mean square of its channels), relative to
`Rendering.error`: in four classes of equally many pixels by estimate, and the share of pixels whose error is
at most the estimate. Strides change from ray to ray: the energy of what is periodic in the error
(`metrics.wood_grain_energy`) is measured without jitter and with `EmptySpaceJitter`; it may come out slightly
negative where there is none.

Wood grain: the inclined plane of `jitter_accuracy`, whose rings have a known frequency, at a step of 1.3
voxels; energy of the rings of cells of one and of two steps, with adaptive sampling and without, each with
`EmptySpaceJitter` and without.
"""

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

import jaxvol as jv
from jaxvol.metrics import rmse, wood_grain_energy

from . import common, jitter_accuracy, marches
from .accuracy import FINEST_OF, LONGEST
from .common import plt
from .scenes import PHANTOM, SCENES, Scene


FINER = 32
OPACITY_LEFT = 1e-4
GRAIN_STEP, GRAIN_STRIDES = 1.3, (1, 2)
GRAIN_TOLERANCES = (1e-1, 3e-2, 1e-2)


def inside(scene: Scene, size: int) -> Scene:
    """The scene seen from its widest empty place, towards what is visible."""
    volume, transfer = scene.volume, scene.transfer
    data, spacing = np.asarray(volume.data, np.float64), np.asarray(volume.spacing, np.float64)
    extinction = np.interp(data, np.asarray(transfer.values), np.asarray(transfer.extinction))
    away = np.asarray(distance_transform_edt(extinction <= 0, sampling=spacing))
    middle = np.zeros(data.shape, bool)
    middle[tuple(slice(n // 4, -(-3 * n // 4)) for n in data.shape)] = True
    place = np.unravel_index(np.argmax(np.where(middle, away, -1)), data.shape)
    origin = np.asarray(volume.origin, np.float64)
    target = origin + spacing * np.argwhere(extinction > 0).mean(axis=0)
    camera = jv.Camera(origin + spacing * place, target, (0.1, 0.2, 1.0), 75.0, size=(size, size))
    return scene._replace(camera=camera)


def measure(scene: Scene) -> dict[str, dict[str, Any]]:
    """By tolerance: what an image of this scene errs by, and what was estimated."""
    volume, transfer, camera, step = scene
    exact = jv.March(step / FINER, (jv.AlphaCorrection(), jv.SpaceLeaping()), "midpoint")
    truth = np.asarray(jv.render(volume, transfer, camera, exact).image())
    found = {}
    for tolerance, finest in FINEST_OF.items():
        sampling = jv.AdaptiveSampling(tolerance, LONGEST * finest)
        transforms = jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(OPACITY_LEFT), sampling
        rendering, jittered = (
            jv.render(volume, transfer, camera, jv.March(step / finest, (*jitter, *transforms), "midpoint"))
            for jitter in ((), (jv.EmptySpaceJitter(1),))
        )
        error = np.sqrt(np.mean((np.asarray(rendering.image()) - truth) ** 2, axis=-1))
        estimate = np.asarray(rendering.error)
        known = estimate > 0
        error_, estimate_ = error[known], estimate[known]
        classes = np.digitize(estimate_, np.quantile(estimate_, (0.25, 0.5, 0.75)))
        found[str(tolerance)] = {
            "rmse over tolerance": rmse(rendering.image(), truth) / tolerance,
            "samples": float(np.mean(rendering.samples)),
            "structured energy": wood_grain_energy(rendering.image() - truth),
            "structured energy, jittered": wood_grain_energy(jittered.image() - truth),
            "estimate": [_root(estimate_[classes == k]) for k in range(4)],
            "error": [_root(error_[classes == k]) for k in range(4)],
            "share below the estimate": float(np.mean(error_ <= estimate_)),
        }
    return found


def _root(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def structured(scenes: dict[str, Any]) -> dict[str, Any]:
    """Of the images in which more than a hundredth of the error is structured: how many there are, and the
    largest part of it that jitter leaves."""
    parts = []
    for views in scenes.values():
        for of in views.values():
            for tolerance, row in of.items():
                energy = 3 * (row["rmse over tolerance"] * float(tolerance)) ** 2
                if row["structured energy"] > energy / 100:
                    parts.append(row["structured energy, jittered"] / row["structured energy"])
    return {"images with structured errors": len(parts), "of which jitter leaves at most": max(parts)}


def grain(resolution: int, size: int) -> dict[str, dict[str, float]]:
    """By march and length of cells, in steps: the energy of their rings."""
    scene = jitter_accuracy.cut_block(resolution, size)
    voxel = float(scene.volume.spacing[0])
    step = GRAIN_STEP * voxel

    def image(march: jv.March) -> np.ndarray:
        return np.asarray(jv.render(scene.volume, scene.transfer, scene.camera, march).rgba[..., :3], float)

    truth = image(marches.converged(0.3 * voxel))
    adaptive = {f", tolerance {t:g}": (jv.AdaptiveSampling(t),) for t in GRAIN_TOLERANCES}
    return {
        f"{name}{more}": {
            str(k): scene.grain(image(jv.March(step, (*jitter, *sampling))) - truth, step * k)
            for k in GRAIN_STRIDES
        }
        for more, sampling in {"": (), **adaptive}.items()
        for name, jitter in (("plain", ()), ("empty-space jitter", (jv.EmptySpaceJitter(1),)))
    }


def draw(result: dict[str, Any], path: Path) -> None:
    """Estimated against true errors of pixels, and the error of images over the tolerance."""
    figure, (pixels, images) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    for number, (name, views) in enumerate(result["scenes"].items()):
        for view, mark in (("outside", "o"), ("inside", "s")):
            rows, color = views[view], f"C{number}"
            for row in rows.values():
                pixels.plot(row["estimate"], row["error"], mark, color=color, markersize=4, alpha=0.7)
            ratios = [row["rmse over tolerance"] for row in rows.values()]
            style: dict[str, Any] = {"color": color, "markersize": 4, "linewidth": 1}
            images.plot([float(t) for t in rows], ratios, mark + "-", label=f"{name}, {view}", **style)
    pixels.set_xscale("log")
    pixels.set_yscale("log")
    limits = pixels.get_xlim()
    pixels.plot(limits, limits, "k-", linewidth=0.8, label="as estimated")
    pixels.legend(fontsize=7, loc="upper left")
    pixels.set_xlim(limits)
    pixels.set_xlabel("estimated error of a pixel (Rendering.error)")
    pixels.set_ylabel("true error, root mean square")
    pixels.set_title(
        "below the line: estimates on the safe side (a point: a quarter of an image)", fontsize=9
    )
    images.set_title("below 1: within the tolerance", fontsize=9)
    images.axhline(1, color="k", linewidth=0.8)
    images.set_xscale("log")
    images.set_xlabel("tolerance")
    images.set_ylabel("RMSE of the image / tolerance")
    images.set_ylim(0, 1.5)
    images.legend(fontsize=7, ncols=2)
    for panel in (pixels, images):
        common.plain_numbers(panel)
    common.save(figure, path)


@common.experiment(
    "adaptive_error",
    "Does adaptive sampling keep its tolerance, and is its estimate of the error right?",
    __doc__,
    size=256,
    only=common.some_of(SCENES, "VOLUME"),
)
def main(chosen: Namespace) -> common.Answer:
    folder, names = common.available(chosen, PHANTOM)
    more: dict[str, Any] = {"resolution": 256}
    block = 96, 448
    if chosen.quick:
        chosen.size, more, block = 32, {"resolution": 32}, (48, 256)
    scenes: dict[str, Any] = {}
    make: Callable[..., Scene]
    for name in names:
        make = SCENES[name]
        scene = make(folder, chosen.size, **(more if name == PHANTOM else {}))
        scenes[name] = {"outside": measure(scene), "inside": measure(inside(scene, chosen.size))}
        print(name, scenes[name], flush=True)
    rows = [row for views in scenes.values() for of in views.values() for row in of.values()]
    ratios = [row["rmse over tolerance"] for row in rows]
    result = {
        "pixels": chosen.size,
        "summary": {
            "images": len(rows),
            "within the tolerance": int(np.sum(np.array(ratios) <= 1)),
            "largest error over tolerance": max(ratios),
            "smallest share of pixels below the estimate": min(
                row["share below the estimate"] for row in rows
            ),
            **structured(scenes),
        },
        "scenes": scenes,
        "wood grain": grain(*block),
    }
    print(result["summary"], result["wood grain"])
    return result, partial(draw, result)


if __name__ == "__main__":
    main()
