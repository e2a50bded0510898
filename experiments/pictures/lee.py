"""Pictures of scatterer templates (Lee, Kwon and Shin 2016, Figs. 4 to 6), and a gallery of all light."""

from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.ndimage import gaussian_filter

import jaxvol as jv
from jaxvol.io.phantoms.canvas import FAR, Canvas
from jaxvol.io.phantoms.shapes import Shape, capsule, ellipsoid, tube
from jaxvol.lighting import ConstantLight, DirectionalLight, HeadLight, Lighting, Phong, ScattererTemplates
from jaxvol.metrics import boundary_noise

from ..lighting import FLESH, UNLIT, march
from ..scenes import CT_HEAD, SCENES, Scene, cropped, grid, on_cube, skin_head
from . import BLACK, Panel, Panels, panel


Color = tuple[float, float, float]
REACH = (2, 4, 8)
"""Photons are also tested at these multiples of their distance."""
KINDS: dict[str, dict[str, Any]] = {
    "8 templates blended": {"blend": True},
    "one of 8 for each pixel": {},
    "one template a material": {"templates": 1},
}
BLENDED = {"templates": 4, "blend": True, "packets": 16, "threshold": 0.004, "reach": REACH}


class Subject(NamedTuple):
    """A scene, its materials, and the direction in which the light travels."""

    scene: Scene
    materials: Sequence[jv.Material]
    light: Color


def lit(scene: Scene, lighting: Lighting | None) -> np.ndarray:
    return np.asarray(jv.render(*scene[:3], march(scene), lighting=lighting, outputs="rgba").image(BLACK))


def uniform(color: Any, opacity: float, low: float, high: float, unit: float) -> jv.TransferFunction:
    """A label's: opaque from `high` on, transparent up to `low`."""
    points = [(low, color, 0.0), (high, color, opacity), (255, color, opacity)]
    return jv.TransferFunction.from_points(points, unit_distance=unit)


def labelled(volume: jv.Volume, functions: Sequence[Any], camera: jv.Camera) -> Scene:
    transfer = cast(Any, jv.LabelTransferFunction([None, *functions]))
    return Scene(volume, transfer, camera, float(volume.spacing.min()) / 2)


GAP, THICK, RADIUS = 0.15, 0.06, 0.75
"""Gap between ear and head, thickness of the ear, radius of the head; the cube is 2 wide."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def ear(resolution: int, *, head: bool) -> jv.Volume:
    """An ear on the -y side of a head, or the ear alone."""
    x, y, z = grid(resolution)
    side = -0.35  # y of the head's side towards the ear
    thin = np.maximum(np.hypot(x, 0.7 * z) - 0.22, abs(y - side + GAP + THICK / 2) - THICK / 2)
    skull = np.sqrt(x**2 + (y - side - RADIUS) ** 2 + z**2) - RADIUS
    inside = np.minimum(thin, skull) if head else thin
    return on_cube(np.clip(0.5 - inside * (resolution - 1) / 4, 0, 1))


def lee_fig4(chosen: Namespace) -> Panels:
    """The light comes from behind the head. Below, the mean brightness of the ear's pixels."""
    whole, alone = (ear(chosen.resolution, head=head) for head in (True, False))
    points = [(0.1, (0.8, 0.5, 0.38), 0.0), (0.9, (0.8, 0.5, 0.38), 0.9)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.05)
    camera = jv.Camera.looking_at(whole, (-0.35, -1, 0.2), size=(chosen.size,) * 2).zoom(1.9)
    scene = Scene(whole, transfer, camera, float(whole.spacing[0]) / 2)
    seen = np.asarray(jv.render(alone, transfer, camera, march(scene)).rgba[..., 3] > 0.9)
    lights = DirectionalLight((0.0, -1.0, 0.0), (50.0, 50.0, 50.0)), ConstantLight((0.4, 0.4, 0.4))
    flesh = jv.Material(0.5, 0.045, 1.4)
    rows = [ear_row("phantom", scene, flesh, lights, seen)]
    return rows if chosen.data is None else [*rows, ear_of_ct(chosen.data, chosen.size)]


def ear_row(name: str, scene: Scene, materials: Any, lights: Any, ear: np.ndarray) -> list[Panel]:
    """Unlit; by photons alone; and with photons tested at multiples of their distance."""
    how: dict[str, Any] = {"occlusion": "hard", "templates": 8, "blend": True, "packets": 8, "cutoff": 0.001}
    row = []
    for title, reach in {"unlit": None, "photons alone": (), "tested at 2, 4, 8 times": REACH}.items():
        lighting = None if reach is None else ScattererTemplates(materials, lights, reach=reach, **how)
        image = lit(scene, lighting)
        bright = (image[ear] @ LUMINANCE).mean()
        row.append(panel(image, f"{name}: brightness of the ear {bright:.3f}", title))
    return row


EAR_OF_CT = (186.0, 150.0, 130.0)
EAR_PART = (0.72, 0.5, 0.46), (0.77, 0.68, 0.7)
"""Where the left ear of the CT head is, mm, and the part of the volume that holds it."""


def ear_of_ct(folder: Path, size: int) -> list[Panel]:
    """The ear is turned to the camera; the light comes from the other side of the head."""
    (volume, transfer, _, step), _, _ = ct_head(folder, size)
    place = tuple(x + 400 * d for x, d in zip(EAR_OF_CT, (0.94, -0.33, 0.0), strict=True))
    camera = jv.Camera(place, EAR_OF_CT, (0, 0, -1), view_angle=15, size=(size, size))
    scene = Scene(volume, transfer, camera, step)
    ear = jv.render(cropped(volume, *EAR_PART), transfer, camera, march(scene)).rgba[..., 3]
    lights = DirectionalLight((1.0, 0.1, 0.0), (50.0, 50.0, 50.0)), ConstantLight((0.4, 0.4, 0.4))
    return ear_row("CT", scene, jv.Material(0.5, 1.5, 1.4), lights, np.asarray(ear > 0.3))


FINGERS = (  # joints from knuckle to tip, radius
    ([(-0.30, 0.0, 0.06), (-0.42, -0.05, 0.30), (-0.47, -0.02, 0.44), (-0.50, 0.03, 0.55)], 0.070),
    ([(-0.11, 0.0, 0.13), (-0.16, -0.06, 0.47), (-0.18, -0.03, 0.65), (-0.19, 0.03, 0.79)], 0.080),
    ([(0.09, 0.0, 0.14), (0.10, -0.05, 0.51), (0.10, -0.01, 0.71), (0.10, 0.05, 0.86)], 0.083),
    ([(0.28, 0.0, 0.09), (0.36, -0.03, 0.42), (0.39, 0.02, 0.60), (0.40, 0.08, 0.73)], 0.078),
    ([(0.27, -0.06, -0.42), (0.52, -0.16, -0.16), (0.63, -0.20, 0.05), (0.67, -0.21, 0.18)], 0.090),
)
WRIST = (0.0, 0.0, -0.68)
HAND = [
    (30, (0.90, 0.58, 0.44), 0.0),
    (70, (0.85, 0.48, 0.36), 0.5),
    (110, (0.75, 0.26, 0.20), 0.6),
    (170, (0.95, 0.86, 0.70), 0.9),
    (255, (1.00, 0.96, 0.86), 0.9),
]


def hand(resolution: int) -> jv.Volume:
    """A right hand of flesh and bones, its palm towards -y and its fingers towards +z."""
    flesh, canvas = Canvas(resolution, FAR), Canvas(resolution)
    flesh.join(ellipsoid((0.0, 0.0, -0.25), (0.40, 0.15, 0.46)), 0.15)
    flesh.join(capsule((0.0, 0.01, -1.0), WRIST, 0.21, 0.19), 0.15)
    for joints, radius in FINGERS:
        flesh.join([capsule(WRIST, joints[0], 0.10, 1.1 * radius), *tube(joints, radius)], 0.06)
    canvas.paint(100, flesh)
    for bone in bones():
        canvas.paint(210, bone)
    return jv.Volume(canvas.as_uint8(), (canvas.spacing,) * 3, (-1.0,) * 3)


def bones() -> list[Shape]:
    """Each a little shorter than what it lies in, so that there are gaps at the joints."""
    found = [capsule((x, 0.0, -1.0), (x, 0.0, -0.8), 0.06) for x in (-0.09, 0.09)]
    for joints, radius in FINGERS:
        ends = np.array([WRIST, *joints])
        ends[0, 0] = 0.3 * ends[1, 0]
        for a, b in pairwise(ends):
            found.append(capsule(a + 0.14 * (b - a), b - 0.10 * (b - a), 0.4 * radius, 0.36 * radius))
    return found


def lee_hand(chosen: Namespace) -> Panels:
    volume = hand(chosen.resolution)
    transfer = jv.TransferFunction.from_points(HAND, unit_distance=0.05)
    camera = jv.Camera.looking_at(volume, (-0.25, -1, 0.1), size=(chosen.size,) * 2).zoom(1.75)
    scene = Scene(volume, transfer, camera, float(volume.spacing[0]) / 2)
    materials = jv.Material(0.4, 0.04, 1.4, values=(20, 140)), jv.Material(0.7, 0.025, 1.5, values=(140, 256))
    sun = DirectionalLight((0.95, 0.05, -0.3), (34.0, 34.0, 34.0))
    lights = sun, ConstantLight((0.3, 0.3, 0.3))
    hard: dict[str, Any] = {"occlusion": "hard", "templates": 1, "reach": REACH}
    columns = {
        "unlit": None,
        "Phong": Phong(DirectionalLight(sun.direction, (1.5, 1.5, 1.5)), ambient=0.15),
        "hard, one template for each material": ScattererTemplates(materials, lights, **hard),
        "soft, 4 templates blended": ScattererTemplates(materials, lights, **BLENDED),
    }
    return [[panel(lit(scene, lighting), "", title) for title, lighting in columns.items()]]


def head(size: int, resolution: int) -> Subject:
    return Subject(skin_head(size, resolution), [FLESH], (0.9, 0.7, -0.6))


def frog(size: int, resolution: int) -> Subject:
    """A phantom whose translucent body and organs are a material each."""
    volume = jv.phantom("labels", resolution)
    colors = (0.35, 0.65, 0.25), (0.9, 0.45, 0.45), (0.9, 0.45, 0.45), (0.45, 0.08, 0.05), (0.9, 0.7, 0.35)
    each = zip(colors, (0.12, 0.8, 0.8, 0.9, 0.9), strict=True)
    functions = [uniform(color, opacity, 40, 100, 0.05) for color, opacity in each]
    of = (0.3, 0.08, 1.36), (0.4, 0.06, 1.38), (0.4, 0.06, 1.38), (0.6, 0.04, 1.4), (0.5, 0.05, 1.4)
    materials = [jv.Material(*how, label=label) for label, how in enumerate(of, 1)]
    camera = jv.Camera.looking_at(volume, (-0.3, -0.8, 1), size=(size, size)).zoom(1.5)
    return Subject(labelled(volume, functions, camera), materials, (0.7, 0.5, -0.7))


def ct_head(folder: Path, size: int) -> Subject:
    """CT in Hounsfield units + 1000; z grows towards the chin, lengths in mm."""
    volume = jv.load(folder / CT_HEAD, spacing=(1, 1, 2))
    points = [
        (500, (0.60, 0.35, 0.25), 0.0),
        (800, (0.85, 0.50, 0.35), 0.7),
        (1150, (0.75, 0.30, 0.22), 0.7),
        (1300, (0.95, 0.85, 0.70), 0.9),
        (4000, (1.0, 1.0, 0.95), 0.95),
    ]
    transfer = jv.TransferFunction.from_points(points, unit_distance=4)
    camera = jv.Camera.looking_at(volume, (-0.6, -1, 0), (0, 0, -1), size=(size, size)).zoom(1.6)
    flesh, bone = jv.Material(0.5, 4, 1.4, values=(500, 1250)), jv.Material(0.8, 3, 1.55, values=(1250, 5000))
    return Subject(Scene(volume, transfer, camera, 0.5), [flesh, bone], (-0.9, 0.7, 0.6))


def noise(rgba: np.ndarray) -> float:
    """Standard deviation of the noise of what is mostly opaque, over its mean."""
    color, opaque = rgba[..., :3], rgba[..., 3] > 0.5
    return float(np.sqrt(boundary_noise(color, opaque) / 3) / color[opaque].mean())


def lee_fig6(chosen: Namespace) -> Panels:
    sizes = chosen.size, chosen.resolution
    subjects = {"the head phantom": head(*sizes)}
    if folder := chosen.data:
        subjects["a head (CT)"] = ct_head(folder, sizes[0])
    subjects["a frog phantom"] = frog(*sizes)
    if folder:
        subjects["a frog (labels)"] = tissues(folder, sizes[0])
    hard = {"occlusion": "hard", "threshold_on": "level"}
    rows: Panels = []
    for name, (scene, materials, direction) in subjects.items():
        lights, row = (DirectionalLight(direction, (40.0, 40.0, 40.0)), ConstantLight((1.3, 1.3, 1.3))), []
        lightings = {
            kind: ScattererTemplates(materials, lights, **hard, **how) for kind, how in KINDS.items()
        }
        for title, lighting in {UNLIT: None, **lightings}.items():
            rgba = jv.render(*scene[:3], march(scene), lighting=lighting, outputs="rgba").rgba
            caption = name if lighting is None else f"noise {noise(np.asarray(rgba)):.2f} of the mean"
            row.append(panel(np.asarray(rgba)[..., :3], caption, "" if rows else title))
        rows.append(row)
    return rows


def matter(scene: Scene, light: Color, free_path: float = 2) -> Subject:
    """A scene of one material. `free_path`: in voxels."""
    voxel = float(scene.volume.spacing.min())
    return Subject(scene, [jv.Material(0.3, free_path * voxel, 1.4)], light)


def tissues(folder: Path, size: int) -> Subject:
    """The labels of a frog's tissues: a translucent body, the organs opaque."""
    whole = jv.load(folder / "frogtissue.mhd")
    labels = np.asarray(whole.data).astype(np.int32)
    labels[labels > 15] = 0
    smooth = gaussian_filter(255.0 * (labels > 0), 1.0).astype(np.uint8)
    volume = jv.Volume(smooth, whole.spacing, whole.origin, labels=labels)
    voxel, colors = float(volume.spacing.min()), jv.colormap("tab20", (0, 20)).colors
    functions = [uniform(tuple(colors[3 * n % len(colors)]), 0.8, 60, 140, 2 * voxel) for n in range(1, 16)]
    camera = jv.Camera.looking_at(volume, (0.2, 0.3, -1), (0, -1, 0), size=(size, size)).zoom(1.3)
    return matter(labelled(volume, functions, camera), (0.7, 0.6, 0.7), free_path=3)


def subjects(folder: Path | None, size: int, resolution: int) -> Iterator[tuple[str, Subject]]:
    yield "the head phantom", head(size, resolution)
    yield "a frog phantom", frog(size, resolution)
    if folder is None:
        return
    bonsai = SCENES["bonsai"](folder, size)  # with up and down exchanged
    bonsai = bonsai._replace(camera=replace(bonsai.camera, view_up=-bonsai.camera.view_up))
    yield "an engine (CT)", matter(SCENES["engine"](folder, size), (-0.3, 0.9, 0.8))
    yield "a bonsai (CT)", matter(bonsai, (0.6, -0.9, -0.7))
    yield "a head (CT)", ct_head(folder, size)
    yield "a chest (CT)", matter(SCENES["lidc0314_airway"](folder, size), (0.6, 0.9, -0.7))
    yield "a frog (labels)", tissues(folder, size)


def exposed(image: Any) -> np.ndarray:
    """An image with its own white: what 1 % of the pixels that show something exceed."""
    image = np.asarray(image)
    bright = image.max(-1)
    return image / np.quantile(bright[bright > 0.01 * bright.max()], 0.99)


def gallery(chosen: Namespace) -> Panels:
    rows: Panels = []
    for name, (scene, materials, direction) in subjects(chosen.data, chosen.size, chosen.resolution):
        lights = DirectionalLight(direction, (3.0, 3.0, 3.0)), ConstantLight((0.3, 0.3, 0.3))
        how = replace(march(scene), quadrature="midpoint")
        lightings = {
            "unlit": None,
            "Phong": Phong((HeadLight((0.4, 0.4, 0.4)), DirectionalLight(direction))),
            "scatterer templates": ScattererTemplates(
                tuple(materials), lights, templates=8, blend=True, reach=REACH
            ),
        }
        images: dict[str, Any] = {
            title: np.asarray(jv.render(*scene[:3], how, lighting=each, outputs="rgba").image(BLACK))
            for title, each in lightings.items()
        }
        paths = 4 if chosen.quick else 48
        images["path traced"] = jv.path_trace(*scene[:3], lights, paths=paths).radiance
        for title in ("scatterer templates", "path traced"):
            images[title] = exposed(images[title])
        below = dict.fromkeys(images, "") | {"unlit": name}
        rows.append([panel(im, below[title], "" if rows else title) for title, im in images.items()])
    return rows
