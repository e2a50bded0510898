"""Where do adaptive strides fail? Tolerances finer than the finest cell, and light."""

from functools import cache

import numpy as np

import jaxvol as jv
from jaxvol.lighting import DirectionalLight, ScattererTemplates
from jaxvol.metrics import rmse

from .entry import Entry, colors, cube, signed, uniform


# -- tolerances finer than the finest cell ----------------------------------------------------------------


@cache
def _waves() -> jv.Volume:
    """Values that rise and fall within eight voxels, in all directions."""
    line = np.arange(33, dtype=np.float32)
    x, y, z = np.meshgrid(line, line, line, indexing="ij")
    data = 0.5 + 0.16 * (np.sin(0.8 * x) + np.sin(0.7 * y + 1) + np.sin(0.75 * z + 2))
    return jv.Volume(data, [2 / 32] * 3, [-1.0] * 3)


def waves_image(size: int, transform: jv.Transform | None, finer: int = 1) -> np.ndarray:
    points = [(0.5, (0.2, 0.4, 0.9), 0.0), (0.7, (0.9, 0.7, 0.2), 0.5), (1.0, (0.9, 0.2, 0.2), 0.9)]
    transfer = jv.TransferFunction.from_points(points, unit_distance=0.1)
    camera = jv.Camera.looking_at(_waves(), (0.5, -0.9, 0.4), size=(size, size)).zoom(1.6)
    transforms = (jv.AlphaCorrection(),) if transform is None else (jv.AlphaCorrection(), transform)
    return colors(_waves(), transfer, camera, jv.March(2 / 32 / finer, transforms, "midpoint"))


@cache
def _waves_truth(size: int) -> np.ndarray:
    return waves_image(size, None, 32)


def tolerances(tolerance: float, size: int) -> dict[str, float]:
    found = {}
    for finest in (1, 8):
        image = waves_image(size, jv.AdaptiveSampling(tolerance, 8 * finest), finest)
        found[f"finest={finest}"] = rmse(image, _waves_truth(size)) / tolerance
    return found


TOLERANCE = Entry(
    name="tolerances finer than the finest cell",
    question="Down to which tolerance does adaptive sampling keep its promise?",
    method="jaxvol.AdaptiveSampling",
    regime="tolerance",
    values=(0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4, 3e-5),
    measure=tolerances,
    metric="RMSE of the image / tolerance",
    judged="finest=1",
    limit=1.0,
    does="No cell is shorter than a step, here a voxel / finest: below the error of an image of such cells "
    "the tolerance means nothing. A shorter step moves the edge.",
    picture=lambda tolerance, size: signed(
        waves_image(size, jv.AdaptiveSampling(tolerance, 8)) - _waves_truth(size), 0.05
    ),
    shows="error of the image with finest=1, ± 0.05 from blue to red",
    pictured=(0.1, 1e-3),
    size=32,
)


# -- light ------------------------------------------------------------------------------------------------


def lit_image(
    size: int, path: float, *, transform: jv.Transform | None, lit: bool, finer: int = 1
) -> np.ndarray:
    """A translucent cube of one value, lit from the side by templates of this mean free path."""
    light = DirectionalLight((1.0, 0.3, 0.2), (3.0, 3.0, 3.0))
    material = jv.Material(0.3, path)
    lighting = (
        ScattererTemplates(material, light, templates=1, packets=2, photons=6, levels=3) if lit else None
    )
    camera = jv.Camera.looking_at(cube(32), (0.4, -1.0, 0.5), size=(size, size)).zoom(1.3)
    transforms = (jv.AlphaCorrection(),) if transform is None else (jv.AlphaCorrection(), transform)
    march = jv.March(1 / 32 / finer, transforms, "midpoint")
    return colors(cube(32), uniform(1.5, (0.9, 0.8, 0.7)), camera, march, lighting=lighting)


PATH = 0.2
"""Mean free path of the light, a tenth of the side of the cube."""


@cache
def _light_error(size: int, *, lit: bool, tolerance: float | None) -> float:
    """RMSE of the cube, by adaptive strides or by cells of one step."""
    transform = None if tolerance is None else jv.AdaptiveSampling(tolerance, 16)
    truth = lit_image(size, PATH, transform=None, lit=lit, finer=4)
    return rmse(lit_image(size, PATH, transform=transform, lit=lit), truth)


def light(tolerance: float, size: int) -> dict[str, float]:
    return {
        "lit": _light_error(size, lit=True, tolerance=tolerance) / tolerance,
        "lit, cells of one step": _light_error(size, lit=True, tolerance=None) / tolerance,
        "unlit": _light_error(size, lit=False, tolerance=tolerance) / tolerance,
    }


LIGHT = Entry(
    name="adaptive strides under light",
    question="What does adaptive sampling miss where light varies and values do not?",
    method="jaxvol.AdaptiveSampling",
    regime="tolerance",
    values=(0.1, 0.03, 0.01, 0.005, 0.002, 1e-3, 3e-4, 1e-4),
    measure=light,
    metric="RMSE of the image / tolerance",
    judged="lit",
    limit=1.0,
    does="Strides follow from values and transfer function alone, so that in a cube of one value all cells "
    "are as long as allowed, whatever the tolerance: without light that is exact, with light it is "
    "not. Rendering.error does not count it.",
    size=24,
)

ENTRIES = (TOLERANCE, LIGHT)
