"""Lee, Kwon and Shin: thin parts, which stand in for the paper's Fig. 5. A hand of flesh and bones, lit from
the left.

Phong's shading sees the surface alone: it shades a finger as it shades the palm, and lights what lies in
another finger's shadow. Templates see as far as light is scattered. In the third column photons are hidden as
published, and all samples of a material use one template; in the last one, occlusion is soft, and four
templates of more packets are blended. Photons are also tested at 2, 4 and 8 times their distance, since
without that fingers do not shade each other.
"""

from argparse import Namespace
from itertools import pairwise
from typing import Any

import numpy as np

import jaxvol as jv
from experiments.lighting import march
from experiments.scenes import Scene
from jaxvol.io.phantoms.canvas import FAR, Canvas
from jaxvol.io.phantoms.shapes import Shape, capsule, ellipsoid, tube
from jaxvol.lighting import ConstantLight, DirectionalLight, Phong, ScattererTemplates

from .common import BLACK, Page, figure


FINGERS = (  # joints from knuckle to tip, radius
    ([(-0.30, 0.0, 0.06), (-0.42, -0.05, 0.30), (-0.47, -0.02, 0.44), (-0.50, 0.03, 0.55)], 0.070),
    ([(-0.11, 0.0, 0.13), (-0.16, -0.06, 0.47), (-0.18, -0.03, 0.65), (-0.19, 0.03, 0.79)], 0.080),
    ([(0.09, 0.0, 0.14), (0.10, -0.05, 0.51), (0.10, -0.01, 0.71), (0.10, 0.05, 0.86)], 0.083),
    ([(0.28, 0.0, 0.09), (0.36, -0.03, 0.42), (0.39, 0.02, 0.60), (0.40, 0.08, 0.73)], 0.078),
    ([(0.27, -0.06, -0.42), (0.52, -0.16, -0.16), (0.63, -0.20, 0.05), (0.67, -0.21, 0.18)], 0.090),
)
WRIST = (0.0, 0.0, -0.68)
FLESH, BONE = 100, 210
POINTS = [
    (30, (0.90, 0.58, 0.44), 0.0),
    (70, (0.85, 0.48, 0.36), 0.5),
    (110, (0.75, 0.26, 0.20), 0.6),
    (170, (0.95, 0.86, 0.70), 0.9),
    (255, (1.00, 0.96, 0.86), 0.9),
]
MATERIALS = [
    jv.Material(0.4, 0.04, 1.4, values=(20, 140)),
    jv.Material(0.7, 0.025, 1.5, values=(140, 256)),
]
LIGHTS = DirectionalLight((0.95, 0.05, -0.3), (34.0, 34.0, 34.0)), ConstantLight((0.3, 0.3, 0.3))
PHONG = Phong(DirectionalLight(LIGHTS[0].direction, (1.5, 1.5, 1.5)), ambient=0.15)
FAR_TOO: dict[str, Any] = {"reach": (2, 4, 8)}
COLUMNS: dict[str, Any] = {
    "unlit": None,
    "Phong": PHONG,
    "hard, one template for each material": {"occlusion": "hard", "templates": 1, **FAR_TOO},
    "soft, 4 templates blended": {
        "templates": 4,
        "blend": True,
        "packets": 16,
        "threshold": 0.004,
        **FAR_TOO,
    },
}


def hand(resolution: int) -> jv.Volume:
    """A right hand, its palm towards -y and its fingers towards +z."""
    flesh, canvas = Canvas(resolution, FAR), Canvas(resolution)
    flesh.join(ellipsoid((0.0, 0.0, -0.25), (0.40, 0.15, 0.46)), 0.15)
    flesh.join(capsule((0.0, 0.01, -1.0), WRIST, 0.21, 0.19), 0.15)
    for joints, radius in FINGERS:
        flesh.join([capsule(WRIST, joints[0], 0.10, 1.1 * radius), *tube(joints, radius)], 0.06)
    canvas.paint(FLESH, flesh)
    for bone in _bones():
        canvas.paint(BONE, bone)
    return jv.Volume(canvas.as_uint8(), (canvas.spacing,) * 3, (-1.0,) * 3)


def _bones() -> list[Shape]:
    """Each a little shorter than what it lies in, so that there are gaps at the joints."""
    found = [capsule((x, 0.0, -1.0), (x, 0.0, -0.8), 0.06) for x in (-0.09, 0.09)]
    for joints, radius in FINGERS:
        ends = np.array([WRIST, *joints])
        ends[0, 0] = 0.3 * ends[1, 0]
        for a, b in pairwise(ends):
            found.append(capsule(a + 0.14 * (b - a), b - 0.10 * (b - a), 0.4 * radius, 0.36 * radius))
    return found


@figure(__doc__, size=512)
def main(chosen: Namespace) -> None:
    volume = hand(chosen.resolution)
    transfer = jv.TransferFunction.from_points(POINTS, unit_distance=0.05)
    camera = jv.Camera.looking_at(volume, (-0.25, -1, 0.1), (0, 0, 1), size=(chosen.size,) * 2).zoom(1.75)
    scene = Scene(volume, transfer, camera, float(volume.spacing[0]) / 2)
    page = Page(len(COLUMNS), 1, chosen.size, "Lee, Kwon and Shin: a hand, light from the left")
    for column, (title, how) in enumerate(COLUMNS.items()):
        lighting = ScattererTemplates(MATERIALS, LIGHTS, **how) if isinstance(how, dict) else how
        rendering = jv.render(scene.volume, scene.transfer, scene.camera, march(scene), lighting=lighting)
        page.draw(0, column, rendering.image(BLACK), "", title)
    page.save(chosen.output / "lee_fig5.webp")


if __name__ == "__main__":
    main()
