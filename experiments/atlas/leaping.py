"""Where does space leaping fail? Thin sheets, steep transfer functions, gradients of what is leapt over."""

from functools import cache
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv
from jaxvol.march.transforms.space_leaping import Method

from ..ray_leaps import Marcher, grid_of
from ..scenes import Scene, on_cube
from .entry import LEVEL, colors, entry


RED, BLUE = (0.9, 0.25, 0.2), (0.25, 0.35, 0.6)


NODES = 128
SPACING = 2 / (NODES - 1)
THICK = 4.6 * SPACING
"""World thickness of the sheet, where its value is above that from which on something is visible."""
TILT = 0.17


@cache
def _sheet_and_wall() -> jv.Volume:
    """A sheet (value 1), seen edge-on and inclined, in front of a wall (value 0.3)."""
    line = np.linspace(-1, 1, NODES, dtype=np.float32)
    x, y, z = np.meshgrid(line, line, line, indexing="ij", sparse=True)
    # 0.2 at the faces, with a slope of one per voxel
    sheet = np.clip(0.2 + (THICK / 2 - np.abs(x - TILT * y)) / SPACING, 0, 1) * ((z > -0.6) & (z < -0.2))
    return on_cube(np.maximum(sheet, np.where(z > 0.7, 0.3, 0.0)).astype(np.float32))


def sheet_image(width: float, size: int, method: Method | None, cell: int = 8) -> np.ndarray:
    """The sheet, so many pixels wide. `method`: of leaping, or None."""
    values, extinction = [0.199, 0.2, 0.35, 0.4], [0.0, 200.0, 200.0, 200.0]
    transfer = jv.TransferFunction(values, [BLUE, BLUE, BLUE, RED], extinction)
    leaps = () if method is None else (jv.SpaceLeaping(method, cell=cell),)
    return colors(_sheet_and_wall(), transfer, _above(width, size), jv.March(1 / 64, leaps))


def _above(width: float, size: int) -> jv.Camera:
    """An orthographic camera for which the sheet is so many pixels wide."""
    scale = THICK * size / (2 * width)
    return jv.Camera((0.01, 0.02, -3), (0.01, 0.02, 0), (0, 1, 0), size=(size, size), parallel_scale=scale)


@entry(
    "jaxvol.SpaceLeaping",
    "width of the sheet in pixels / R",
    (2.0, 1.5, 1.2, 1.0, 0.9, 0.75, 0.5, 0.25, 0.125),
    "share of the sheet's pixels that are wrong",
    "min_distance, R = 16",
    limit=0.001,
    picture=lambda ratio, size: sheet_image(ratio * 16, size, "min_distance", 16),
    shows='a sheet seen edge-on before a wall, under "min_distance" with R = 16',
    pictured=(1.0, 0.5),
    size=192,
)
def sheets_thinner_than_a_cell_of_rays(ratio: float, size: int) -> dict[str, float]:
    """How wide must a structure be, in the image, for a minimum-distance grid with cells of R pixels to see
    it?

    Under "min_distance", a sheet that passes between the corners of a cell is leapt over. Choose R no larger
    than the thinnest structure is wide, in pixels, or take "beam" or "blocks", which lose nothing."""
    found = {}
    methods: list[tuple[Method, int]] = [
        ("min_distance", 4),
        ("min_distance", 8),
        ("min_distance", 16),
        ("beam", 16),
    ]
    for method, cell in methods:
        truth = sheet_image(ratio * cell, size, None)
        x, y, _ = np.moveaxis(np.asarray(_above(ratio * cell, size).rays()[0]), -1, 0)
        sheet = (np.abs(x - TILT * y) < 0.45 * THICK) & (np.maximum(np.abs(x), np.abs(y)) < 1)
        wrong = np.abs(sheet_image(ratio * cell, size, method, cell) - truth).max(axis=-1) > LEVEL
        found[f"{method}, R = {cell}"] = float(np.sum(wrong & sheet) / max(np.sum(sheet), 1))
    return found


EYE, WALL = 16.0, 4.5
"""Heights, voxels."""


def above_a_wall(angle: float, size: int) -> Scene:
    """A camera whose middle ray meets a flat wall at an angle, in degrees; steps of a voxel."""
    line = np.clip(WALL + 0.5 - np.arange(24, dtype=np.float32), 0, 1)  # 1/2 at the height of the wall
    volume = jv.Volume(np.broadcast_to(line, (384, 16, 24)).copy())
    turn, eye = np.radians(angle), (4.0, 7.5, EYE)
    target = 4 + np.cos(turn), 7.5, EYE - np.sin(turn)
    camera = jv.Camera(eye, target, (0, 1, 0), 0.5, size=(size, size))
    return Scene(volume, jv.TransferFunction([0.5, 0.51], [RED, RED], [0.0, 50.0]), camera, 1.0)


@entry(
    "jaxvol.SpaceLeaping",
    "angle between rays and wall, degrees",
    (90.0, 60.0, 40.0, 20.0, 10.0, 5.0, 2.0),
    "leaps of a ray",
    "distance map",
    limit=10.0,
)
def distance_maps_along_a_wall(angle: float, size: int) -> dict[str, float]:
    """How flat may rays meet a wall before leaps by a distance map of voxels are many?

    The nearest voxel is that of the wall, so that a ray at a small angle to it takes many short leaps; the
    image stays right. Counted per ray. With "min_distance", rays begin where the nearest corner of a cell met
    the wall, which saves most of these leaps; "blocks" leaps over the stretches of a beam instead."""
    scene = above_a_wall(angle, size)
    marcher = Marcher(scene)
    alone = marcher.count(scene.camera)
    started = marcher.count(scene.camera, grid_of(alone.hit, 8).start)
    return {"distance map": float(alone.leaps.mean()), "min_distance, R = 8": float(started.leaps.mean())}


def steep_image(ramp: float, size: int, low: float, *, leaps: bool) -> np.ndarray:
    """A volume that is visible above `low`; extinction rises over `ramp` spacings of float32."""
    values = np.array([low, low + ramp * np.spacing(np.float32(low))], np.float32)
    transfer = jv.TransferFunction(values, [RED, RED], [0.0, 50.0])
    volume = jv.phantom("gaussian", 41)
    camera = jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=(size, size)).zoom(1.5)
    return colors(volume, transfer, camera, jv.March(0.02, (jv.SpaceLeaping(),) if leaps else ()))


@entry(
    "jaxvol.SpaceLeaping",
    "width of the ramp, spacings of float32",
    (2.0**22, 2.0**16, 2.0**10, 64.0, 8.0, 2.0, 1.0),
    "largest difference from the march without leaping",
    "visible above 1/2",
    outcome="bounded",
    limit=1e-6,
    picture=lambda ramp, size: steep_image(ramp, size, 0.5, leaps=True),
    shows="the volume above 1/2, with leaping",
    pictured=(2.0**22, 1.0),
    size=48,
)
def occupancy_under_steep_transfer_functions(ramp: float, size: int) -> dict[str, float]:
    """Does space leaping lose anything if a transfer function rises within one spacing of float32?

    Ranges of blocks are widened by the rounding of interpolation, so that what is called empty is empty."""
    top = float(np.nextafter(np.float32(1), np.float32(0)))  # below the value of the middle node alone
    found = {}
    for name, low in (("visible above 1/2", 0.5), ("visible at one node", top)):
        images = [steep_image(ramp, size, low, leaps=leaps) for leaps in (True, False)]
        found[name] = float(np.abs(images[0] - images[1]).max())
    return found


@jax.jit
def _gradients(volume: jv.Volume, camera: jv.Camera, extinction: Array) -> tuple[Array, Array]:
    """The image's sum differentiated by the extinction of what surrounds a sphere: with leaping, and by the
    reference."""

    def loss(extinction: Array, leaps: tuple, adjoint: Literal["replay", "direct"]) -> Array:
        levels = jnp.stack([extinction, extinction, jnp.full_like(extinction, 3.0)])
        transfer = jv.TransferFunction([0.0, 0.3, 1.0], np.ones((3, 3)), levels)
        march = jv.March(0.1, (*leaps, jv.AlphaCorrection()), max_samples=64)
        image = jv.render(volume, transfer, camera, march, outputs="rgba", adjoint=adjoint)
        return jnp.sum(image.rgba[..., 3])

    slope = jax.grad(loss)
    return slope(extinction, (jv.SpaceLeaping(),), "replay"), slope(extinction, (), "direct")


@entry(
    "jaxvol.SpaceLeaping",
    "extinction of the region, per length",
    (1.0, 1e-2, 1e-6, 1e-12, 1e-24, 1e-36, 0.0),
    "relative error of the gradient",
    "SpaceLeaping",
    limit=0.05,
)
def gradients_of_what_is_leapt_over(extinction: float, size: int) -> dict[str, float]:
    """How transparent may a region be and still get a gradient under space leaping?

    What has any extinction above 0 is marched and has its gradient; what has none is leapt over and has none,
    although it would. A fit that should make invisible regions visible must start above 0, or not leap."""
    volume = jv.phantom("sphere", 25)
    camera = jv.Camera.looking_at(volume, size=(16, 16))
    with_leaps, exact = _gradients(volume, camera, jnp.asarray(extinction, jnp.float32))
    return {"SpaceLeaping": float(abs(with_leaps - exact) / abs(exact))}
