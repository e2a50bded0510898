"""Kye 2013, Figs. 1 and 9 to 13: scenes under several marches, whole and zoomed, and measures of error."""

from argparse import Namespace
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

import jaxvol as jv
from jaxvol.lighting import Phong
from jaxvol.metrics import boundary_noise, rmse, wood_grain_energy

from ..harness import entered, frame, grain_off, left
from ..marches import BOTH, EMPTY, JITTER, PLAIN, converged, transforms
from ..scenes import AIRWAY, CT_HEAD, OF_AIRWAY, SKIN, Scene, cropped
from . import BLACK, Panel, Panels, panel


METHODS = (PLAIN, JITTER, EMPTY, BOTH)
GREEN = (0.0, 0.8, 0.05)
ENDED = 1 / 255
"""Transmittance at which rays end early."""
METAL = [
    (50, (0.02, 0.03, 0.05), 0.0),
    (90, (0.15, 0.25, 0.40), 0.6),
    (150, (0.45, 0.55, 0.65), 0.9),
    (190, (0.85, 0.45, 0.10), 0.95),
    (240, (1.00, 0.85, 0.45), 0.95),
]
TISSUE = [
    (60, (0.10, 0.02, 0.02), 0.0),
    (120, (0.50, 0.15, 0.10), 0.5),
    (180, (0.90, 0.50, 0.40), 0.8),
    (230, (1.00, 0.80, 0.65), 0.9),
]
CONTRAST = [(60, (0.30, 0.02, 0.02), 0.0), (120, (0.80, 0.20, 0.12), 0.12), (230, (1.00, 0.60, 0.45), 0.25)]
"""Translucent, so that rays reach their exit."""


class View(NamedTuple):
    """A phantom, the part of it that is left, its transfer function, the step in voxels, from where it is
    seen, and the zoom; and the part of the image that is zoomed: by how much, and its centre, as fractions of
    the image's width and height from the top left. Of CT, also what is cut off at the first voxels, what is
    up, the distances of voxels, mm, and the distance to which opacities refer."""

    volume: str
    part: tuple[float, float, float]
    points: list[Any]
    voxels: float
    direction: tuple[float, float, float]
    zoom: tuple[Any, ...]
    factor: float
    middle: tuple[float, float]
    first: tuple[float, float, float] = (0, 0, 0)
    up: tuple[float, float, float] = (0, 0, 1)
    spacing: tuple[float, ...] = ()
    unit: float = 0.03

    def scenes(self, chosen: Namespace) -> dict[str, Scene]:
        if self.spacing:
            volume = jv.load(chosen.data / self.volume, spacing=self.spacing)
        else:
            volume = jv.phantom(self.volume, chosen.resolution)
        volume = cropped(volume, self.first, self.part)
        camera = jv.Camera.looking_at(volume, self.direction, self.up, size=(chosen.size,) * 2)
        camera = camera.zoom(*self.zoom)
        transfer = jv.TransferFunction.from_points(self.points, unit_distance=self.unit)
        whole = Scene(volume, transfer, camera, self.voxels * float(volume.spacing[0]))
        return {"whole": whole, "zoomed": whole._replace(camera=camera.zoom(self.factor, self.middle))}


VIEWS = {
    "head": View("head", (1, 1, 0.62), SKIN, 1.5, (0.5, -1, 0.75), (1.7, (0.52, 0.46)), 3.3, (0.36, 0.48)),
    "heart": View("engine", (0.6, 1, 1), METAL, 2, (1, -0.8, 0.5), (1.4,), 4, (0.55, 0.72)),
    "kidney": View("colon", (1, 1, 0.6), TISSUE, 1.5, (0.4, -0.8, 1), (1.3,), 4, (0.79, 0.43)),
    "vessels": View("vessels", (1, 1, 1), CONTRAST, 2, (0.5, -1, 0.6), (1.5, (0.5, 0.52)), 6, (0.5, 0.84)),
}
"""A head whose crown is cut off, a cut engine, a colon in soft tissue, and vessels whose root is cut."""

CT_SKIN = [
    (500, (0.10, 0.04, 0.03), 0.0),
    (800, (0.85, 0.50, 0.35), 0.7),
    (1150, (0.75, 0.30, 0.22), 0.9),
    (1400, (1.00, 0.95, 0.85), 0.95),
]
ORGANS = [
    (-600, (0.10, 0.02, 0.02), 0.0),
    (-200, (0.70, 0.25, 0.18), 0.5),
    (60, (0.90, 0.50, 0.40), 0.9),
    (250, (1.00, 0.95, 0.85), 0.95),
]
LUNG = [(-700, (0.30, 0.02, 0.02), 0.0), (-300, (0.80, 0.20, 0.12), 0.04), (200, (1.0, 0.6, 0.45), 0.1)]
"""Of CT, in Hounsfield units (of the head, 1000 more); the last is translucent."""
CHEST: dict[str, Any] = {"spacing": OF_AIRWAY, "unit": 1.0}
REAL = {
    "head": View(
        *(CT_HEAD, (1, 1, 1), CT_SKIN, 1.5, (-0.5, -1, -0.75), (1.6,), 3.3, (0.36, 0.3)),
        *((0, 0, 0.2), (0, 0, -1), (1, 1, 2), 1.0),
    ),
    "heart": View(
        *(AIRWAY, (0.93, 1, 0.6), ORGANS, 2, (1, -0.6, 0.4), (1.4,), 3, (0.32, 0.6)),
        first=(0.3, 0.1, 0),
        **CHEST,
    ),
    "kidney": View(
        *(AIRWAY, (0.5, 1, 0.6), ORGANS, 2, (-1, 0.3, 0.5), (1.4,), 3, (0.6, 0.75)),
        first=(0.07, 0.1, 0),
        **CHEST,
    ),
    "vessels": View(
        *(AIRWAY, (0.95, 0.9, 0.6), LUNG, 2, (1, -0.8, 0.5), (1.4,), 4, (0.72, 0.72)),
        first=(0.65, 0.4, 0.15),
        **CHEST,
    ),
}
"""CT in place of that which the paper shows: a head whose crown is cut off; and of a chest, all of whose
faces cut tissue, the heart behind a lung, the liver under a lung, and the vessels of a lung."""
CT = {"head": "CT head", "heart": "CT heart", "kidney": "CT liver", "vessels": "CT lung"}
"""In titles."""


CONDITIONS: dict[str, tuple[Any, Any]] = {
    "unlit": (None, "left"),
    "lit": (Phong(), "left"),
    "pre-integrated": (None, "preintegrated"),
}
"""Lighting and quadrature. The paper shades its samples, and says that its methods serve pre-integration."""


def rendered(scene: Scene, march: jv.March, lighting: Any = None) -> np.ndarray:
    return np.asarray(frame(scene, march, lighting).image(BLACK), np.float64)


Region: TypeAlias = Callable[[Scene], np.ndarray]
"""The pixels of a scene whose boundary noise is measured."""


def comparison(
    view: str, chosen: Namespace, methods: Sequence[str] = METHODS, region: Region = entered
) -> Panels:
    """The view under every method, whole above and zoomed below, with its measures."""
    rows: Panels = []
    for said, seen in views(view, chosen).items():
        whole, zoomed = seen.scenes(chosen).values()
        rows += [compared(whole, methods, region, said), compared(zoomed, methods, region)]
    return rows


def conditions(view: str, chosen: Namespace) -> Panels:
    """The zoomed view lit, and pre-integrated, under every method."""
    return [
        compared(seen.scenes(chosen)["zoomed"], METHODS, entered, f"{said}{condition}, ", condition)
        for condition in list(CONDITIONS)[1:]
        for said, seen in views(view, chosen).items()
    ]


def views(name: str, chosen: Namespace) -> dict[str, View]:
    """The phantom and, where there are real volumes, the CT, by how titles call them."""
    return {"": VIEWS[name], **({f"{CT[name]}, ": REAL[name]} if chosen.data else {})}


def compared(
    scene: Scene, methods: Sequence[str], region: Region, above: str | None = None, condition: str = "unlit"
) -> list[Panel]:
    """A row of panels, a method each, with measures below and, if `above` is given, titles."""
    lighting, quadrature = CONDITIONS[condition]
    truth, mask, row = rendered(scene, converged(scene.step), lighting), region(scene), []
    for method in methods:
        image = rendered(scene, jv.March(scene.step, transforms(method), quadrature), lighting)
        title = "" if above is None else above + method
        row.append(panel(image, measured(image, truth, mask, off=region is entered), title))
    return row


def measured(image: np.ndarray, truth: np.ndarray, region: np.ndarray, off: bool) -> str:
    """Three measures of an image's error, as text. `off`: wood grain is that of blocks without a pixel of the
    region."""
    error = image - truth
    try:
        noise = f"{boundary_noise(error, region):.2g}"
    except ValueError:  # no 3 x 3 pixels of such a face in this image
        noise = "none"
    grain = grain_off(error, region) if off else wood_grain_energy(error)
    return f"wood grain {grain:.2g}\nboundary noise {noise}\nRMSE {rmse(image, truth):.2g}"


def fig13(chosen: Namespace) -> Panels:
    """The pixels that alignment changes, in green."""
    row = []
    for view in (VIEWS["vessels"], *([REAL["vessels"]] if chosen.data else [])):
        side = chosen.size / view.factor
        x, y = (middle * chosen.size - side / 2 for middle in view.middle)
        for name, scene in view.scenes(chosen).items():
            aligned, ended = left(scene), left(scene, jv.EarlyTermination(ENDED), jv.SpaceLeaping())
            march = jv.March(scene.step, transforms(BOTH))
            image = np.where(aligned[..., None], GREEN, rendered(scene, march))
            title = f"{'CT lung' if view.spacing else 'phantom'}, {name}"
            square = (x, y, side) if name == "whole" else None
            shares = f"{aligned.mean():.1%} of the pixels\n{ended.mean():.1%} where rays end early and leap"
            row.append(panel(image, shares, title, square))
    return [row]
