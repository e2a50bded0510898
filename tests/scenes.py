"""Small scenes of the same shapes, so that all test files share their compiled programs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.march.march import Quadrature


QUADRATURES = get_args(Quadrature)
RESOLUTION = 24
SIZE = (20, 16)

# eight control points, for phantoms scaled to [0, 1]
SOFT = [
    (0.0, (0.1, 0.2, 0.9), 0.0),
    (0.1, (0.2, 0.3, 0.8), 0.0),
    (0.25, (0.3, 0.9, 0.2), 0.1),
    (0.4, (0.9, 0.4, 0.1), 0.3),
    (0.55, (0.9, 0.8, 0.2), 0.2),
    (0.7, (0.6, 0.6, 0.6), 0.6),
    (0.85, (0.9, 0.9, 0.9), 0.8),
    (1.0, (1.0, 1.0, 1.0), 0.9),
]


def slow(*cases: Any) -> list[Any]:
    """Parameters with which a test is slow."""
    marks = pytest.mark.slow
    return [pytest.param(*(c if isinstance(c, tuple) else (c,)), marks=marks) for c in cases]


def soft_transfer(unit_distance: float = 0.5) -> jv.TransferFunction:
    """Transparent below 0.1, denser above."""
    return jv.TransferFunction.from_points(SOFT, unit_distance)


def uniform_transfer(extinction: float, color=(1.0, 1.0, 1.0)) -> jv.TransferFunction:
    """The same colour and extinction for every value."""
    return jv.TransferFunction(np.linspace(0, 1, 8), np.tile(color, (8, 1)), np.full(8, extinction))


def scaled_phantom(name: str, resolution: int = RESOLUTION) -> jv.Volume:
    """A phantom with float32 values in [0, 1]."""
    volume = jv.phantom(name, resolution)
    top = 255.0 if volume.data.dtype == jnp.uint8 else 1.0
    return jv.Volume(np.asarray(volume.data, np.float32) / top, volume.spacing, volume.origin)


def anisotropic_noise(seed: int = 0) -> jv.Volume:
    """Random values at the nodes of a grid with three different spacings, away from the origin."""
    data = np.random.default_rng(seed).random((RESOLUTION,) * 3, dtype=np.float32)
    return jv.Volume(data, spacing=(0.05, 0.08, 0.11), origin=(0.3, -1.2, 0.4))


VOLUMES: dict[str, Callable[[], jv.Volume]] = {
    "sphere": lambda: scaled_phantom("sphere"),
    "cut_block": lambda: scaled_phantom("cut_block"),
    "noise": anisotropic_noise,
}


def with_voxels(volume: jv.Volume, place, value) -> jv.Volume:
    """A volume with a value at some of its voxels, unchecked."""
    data = np.array(volume.data)
    data[place] = value
    return eqx.tree_at(lambda v: v.data, volume, jax.device_put(data))


def around(volume: jv.Volume, size: tuple[int, int] = SIZE) -> jv.Camera:
    """A camera that sees the whole volume, from an asymmetric direction."""
    return jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=size)


def inside(volume: jv.Volume, size: tuple[int, int] = SIZE) -> jv.Camera:
    """A camera inside the volume."""
    low, high = map(np.asarray, volume.corners)
    return jv.Camera(low + np.float32(0.4) * (high - low), high, (0, 0, 1), 70.0, size=size)


def orthographic(volume: jv.Volume, size: tuple[int, int] = SIZE) -> jv.Camera:
    """An orthographic camera outside the volume, looking along +z."""
    low, high = volume.corners
    low, high = np.asarray(low), np.asarray(high)
    center, extent = (low + high) / 2, high - low
    position = center - np.array([0, 0, extent[2]])
    return jv.Camera(position, center, (0, 1, 0), size=size, parallel_scale=0.55 * extent[1])


LEAVES: dict[str, Callable] = {
    "voxels": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "origin": lambda s: s[0].origin,
    "colors": lambda s: s[1].colors,
    "extinction": lambda s: s[1].extinction,
    "position": lambda s: s[2].position,
    "focal_point": lambda s: s[2].focal_point,
    "view_up": lambda s: s[2].view_up,
    "view_angle": lambda s: s[2].view_angle,
    "window": lambda s: s[2].window,
    "step": lambda s: s[3].step,
}
"""Differentiable leaves of a scene (volume, transfer function, camera, march)."""

CAMERAS = {"around": around, "inside": inside, "orthographic": orthographic}

# They cut all of `VOLUMES`; the cameras inside of these lie inside the box, two of them before the plane.
BOX, PLANE = (-0.45, 0.9, -0.9, 0.3, -0.7, 1.9), ((0.6, -0.4, 0.8), (-0.6, 0.8, -0.3))


@contextmanager
def in_float64() -> Iterator[None]:
    """Enable 64-bit types in JAX. Create float64 arrays inside the context, or cast with `to_float64`."""
    # named so since jax 0.8
    home: Any = jax if hasattr(jax, "enable_x64") else import_module("jax.experimental")
    with home.enable_x64(True):
        yield


rendered, rendered_rays = eqx.filter_jit(jv.render), eqx.filter_jit(jv.render_rays)
"""An image by one program, where one by stages would be five that no other test needs."""


def same_trees(one, other) -> bool:
    """Whether all leaves are equal; by NumPy, which needs no program."""
    return bool(eqx.tree_equal(*jax.device_get((one, other))))


def to_float64(tree):
    """A copy with float64 leaves; voxels keep their type."""

    def double(leaf):
        if eqx.is_inexact_array(leaf) and leaf.ndim < 3:
            return jax.device_put(np.asarray(leaf, np.float64))
        return leaf

    return jax.tree.map(double, tree)


@eqx.filter_jit
def drawn(noise, column, row, dtype):
    return jax.vmap(lambda c, r: noise((c, r), dtype))(column, row)


def random_numbers(transform, camera):
    """The transform's random number for every pixel, row by row."""
    width, height = camera.size
    row, column = (index.reshape(-1).astype(np.int32) for index in np.mgrid[:height, :width])
    return np.asarray(drawn(transform.noise, column, row, camera.position.dtype), np.float64)


@eqx.filter_jit
def reference_image(volume, transfer, camera, march):
    """Every pixel by the reference engine."""

    def one(column, row):
        origin, direction = (jnp.stack(part) for part in camera.ray(column, row))
        return jv.render_ray_reference(volume, transfer, origin, direction, march, pixel=(column, row))

    width, height = camera.size
    across = jax.vmap(one, in_axes=(0, None))
    return jax.vmap(across, in_axes=(None, 0))(jnp.arange(width), jnp.arange(height))
