"""How near do templates by transport come to path-traced light, beside the published form, and in what time?

A ball of one material, the head phantom of flesh and bone, and CT of an engine of two metals, each thin and
thick in mean free paths. Rays of the camera meet the extinction of the materials, 1/λ, so that `path_trace`
and `render` show the same medium; lights, camera and colours are the same. The published form has no scale of
its own (the paper gives none), so that its image is also compared after the factor that brings it nearest;
images by transport are compared as they are. Errors are the mean product of the differences from two
references of other paths, which leaves out the references' own noise. Times are those of a frame whose light
was computed for the frame before, as multiples of the unlit frame. The engine is read from the folder
JAXVOL_DATA, and is left out without it.
"""

from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates

from . import charts, harness, timing
from .harness import experiment
from .mean_free_path import COLOR, RADIUS, balls
from .scenes import SCENES


SUN, SKY = (2.0, 2.0, 1.9), (0.15, 0.15, 0.17)
FLESH, BONE = (0.75, 0.35, 0.27), (0.9, 0.88, 0.8)
IRON, STEEL = (0.6, 0.65, 0.75), (0.9, 0.75, 0.5)
TRACED, UNLIT = "path traced", "unlit"
FORMS: dict[str, dict[str, Any]] = {
    "published, hard": {"occlusion": "hard"},
    "published, soft": {"blend": True},
    "transport, 32 nodes": {"form": "transport", "nodes": 32},
    "transport, 48 nodes": {"form": "transport"},
    "transport, 64 nodes": {"form": "transport", "nodes": 64},
}
"""Options of the templates."""


def medium(
    layers: Sequence[tuple[float, float, Any, float, float]],
) -> tuple[jv.TransferFunction, tuple[jv.Material, ...]]:
    """A transfer function of steps, and the materials that it shows: low and high value, colour, mean free
    path and opacity of each."""
    points, materials = [], []
    for low, high, color, path, opacity in layers:
        points += [(low, color, 1 / path), (high, color, 1 / path)]
        materials.append(jv.Material(opacity, path, values=(low, high)))
    first = points[0]
    values, colors, extinction = zip((first[0], first[1], 0.0), *points, strict=True)
    return jv.TransferFunction(values, colors, extinction), tuple(materials)


def ball(chosen: Namespace, thin: bool) -> tuple[Any, ...]:
    volume = balls(chosen.resolution, [(200, (0, 0, 0), RADIUS)])
    path = 2 * RADIUS / (1 if thin else 8)
    camera = jv.Camera((0, -4, 1), (0, 0, 0), (0, 0, 1), 32, size=(chosen.size,) * 2)
    return volume, *medium([(60, 256, COLOR, path, 0.2)]), camera, (0.8, 0.5, -0.6)


def head(chosen: Namespace, thin: bool) -> tuple[Any, ...]:
    volume, times = jv.phantom("head", chosen.resolution), 8 if thin else 1
    camera = jv.Camera((1.6, -2.6, 1.0), volume.center, (0, 0, 1), 28, size=(chosen.size,) * 2)
    layers = [(50, 150, FLESH, 0.06 * times, 0.3), (150, 256, BONE, 0.04 * times, 0.2)]
    return volume, *medium(layers), camera, (0.9, 0.2, -0.5)


def engine(chosen: Namespace, thin: bool) -> tuple[Any, ...]:
    volume, _, camera, *_ = SCENES["engine"](harness.data(), chosen.size)
    voxels = float(volume.spacing.min()) * (40 if thin else 5)
    layers = [(80, 150, IRON, voxels, 0.25), (150, 256, STEEL, 0.6 * voxels, 0.15)]
    return volume, *medium(layers), camera, (0.3, 0.4, 1.0)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values, float)))))


def measure(scene: tuple[Any, ...], chosen: Namespace) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The rows of a scene, and its images over black, as they are."""
    volume, transfer, materials, camera, direction = scene
    lights = DirectionalLight(direction, SUN), ConstantLight(SKY)
    transforms = jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1e-3)
    march = jv.March(float(volume.spacing.min()) / 4, transforms, "midpoint")
    traced = partial(jv.path_trace, volume, transfer, camera, lights, paths=chosen.paths, materials=materials)
    one, other = (np.asarray(traced(key=2 * chosen.seed + i).radiance) for i in range(2))
    reference = (one + other) / 2
    noise, level = rms(one - other) / 2, float(reference.mean())
    rows: dict[str, Any] = {TRACED: {"mean radiance": level, "noise / mean": noise / level}}
    images = {TRACED: reference}

    def error(image: np.ndarray) -> float:
        """Root mean squared, over the mean."""
        return float(np.sqrt(max(0, np.mean((image - one) * (image - other))))) / level

    def frame(lighting: Any) -> jax.Array:
        return jv.render(volume, transfer, camera, march, lighting=lighting).image((0, 0, 0))

    for name, how in FORMS.items():
        lighting = ScattererTemplates(materials, lights, **how)
        programs = {name: partial(frame, lighting), UNLIT: partial(frame, None)}
        taken = timing.interleaved(programs, chosen.repetitions)
        image = np.asarray(frame(lighting))
        images[name], channels = image, image.mean((0, 1)) / reference.mean((0, 1))
        scale = float(np.sum(image * reference) / np.sum(image**2))
        rows[name] = {
            "mean / traced": float(image.mean() / level),
            "by channel": channels.tolist(),
            "rmse / mean": error(image),
            "best scale": scale,
            "rmse / mean at best scale": error(scale * image),
            "time / unlit": timing.ratio(taken[name], taken[UNLIT]),
        }
        print(name, rows[name], flush=True)
    return rows, images


def pictures(found: dict[str, dict[str, np.ndarray]], rows: dict[str, Any], path: Path) -> None:
    shown = [TRACED, "transport, 48 nodes", "published, soft", "published, hard"]
    figure, axes = charts.panels(len(found), len(shown), 2.5 * len(shown), 2.8 * len(found))
    for line, (scene, images) in zip(axes, found.items(), strict=True):
        white = np.quantile(images[TRACED], 0.998)
        for axis, name in zip(line, shown, strict=True):
            row = rows[scene][name]
            scale = row["best scale"] if name.startswith("published") else 1.0
            axis.imshow(jv.to_srgb(np.clip(scale * images[name] / white, 0, 1)))
            error = "rmse / mean" + " at best scale" * name.startswith("published")
            caption = (
                f"noise {row['noise / mean']:.2f}"
                if name == TRACED
                else f"error {row[error]:.2f}, × {scale:.2f}"
            )
            axis.set(title=f"{scene}: {name}", xlabel=caption, xticks=[], yticks=[])
            axis.title.set_fontsize(8)
    charts.save(figure, path)


@experiment(
    repetitions=5,
    size=128,
    resolution=64,
    paths=256,
    quick={"size": 12, "resolution": 16, "paths": 2, "repetitions": 1},
)
def main(chosen: Namespace) -> dict[str, Any]:
    scenes = {"ball": ball, "head phantom": head}
    if harness.data() and not chosen.quick:
        scenes["engine"] = engine
    rows, images = {}, {}
    for name, scene in scenes.items():
        for thin in (True, False):
            label = f"{name}, {'thin' if thin else 'thick'}"
            print(label, flush=True)
            rows[label], images[label] = measure(scene(chosen, thin), chosen)
    pictures(images, rows, chosen.output / "transport.webp")
    return {"rows": rows}
