"""The scenes that are measured: four real volumes and the head phantom, with steps of one voxel, "a size like
that of the voxels" (Kye 2013, section 2.1)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import jaxvol as jv


class Scene(NamedTuple):
    volume: jv.Volume
    transfer: jv.TransferFunction
    camera: jv.Camera
    step: float


VESSELS = [
    (60, (0.25, 0.02, 0.02), 0.0),
    (90, (0.60, 0.08, 0.05), 0.25),
    (160, (0.95, 0.55, 0.40), 0.7),
    (255, (1.00, 0.95, 0.85), 0.9),
]
"""For contrast agent in 8-bit angiography: shows the vessels alone."""

SKIN = [
    (40, (0.10, 0.04, 0.03), 0.0),
    (78, (0.85, 0.50, 0.35), 0.9),
    (100, (0.75, 0.30, 0.22), 0.9),
    (130, (0.90, 0.75, 0.60), 0.9),
    (185, (1.00, 0.95, 0.85), 0.95),
    (255, (1.00, 1.00, 1.00), 0.95),
]
"""For the head phantom under opaque skin: everything but air is nearly opaque."""


def head(folder: Path | None, size: int, resolution: int = 192) -> Scene:
    return seen_head(jv.phantom("head", resolution), size)


def seen_head(volume: jv.Volume, size: int) -> Scene:
    """The scene of the head phantom, from a volume that was made or read elsewhere."""
    camera = jv.Camera.looking_at(volume, (0.65, -1, 0.15), size=(size, size)).zoom(1.45)
    return Scene(volume, jv.preset("head", unit_distance=0.01), camera, float(volume.spacing[0]))


def skin_head(size: int, resolution: int) -> Scene:
    """The head phantom under skin that light can enter; steps of half a voxel."""
    volume = jv.phantom("head", resolution)
    transfer = jv.TransferFunction.from_points(SKIN, unit_distance=0.05)
    camera = jv.Camera.looking_at(volume, (0.65, -1, 0.15), size=(size, size)).zoom(2)
    return Scene(volume, transfer, camera, float(volume.spacing[0]) / 2)


ENGINE, BONSAI, AIRWAY, ANEURISM = (
    "engine_256x256x128_uint8.raw.gz",
    "bonsai_256x256x256_uint8.raw.gz",
    "lidc0314_airway_256x192x200_int16le.raw.gz",
    "aneurism_256x256x256_uint8.raw.gz",
)
CT_HEAD = "cthead_256x256x113_uint16le.raw.gz"
WHOLE_VOXELS, OF_AIRWAY = (1.0, 1.0, 1.0), (0.78125, 0.78125, 1.0)
"""Spacings."""


def real(
    file: str, transfer: Any, view: Any, up: Any, zoom: float, spacing: tuple[float, ...] = WHOLE_VOXELS
) -> Callable[..., Scene]:
    """Makes the scene of a real volume. `transfer`: name of a preset, or points."""

    def make(folder: Path, size: int, resolution: int = 0) -> Scene:
        volume = jv.load(folder / file, spacing=spacing)
        function = (
            jv.preset(transfer) if isinstance(transfer, str) else jv.TransferFunction.from_points(transfer)
        )
        camera = jv.Camera.looking_at(volume, view, up, size=(size, size)).zoom(zoom)
        return Scene(volume, function, camera, spacing[0])

    return make


engine = real(ENGINE, "engine", (0.6, -0.9, -0.7), (0, 0, -1), 1.4)
PHANTOM = "head phantom"
SCENES: dict[str, Callable[..., Scene]] = {
    PHANTOM: head,
    "engine": engine,
    "bonsai": real(BONSAI, "bonsai", (0.3, 1, 0.3), (0, 0, 1), 1.3),
    # a part of a chest CT whose faces all cut tissue, seen from outside
    "lidc0314_airway": real(AIRWAY, "ct_chest", (0.4, -1, 0.5), (0, 0, 1), 1.3, OF_AIRWAY),
    "aneurism": real(ANEURISM, VESSELS, (0.5, -1, 0.4), (0, 0, 1), 1.3),
}


def translucent(low: float, high: float) -> list[tuple[Any, ...]]:
    """Points from transparent to opaque between two values."""
    middle = (low + high) / 2
    return [(low, (0.3, 0.1, 0.1), 0.0), (middle, (0.9, 0.6, 0.4), 0.05), (high, (1.0, 1.0, 1.0), 0.8)]


UNTUNED: dict[str, Callable[..., Scene]] = {
    "tooth": real("tooth_103x94x161_uint8.raw", translucent(90, 230), (0.5, 1, 0.3), (0, 0, 1), 1.3),
    "studyforrest_t1": real(
        "studyforrest_t1_137x192x192_int16le.raw.gz", translucent(10, 80), (1, 0.4, 0.3), (0, 0, 1), 1.2
    ),
    "cthead": real(CT_HEAD, translucent(500, 1600), (0.4, -1, 0.2), (0, 0, 1), 1.2),
    "us_aplio_convex": real(
        "us_aplio_convex_239x128x91_uint8.raw.gz", translucent(60, 200), (0.3, 0.5, 1), (0, 1, 0), 1.2
    ),
}
"""Scenes to which nothing was ever fitted, for which nothing else is measured than whether commits differ."""


def grid(side: int) -> tuple[np.ndarray, ...]:
    """x, y and z of the nodes of [-1, 1]³."""
    return tuple(np.meshgrid(*[np.linspace(-1, 1, side)] * 3, indexing="ij"))


def on_cube(data: np.ndarray, *labels: Any, field: Any = None) -> jv.Volume:
    """Values at the nodes of [-1, 1]³."""
    return jv.Volume(data, (2 / (len(data) - 1),) * 3, (-1.0,) * 3, *labels, field=field)


def cropped(volume: jv.Volume, low: tuple[float, ...], high: tuple[float, ...]) -> jv.Volume:
    """The part of a volume between two corners, given as fractions of its sides."""
    first, last = (
        [int(part * n) for part, n in zip(corner, volume.shape, strict=True)] for corner in (low, high)
    )
    part = np.asarray(volume.data)[tuple(map(slice, first, last))]
    origin = np.asarray(volume.origin) + np.array(first) * np.asarray(volume.spacing)
    return jv.Volume(part, volume.spacing, origin)


def cut(make: Callable[..., Scene], low: Any, high: Any, *zoom: Any) -> Callable[..., Scene]:
    """Makes the scene with only the part of the volume between two corners (`cropped`), and a part of the
    image enlarged (`jv.Camera.zoom`)."""

    def made(folder: Path | None, size: int, resolution: int = 0) -> Scene:
        scene = make(folder, size, resolution)
        return scene._replace(volume=cropped(scene.volume, low, high), camera=scene.camera.zoom(*zoom))

    return made


def inside(scene: Scene) -> Scene:
    """The scene seen from its widest empty place, towards what is visible."""
    from scipy.ndimage import distance_transform_edt  # not at the top: the first image of a process is timed

    volume, transfer = scene.volume, scene.transfer
    data, spacing = np.asarray(volume.data, np.float64), np.asarray(volume.spacing, np.float64)
    extinction = np.interp(data, np.asarray(transfer.values), np.asarray(transfer.extinction))
    away = np.asarray(distance_transform_edt(extinction <= 0, sampling=spacing))
    middle = np.zeros(data.shape, bool)
    middle[tuple(slice(n // 4, -(-3 * n // 4)) for n in data.shape)] = True
    place = np.unravel_index(np.argmax(np.where(middle, away, -1)), data.shape)
    origin = np.asarray(volume.origin, np.float64)
    target = origin + spacing * np.argwhere(extinction > 0).mean(axis=0)
    camera = jv.Camera(origin + spacing * place, target, (0.1, 0.2, 1.0), 75.0, size=scene.camera.size)
    return scene._replace(camera=camera)


def peaked(scene: Scene) -> Scene:
    """The scene under a peak 1 % as wide as the range of its voxels, where it becomes opaque."""
    extinction, values = np.asarray(scene.transfer.extinction), np.asarray(scene.transfer.values)
    data = np.asarray(scene.volume.data)
    spread = float(data.max()) - float(data.min())
    first = int(np.argmax(extinction >= extinction.max() / 2))
    middle, half = float(values[first]), 0.005 * spread
    points = middle + half * np.array([-2, -1, 0, 1, 2])
    colors = np.full((5, 3), (0.9, 0.6, 0.3))
    # a layer of one voxel at the peak lets through 2 %
    return scene._replace(transfer=jv.TransferFunction(points, colors, [0, 0, 4 / scene.step, 0, 0]))
