"""Where does accumulating opacity fail? Opaque rays, great extinction, short cells, early termination."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxvol as jv

from .entry import along_z, cube, entry, finite, ray_opacities, signed, uniform, value_and_slope


ALIGNED = (jv.AlphaCorrection(),)


def one_ray(volume: jv.Volume, extinction: Any, step: float, origin: Any, direction: Any) -> Array:
    """Opacity of a ray."""
    rays = jnp.stack([jnp.asarray(each, jnp.float32) for each in origin])[None], jnp.array([direction])
    return ray_opacities(volume, uniform(extinction), rays, jv.March(step, ALIGNED))[0]


ORIGIN, AHEAD = (0.1, 0.2, -3.0), (0.0, 0.0, 1.0)
through = value_and_slope(lambda extinction: one_ray(cube(), extinction, 0.5, ORIGIN, AHEAD))
"""A cube of side 2, in four steps, by its extinction."""


@entry(
    "jaxvol.render",
    "optical depth of a ray",
    (1.0, 3.0, 6.0, 9.0, 12.0, 14.0, 16.0, 18.0, 24.0, 40.0),
    "error",
    "gradient, relative",
    limit=0.1,
)
def gradients_of_opaque_rays(depth: float, size: int) -> dict[str, float]:
    """At which optical depth does the gradient by the extinction drown in rounding?

    The opacity stays exact to rounding. Its derivative is the transmittance left, which float32 cannot tell
    from 0 beside an opacity that rounds to 1: a fit that starts this opaque does not move."""
    extinction = np.float64(np.float32(depth / 2))
    value, slope = through(extinction)
    exact = 2 * np.exp(-2 * extinction)
    return {
        "gradient, relative": float(abs(slope - exact) / exact),
        "opacity": float(abs(value + np.expm1(-2 * extinction))),
    }


@jax.jit
def _image_and_gradient(volume: jv.Volume, camera: jv.Camera, extinction: Array) -> tuple[Array, tuple]:
    def loss(given: tuple[jv.Volume, jv.Camera, Array]) -> tuple[Array, Array]:
        volume, camera, extinction = given
        transfer = jv.TransferFunction([0.1, 0.5], np.ones((2, 3)), jnp.stack([0 * extinction, extinction]))
        image = jv.render(volume, transfer, camera, jv.March(0.25, ALIGNED), outputs="rgba").rgba
        return jnp.sum(image), image

    gradient, image = jax.grad(loss, has_aux=True)((volume, camera, extinction))
    return image, gradient


@entry(
    "jaxvol.TransferFunction",
    "extinction, per length (the cube is 2 long)",
    (1.0, 1e2, 1e4, 1e6, 1e12, 1e20, 1e30, 1e38),
    "error of the opacity; NaN if anything is not finite",
    "not finite",
    outcome="bounded",
    limit=0.0,
)
def extinction_without_bound(extinction: float, size: int) -> dict[str, float]:
    """Do an image and its gradients stay finite for any extinction?

    Opacity is 1 - exp(-extinction · width), which tends to 1. Image and gradients with respect to voxels,
    camera and extinction are finite up to the largest float32."""
    camera = along_z(8, 0.7)
    found = _image_and_gradient(jv.phantom("sphere", 32), camera, jnp.asarray(extinction, jnp.float32))
    value, slope = through(extinction)
    exact = -np.expm1(-2 * np.float64(np.float32(extinction)))
    return {
        "not finite": 0.0 if finite((found, value, slope)) else np.nan,
        "opacity of a cube": float(abs(value - exact)),
    }


past_edge = value_and_slope(lambda x: one_ray(cube(), 1.0, 0.25, (x, -1.5, 0.1), (1.0, 1.0, 0.0)))
"""A ray that cuts an edge of the cube, by its place x."""


@entry(
    "jaxvol.AlphaCorrection",
    "length inside / half the side of the cube",
    (0.9, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 2e-7),
    "error",
    "opacity",
    outcome="bounded",
    limit=1e-6,
)
def grazing_exits(length: float, size: int) -> dict[str, float]:
    """How short may the part of a ray inside the volume be?

    The width of the cut cell is a difference of two distances, so its error is that of rounding them, however
    short it is: some 1e-7 of the volume's size. The relative error of a nearly transparent pixel grows, that
    of the gradient does not."""
    x = np.float64(np.float32(0.5 - length / np.sqrt(2)))
    value, slope = past_edge(x)
    exact = (0.5 - x) * np.sqrt(2)
    return {
        "gradient, relative": float(abs(slope + np.sqrt(2) * np.exp(-exact)) / (np.sqrt(2) * np.exp(-exact))),
        "opacity, relative": float(abs(value + np.expm1(-exact)) / max(-np.expm1(-exact), 1e-30)),
        "opacity": float(abs(value + np.expm1(-exact))),
    }


@value_and_slope
def spaced(spacing: Array) -> Array:
    """Opacity of a cube of 8 spacings in steps of 1/4, by the spacing along the ray."""
    along = jnp.stack([jnp.full_like(spacing, 0.25), jnp.full_like(spacing, 0.25), spacing])
    volume = jv.Volume(np.ones((9, 9, 9), np.float32), along, [-1.0] * 3)
    return one_ray(volume, 1.0, 0.25, ORIGIN, AHEAD)


@entry(
    "jaxvol.AlphaCorrection",
    "width of the last cell e / step",
    (0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-5, 0.0),
    "error",
    "gradient, relative",
    outcome="bounded",
    limit=0.01,
)
def exits_at_the_end_of_a_cell(part: float, size: int) -> dict[str, float]:
    """Does the gradient by what moves the exit hold as the last cell gets narrower?

    The gradient is exact for any e, and where the exit lies exactly at the end of a cell: then the last cell
    is not cut, but its width is the exit's to change. This happens in orthographic views along an axis with
    steps of one voxel."""
    spacing = np.float64(np.float32(0.25 * (1 + part / 8)))
    value, slope = spaced(spacing)
    exact = np.exp(-8 * spacing)
    return {
        "gradient, relative": float(abs(slope - 8 * exact) / (8 * exact)),
        "opacity": float(abs(value - (1 - exact))),
    }


@cache
def _head(size: int) -> tuple[jv.Volume, jv.TransferFunction, jv.Camera]:
    """README's first scene, coarser."""
    points = [(60, (0.0, 0.0, 0.0), 0.0), (90, (0.8, 0.7, 0.5), 0.02), (255, (1.0, 1.0, 1.0), 0.9)]
    volume, transfer = jv.phantom("head", 48), jv.TransferFunction.from_points(points, unit_distance=0.02)
    camera = jv.Camera((3.0, -5.0, 1.5), volume.center, (0, 0, 1), 30, size=(size, size))
    return volume, transfer, camera


@jax.jit
def _terminated(scene: tuple, left: Array, factor: Array) -> tuple[Array, Array]:
    """The sum of all pixels' derivative by a factor of all extinctions, and the image."""
    volume, transfer, camera = scene

    def loss(factor: Array) -> tuple[Array, Array]:
        scaled = jv.TransferFunction(transfer.values, transfer.colors, factor * transfer.extinction)
        march = jv.March(0.02, (jv.SpaceLeaping(), *ALIGNED, jv.EarlyTermination(left)))
        image = jv.render(volume, scaled, camera, march, outputs="rgba").image((0, 0, 0))
        return jnp.sum(image), image

    return jax.grad(loss, has_aux=True)(factor)


NEVER = 1e-30


@cache
def terminated(left: float, factor: float, size: int) -> tuple[float, np.ndarray]:
    slope, image = _terminated(_head(min(size, 64)), jnp.asarray(left), jnp.asarray(factor))
    return float(slope), np.asarray(image, np.float64)


@entry(
    "jaxvol.EarlyTermination",
    "opacity_left",
    (1e-6, 1e-5, 1e-4, 3e-4, 1e-3, 1 / 255, 0.02, 0.1),
    "error (of gradients: relative)",
    "opaque: gradient",
    limit=0.05,
    picture=lambda left, size: signed(terminated(left, 1.0, size)[1] - terminated(NEVER, 1.0, size)[1], 0.05),
    shows="error of the image of an opaque head phantom, ± 0.05 from blue to red",
    pictured=(1e-4, 0.1),
    size=32,
)
def early_termination_in_gradients(left: float, size: int) -> dict[str, float]:
    """How much transmittance may be left out before the gradient is wrong?

    The image errs by at most opacity_left. The gradient by the extinction of what is opaque lacks T log(1/T)
    of every ray, with one sign, so that it is wrong by far more. For fits take 0.0001, or none."""
    found = {}
    for name, factor in (("opaque: gradient", 1.0), ("translucent: gradient", 0.05)):
        exact, truth = terminated(NEVER, factor, size)
        slope, image = terminated(left, factor, size)
        found[name] = abs(slope - exact) / abs(exact)
        if factor == 1:
            found["opaque: image, largest"] = float(np.abs(image - truth).max())
    return found
