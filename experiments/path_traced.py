"""How near do scatterer templates come to path-traced light, and in what time?

The head phantom, of skin, muscle and bone, lit from the side: path traced, with standard errors; rendered
without light; and rendered with templates under hard and soft occlusion, one for each pixel and blended. Each
image is compared as it is, and multiplied by the factor that brings it nearest to the path-traced one. The
factor would be 1 for templates if they were on the same scale; the unlit image has no scale. The noise of the
reference is recorded, too.
"""

import time
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates

from . import charts, harness, timing
from .harness import experiment


EXPLAINED = (
    "hard, soft: occlusion of templates, of which\none is taken for each pixel; blended: all.\n"
    "error: RMSE of the radiance after the factor\nthat brings the image nearest to the traced one.\n"
    "White is the same radiance in all."
)
"""The text beside the images."""
TRACED, UNLIT = "path traced", "unlit"
LIGHTS = (DirectionalLight((0.9, 0.2, -0.5), (2.0, 2.0, 1.9)), ConstantLight((0.12, 0.12, 0.14)))
MATERIALS = (jv.Material(0.3, 0.06, 1.39, values=(50, 150)), jv.Material(0.2, 0.03, 1.55, values=(150, 256)))
POINTS = [
    (50, (0.85, 0.55, 0.42), 0.0),
    (80, (0.85, 0.55, 0.42), 0.8),
    (120, (0.75, 0.3, 0.25), 0.8),
    (150, (0.7, 0.4, 0.3), 0.8),
    (185, (0.9, 0.88, 0.8), 0.9),
    (255, (0.95, 0.95, 0.92), 0.9),
]
LIGHTINGS: dict[str, dict[str, Any]] = {
    "hard": {"occlusion": "hard"},
    "hard, blended": {"occlusion": "hard", "blend": True},
    "soft": {},
    "soft, blended": {"blend": True},
}
"""Options of the templates."""


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def measure(chosen: Namespace) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The rows of the record, and the images over black."""
    volume = jv.phantom("head", chosen.resolution)
    transfer = jv.TransferFunction.from_points(POINTS, unit_distance=0.05)
    camera = jv.Camera((1.6, -2.6, 1.0), volume.center, (0, 0, 1), 28, size=(chosen.size,) * 2)
    transforms = jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1 / 255)
    march = jv.March(float(volume.spacing.min()) / 2, transforms, "midpoint")

    begun, how = time.perf_counter(), {"paths": chosen.paths, "key": chosen.seed, "materials": MATERIALS}
    traced = jv.path_trace(volume, transfer, camera, LIGHTS, **how)
    reference = np.asarray(traced.radiance)
    seconds = round(time.perf_counter() - begun, 3)
    rows: dict[str, Any] = {TRACED: {"seconds": seconds, "standard error": rms(traced.standard_error)}}
    images = {TRACED: reference}

    def frame(lighting: Any) -> jax.Array:
        return jv.render(volume, transfer, camera, march, lighting=lighting).image((0, 0, 0))

    all_: Any = {"packets": 8, "threshold": 0.008, "reach": (2.0, 4.0, 8.0), "templates": chosen.templates}
    lit = {name: ScattererTemplates(MATERIALS, LIGHTS, **all_, **more) for name, more in LIGHTINGS.items()}
    drawn = {name: partial(frame, lighting) for name, lighting in {UNLIT: None, **lit}.items()}
    taken = timing.interleaved(drawn, chosen.repetitions)
    for name, each in drawn.items():
        image = np.asarray(each())
        scale = float(np.sum(image * reference) / np.sum(image**2))
        images[name] = image * scale
        row = harness.row(taken[name], taken[UNLIT], rms(images[name] - reference))
        rows[name] = {**row, "scale": scale, "rmse as it is": rms(image - reference)}
    return rows, images


def pictures(rows: dict[str, Any], images: dict[str, np.ndarray], path: Path) -> None:
    columns = (len(images) + 1) // 2
    figure, axes = charts.panels(2, columns, 3 * columns, 7.4)
    axes.flat[-1].set_axis_off()
    axes.flat[-1].text(0, 1, EXPLAINED, va="top", fontsize=9, linespacing=1.5, wrap=True)
    white = np.quantile(images[TRACED], 0.995)  # shown as white in all images
    for axis, (name, image) in zip(axes.flat, images.items(), strict=False):
        axis.imshow(jv.to_srgb(np.clip(image / white, 0, 1)))
        row = rows[name]
        caption = (
            f"error {row['rmse']:.3f}, {row['ratio']['median']:.1f} × the time unlit"
            if "rmse" in row
            else f"noise {row['standard error']:.3f}, {row['seconds']:.1f} s with compilation"
        )
        axis.set(title=name, xlabel=caption, xticks=[], yticks=[])
    charts.save(figure, path)


@experiment(
    repetitions=3,
    size=256,
    resolution=96,
    paths=128,
    templates={"type": int, "default": 8, "help": "for each material"},
    quick={"size": 16, "resolution": 16, "paths": 2, "templates": 2, "repetitions": 1},
)
def main(chosen: Namespace) -> dict[str, Any]:
    rows, images = measure(chosen)
    pictures(rows, images, chosen.output / "path_traced.webp")
    return {"rows": rows}
