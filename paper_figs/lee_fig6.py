"""Lee, Kwon and Shin, Fig. 6: without light, and lit by scatterer templates. The defaults are the head
phantom, and a frog whose translucent body and organs are a material each; `--data` adds CT of a head.

In the middle column hidden photons are left out, as published (hard occlusion), and each pixel uses one of
eight templates, chosen at random; the paper makes eight for each material, and does not say which of them a
sample uses. In the right column occlusion is soft, and four templates of more packets are blended. The lights
are the same.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any, NamedTuple, cast

import jaxvol as jv
from experiments.lighting import FLESH, march
from experiments.scenes import Scene, skin_head
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates

from .common import BLACK, Page, figure


IRRADIANCE = (40.0, 40.0, 40.0)
AROUND = ConstantLight((1.3, 1.3, 1.3))
BLENDED = {"templates": 4, "blend": True, "packets": 16, "threshold": 0.004, "reach": (2, 4, 8)}
COLUMNS: dict[str, dict[str, Any] | None] = {
    "unlit": None,
    "hard, one of 8 for each pixel": {"occlusion": "hard"},
    "soft, 4 templates blended": BLENDED,
}
"""How the templates of each column are used."""


class Subject(NamedTuple):
    """A scene, its materials, and the direction in which the light travels."""

    scene: Scene
    materials: list[jv.Material]
    light: tuple[float, float, float]


def head(resolution: int, size: int) -> Subject:
    return Subject(skin_head(size, resolution), [FLESH], (0.9, 0.7, -0.6))


def frog(resolution: int, size: int) -> Subject:
    volume = jv.phantom("labels", resolution)

    def function(color: tuple[float, float, float], opacity: float) -> jv.TransferFunction:
        points = [(40, color, 0.0), (100, color, opacity), (255, color, opacity)]
        return jv.TransferFunction.from_points(points, unit_distance=0.05)

    lung, liver, stomach = (0.9, 0.45, 0.45), (0.45, 0.08, 0.05), (0.9, 0.7, 0.35)
    functions = [
        None,
        function((0.35, 0.65, 0.25), 0.12),
        *[function(lung, 0.8)] * 2,
        function(liver, 0.9),
        function(stomach, 0.9),
    ]
    materials = [
        jv.Material(0.3, 0.08, 1.36, label=1),
        *(jv.Material(0.4, 0.06, 1.38, label=label) for label in (2, 3)),
        jv.Material(0.6, 0.04, 1.4, label=4),
        jv.Material(0.5, 0.05, 1.4, label=5),
    ]
    camera = jv.Camera.looking_at(volume, (-0.3, -0.8, 1), (0, 0, 1), size=(size, size)).zoom(1.5)
    step = float(volume.spacing[0]) / 2
    transfer = cast(Any, jv.LabelTransferFunction(functions))  # Scene: for VTK and Dr.Jit, not used here
    scene = Scene(volume, transfer, camera, step)
    return Subject(scene, materials, (0.7, 0.5, -0.7))


def real(folder: Path, size: int) -> Subject:
    """CT in Hounsfield units + 1000; z grows towards the chin, lengths in mm."""
    volume = jv.load(folder / "cthead_256x256x113_uint16le.raw.gz", spacing=(1, 1, 2))
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


def draw(page: Page, row: int, name: str, subject: Subject) -> None:
    scene, materials, direction = subject
    for column, (title, how) in enumerate(COLUMNS.items()):
        lighting = None
        if how is not None:
            lights = DirectionalLight(direction, IRRADIANCE), AROUND
            lighting = ScattererTemplates(materials, lights, **how)
        rendering = jv.render(scene.volume, scene.transfer, scene.camera, march(scene), lighting=lighting)
        caption = name if lighting is None else f"{lighting.photons} photons a template at most"
        page.draw(row, column, rendering.image(BLACK), caption, title if row == 0 else "")


@figure(__doc__, resolution=128, size=512)
def main(chosen: Namespace) -> None:
    subjects = {
        "the head phantom": head(chosen.resolution, chosen.size),
        "a frog": frog(chosen.resolution, chosen.size),
    }
    if chosen.data:
        subjects["CT of a head"] = real(chosen.data, chosen.size)
    page = Page(len(COLUMNS), len(subjects), chosen.size, "Lee, Kwon and Shin, Fig. 6: light from the left")
    for row, (name, subject) in enumerate(subjects.items()):
        draw(page, row, name, subject)
    page.save(chosen.output / "lee_fig6.webp")


if __name__ == "__main__":
    main()
