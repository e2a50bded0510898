"""One scene after another under each kind of light: as it emits, shaded by its gradients, lit by scatterer
templates, and path traced. The defaults are phantoms; `--data` draws CT of an engine, a bonsai, a head and a
chest, and a frog's labels.

The path-traced medium is the transfer function's own: its extinction, and its colours as albedo. Templates
take one or two materials for the same values. Both have the same lights, and an exposure each: white is what
1 % of the pixels that show something exceed. Emission and Phong's shading have no unit of light; they are
shown as they are.
"""

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.ndimage import gaussian_filter

import jaxvol as jv
from experiments.lighting import march
from experiments.scenes import SCENES, Scene
from jaxvol.lighting import ConstantLight, DirectionalLight, HeadLight, Phong, ScattererTemplates

from . import lee_fig6
from .common import BLACK, Page, figure
from .lee_fig6 import Subject


PATHS = 48
TEMPLATES = {"templates": 8, "blend": True, "reach": (2, 4, 8)}


def matter(scene: Scene, opacity: float, free_path: float, light: tuple[float, float, float]) -> Subject:
    """A scene of one material. `free_path`: in voxels."""
    voxel = float(scene.volume.spacing.min())
    return Subject(scene, [jv.Material(opacity, free_path * voxel, 1.4)], light)


def frog(folder: Path, size: int) -> Subject:
    """The labels of a frog's tissues: a translucent body, the organs opaque."""
    labelled = jv.load(folder / "frogtissue.mhd")
    labels = np.asarray(labelled.data).astype(np.int32)
    labels[labels > 15] = 0
    smooth = gaussian_filter(255.0 * (labels > 0), 1.0).astype(np.uint8)
    volume = jv.Volume(smooth, labelled.spacing, labelled.origin, labels=labels)
    voxel = float(volume.spacing.min())
    colors = jv.colormap("tab20", (0, 20)).colors

    def function(color: object, opacity: float) -> jv.TransferFunction:
        points = [(60, color, 0.0), (140, color, opacity), (255, color, opacity)]
        return jv.TransferFunction.from_points(points, unit_distance=2 * voxel)

    functions = [None, *(function(tuple(colors[3 * n % len(colors)]), 0.8) for n in range(1, 16))]
    camera = jv.Camera.looking_at(volume, (0.2, 0.3, -1), (0, -1, 0), size=(size, size)).zoom(1.3)
    transfer = cast(Any, jv.LabelTransferFunction(functions))  # Scene: for VTK and Dr.Jit, not used here
    scene = Scene(volume, transfer, camera, voxel / 2)
    return matter(scene, 0.3, 3, (0.7, 0.6, 0.7))


def upright(scene: Scene) -> Scene:
    """The same view with up and down exchanged."""
    return scene._replace(camera=replace(scene.camera, view_up=-scene.camera.view_up))


def subjects(folder: Path | None, resolution: int, size: int) -> dict[str, Callable[[], Subject]]:
    if folder is None:
        return {
            "the head phantom": lambda: lee_fig6.head(resolution, size),
            "a frog phantom": lambda: lee_fig6.frog(resolution, size),
        }
    return {
        "an engine (CT)": lambda: matter(SCENES["engine"](folder, size), 0.3, 2, (-0.3, 0.9, 0.8)),
        "a bonsai (CT)": lambda: matter(upright(SCENES["bonsai"](folder, size)), 0.3, 2, (0.6, -0.9, -0.7)),
        "a head (CT)": lambda: lee_fig6.real(folder, size),
        "a chest (CT)": lambda: matter(SCENES["lidc0314_airway"](folder, size), 0.3, 2, (0.6, 0.9, -0.7)),
        "a frog (labels)": lambda: frog(folder, size),
    }


def exposed(image: Any) -> np.ndarray:
    """An image with its own white."""
    image = np.asarray(image)
    bright = image.max(-1)
    seen = bright > 0.01 * bright.max()
    return image / np.quantile(bright[seen], 0.99) if np.any(seen) else image


def draw(page: Page, row: int, name: str, subject: Subject, paths: int) -> None:
    scene, materials, direction = subject
    lights = DirectionalLight(direction, (3.0, 3.0, 3.0)), ConstantLight((0.3, 0.3, 0.3))
    traced = jv.path_trace(*scene[:3], lights, paths=paths)
    shaded = Phong((HeadLight((0.4, 0.4, 0.4)), DirectionalLight(direction)))
    templates = ScattererTemplates(tuple(materials), lights, **TEMPLATES)
    how = march(scene)
    how = replace(how, quadrature="midpoint")
    emitted, phong, lit = (
        jv.render(*scene[:3], how, lighting=each, outputs="rgba").image(BLACK)
        for each in (None, shaded, templates)
    )
    columns = {
        "unlit": emitted,
        "Phong": phong,
        "scatterer templates": exposed(lit),
        "path traced": exposed(traced.radiance),
    }
    for column, (title, image) in enumerate(columns.items()):
        page.draw(row, column, np.clip(image, 0, 1), name if column == 0 else "", title if row == 0 else "")


@figure(__doc__, resolution=128, size=256)
def main(chosen: Namespace) -> None:
    each = subjects(chosen.data, chosen.resolution, chosen.size)
    page = Page(4, len(each), chosen.size, "Kinds of light")
    for row, (name, make) in enumerate(each.items()):
        draw(page, row, name, make(), 4 if chosen.quick else PATHS)
    page.save(chosen.output / "gallery.webp")


if __name__ == "__main__":
    main()
