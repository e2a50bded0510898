"""The six steps of shading with a template (Lee, Kwon and Shin 2016): the effect of each on an image.

For each step, a scene in which only that step matters is drawn twice: as it is above, and with one thing
changed below. The template is made by hand, of photons evenly around a sample, so that there is no noise;
surfaces are so opaque that what lies under them shows only by the light that comes from there. The text under
each image is the mean of its visible pixels, as linear red, green and blue.
"""

from argparse import Namespace
from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol._util.vec3 import golden_spiral
from jaxvol.lighting import ConstantLight, DirectionalLight, Light, ScattererTemplate, ScattererTemplates

from ..printed_templates import PrintedSteps
from ..scenes import grid, on_cube
from . import BLACK, Panels, panel


FAR = 0.2
"""Distance of photons from their sample; the cube is 2 wide."""
AIR, SKIN, DEEP, DEEPER, VEIL = 0.0, 1.0, 2.0, 3.0, 0.25
PALE, RED, BLUE, GREY = (0.75, 0.6, 0.5), (0.9, 0.1, 0.05), (0.1, 0.2, 0.9), (0.1, 0.1, 0.1)
LEFT = DirectionalLight((1.0, 0.3, -0.4), (28.0, 28.0, 28.0))
BESIDE = DirectionalLight((1.0, -0.25, -0.15), (28.0, 28.0, 28.0))
ABOVE = DirectionalLight((0.7, 0.1, -0.8), (19.0, 19.0, 19.0))
SKY = ConstantLight((1.0, 1.0, 1.0))
Place = tuple[np.ndarray, ...]


class Setup(NamedTuple):
    """A scene and its lighting. `values`: the volume's values at points of the cube; `seen`: colours of
    `DEEP` and `DEEPER`; `inside`: the material of both."""

    caption: str
    values: Callable[[Place, float], np.ndarray]
    seen: tuple[Any, Any] = (PALE, PALE)
    lights: tuple[Light, ...] = (LEFT, SKY)
    bright: float = 1.0
    inside: tuple[float, float] = (0.5, 1.4)
    """Opacity, and refractive index."""
    cutoff: float = 0.0


def inside(distance: np.ndarray, voxel: float) -> np.ndarray:
    """1 where a distance is below 0, 0 where it is above, with a ramp two voxels wide in between."""
    return np.clip(0.5 - distance / voxel / 2, 0, 1)


def away(place: Place) -> np.ndarray:
    return np.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2)


def ball(place: Place, voxel: float) -> np.ndarray:
    return SKIN * inside(away(place) - 0.8, voxel)


def floor(place: Place, voxel: float) -> np.ndarray:
    return SKIN * inside(place[2] + 0.4, voxel)


def below_a_ball(place: Place, voxel: float) -> np.ndarray:
    return np.maximum(floor(place, voxel), SKIN * inside(away(place) - 0.35, voxel))


def layers(place: Place, voxel: float) -> np.ndarray:
    """A ball of skin with `DEEP` under one half of its surface, and `DEEPER` under that."""
    r, half = away(place), inside(-place[2], voxel)
    deep, deeper = (DEEP - SKIN) * inside(r - 0.7, voxel), (DEEPER - DEEP) * inside(r - 0.53, voxel)
    return ball(place, voxel) + half * deep + half * deeper


def veiled(place: Place, voxel: float) -> np.ndarray:
    """A ball, and a veil without material before one half of it."""
    veil = inside(-place[2], voxel) * inside(abs(away(place) - 0.92) - 0.03, voxel)
    return np.maximum(ball(place, voxel), VEIL * veil)


STEPS: dict[str, tuple[Setup, Setup]] = {
    "1: photons nearer to the light": (
        Setup("a sky, nearer to all", ball, lights=(ConstantLight((4.0, 4.0, 4.0)),)),
        Setup("a sun from the left", ball, lights=(BESIDE,)),
    ),
    "2: that are not hidden": (
        Setup("a floor", floor, lights=(ABOVE,)),
        Setup("a ball above it", below_a_ball, lights=(ABOVE,)),
    ),
    "3: by their intensity": (Setup("0.4 in all", ball, bright=0.4), Setup("1 in all", ball)),
    "4: colour of the same material": (
        Setup("pale inside", layers),
        Setup("red inside, above", layers, seen=(RED, RED)),
    ),
    "5: of another material": (
        Setup("red, and blue below", layers, seen=(RED, BLUE), inside=(0.5, 1.4001)),
        Setup("n / n' = 2, α' / α = 1.6", layers, seen=(RED, BLUE), inside=(0.8, 0.7)),
    ),
    "6: not where little is seen": (
        Setup("all behind the veil", veiled),
        Setup("cut off there", veiled, cutoff=0.006),
    ),
}


def render(
    setup: Setup, resolution: int, size: int, kind: type[ScattererTemplates] = ScattererTemplates
) -> tuple[np.ndarray, np.ndarray]:
    """The image, and which pixels are visible."""
    spacing = 2 / (resolution - 1)
    volume = on_cube(setup.values(grid(resolution), spacing))
    deep, deeper = setup.seen
    points = [(0.1, GREY, 0.0), (VEIL, GREY, 0.45), (0.4, GREY, 0.45), (0.5, PALE, 0.45), (0.9, PALE, 0.95)]
    points += [(1.3, PALE, 0.95), (1.7, deep, 0.95), (2.3, deep, 0.95), (2.7, deeper, 0.95)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.03)
    camera = jv.Camera.looking_at(volume, (-0.25, -1, 0.3), size=(size, size)).zoom(1.5)
    march = jv.March(spacing / 4, (jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination()))
    opacity, index = setup.inside
    materials = [
        jv.Material(0.5, FAR, 1.4, values=(0.4, 1.5)),
        jv.Material(opacity, FAR, index, values=(1.5, 4.0)),
    ]
    count = 48  # photons evenly in all directions
    offset = jnp.tile(FAR * golden_spiral(count), (2, 1, 1, 1))
    both = ScattererTemplate(offset, jnp.full((2, 1, count), setup.bright / count))
    lighting = kind(materials, setup.lights, given=both, cutoff=setup.cutoff)
    rendering = jv.render(volume, transfer, camera, march, lighting=lighting)
    return np.asarray(rendering.image(BLACK)), np.asarray(rendering.rgba[..., 3] > 0.5)


def lee_printed(chosen: Namespace) -> Panels:
    """Steps 4 and 5, by the library and as printed, under the same light."""
    rows: Panels = []
    for title in ("4: colour of the same material", "5: of another material"):
        setup, row = STEPS[title][1], []
        for name, kind in (("ours", ScattererTemplates), ("as printed", PrintedSteps)):
            image, visible = render(setup, chosen.resolution, chosen.size, kind)
            mean = " ".join(f"{part:.2f}" for part in image[visible].mean(axis=0))
            row.append(panel(image, f"step {title}: {setup.caption}\n{mean}", "" if rows else name))
        rows.append(row)
    return rows


def lee_fig_steps(chosen: Namespace) -> Panels:
    """Three steps side by side, and below them three more."""
    rows: Panels = []
    titles = list(STEPS)
    for some, after in product((titles[:3], titles[3:]), (False, True)):
        row = []
        for title in some:
            setup = STEPS[title][after]
            image, visible = render(setup, chosen.resolution, chosen.size)
            mean = " ".join(f"{part:.2f}" for part in image[visible].mean(axis=0))
            row.append(panel(image, f"{setup.caption}\n{mean}", "" if after else title))
        rows.append(row)
    return rows
