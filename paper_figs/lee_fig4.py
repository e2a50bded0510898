"""Lee, Kwon and Shin, Fig. 4: the exceptional case. An ear before a head that blocks all light from it.

The light comes from behind the head. Photons of a template reach through the thin ear into the gap before
the head, where nothing hides them, so the ear shines; if they are also tested farther out, they are hidden.
The text under each image is the mean brightness of the ear's pixels.
"""

from argparse import Namespace
from typing import Any

import numpy as np

import jaxvol as jv
from experiments.lighting import march
from experiments.scenes import Scene
from jaxvol.lighting import ConstantLight, DirectionalLight, ScattererTemplates

from .common import BLACK, Page, figure


GAP, THICK, RADIUS = 0.15, 0.06, 0.75
"""Gap between ear and head, thickness of the ear, radius of the head; the cube is 2 wide."""
FLESH = jv.Material(0.5, 0.045, 1.4)
LIGHTS = DirectionalLight((0.0, -1.0, 0.0), (50.0, 50.0, 50.0)), ConstantLight((0.4, 0.4, 0.4))
HOW: dict[str, Any] = {"occlusion": "hard", "templates": 8, "blend": True, "packets": 8, "cutoff": 0.001}
REACHES: dict[str, tuple[float, ...]] = {"photons alone": (), "tested at 2, 4, 8 times": (2, 4, 8)}
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def volume(resolution: int, *, head: bool) -> jv.Volume:
    """An ear on the -y side of a head, or the ear alone."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, resolution)] * 3, indexing="ij")
    side = -0.35  # y of the head's side towards the ear
    ear = np.maximum(np.hypot(x, 0.7 * z) - 0.22, abs(y - side + GAP + THICK / 2) - THICK / 2)
    skull = np.sqrt(x**2 + (y - side - RADIUS) ** 2 + z**2) - RADIUS
    inside = np.minimum(ear, skull) if head else ear
    spacing = 2 / (resolution - 1)
    return jv.Volume(np.clip(0.5 - inside / spacing / 2, 0, 1), (spacing,) * 3, (-1.0,) * 3)


@figure(__doc__, resolution=96)
def main(chosen: Namespace) -> None:
    whole, alone = (volume(chosen.resolution, head=head) for head in (True, False))
    points = [(0.1, (0.8, 0.5, 0.38), 0.0), (0.9, (0.8, 0.5, 0.38), 0.9)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.05)
    camera = jv.Camera.looking_at(whole, (-0.35, -1, 0.2), size=(chosen.size,) * 2).zoom(1.9)
    scene = Scene(whole, transfer, camera, float(whole.spacing[0]) / 2)
    ear = np.asarray(jv.render(alone, transfer, camera, march(scene)).rgba[..., 3] > 0.9)

    page = Page(
        1 + len(REACHES), 1, chosen.size, "Lee, Kwon and Shin, Fig. 4: an ear, light from behind the head"
    )
    for column, (title, reach) in enumerate({"unlit": None, **REACHES}.items()):
        lighting = None if reach is None else ScattererTemplates(FLESH, LIGHTS, reach=reach, **HOW)
        rendering = jv.render(scene.volume, scene.transfer, scene.camera, march(scene), lighting=lighting)
        image = np.asarray(rendering.image(BLACK))
        caption = f"brightness of the ear {(image[ear] @ LUMINANCE).mean():.3f}"
        page.draw(0, column, image, caption, title)
        print(f"lee_fig4 {title}: {caption}")
    page.save(chosen.output / "lee_fig4.webp")


if __name__ == "__main__":
    main()
