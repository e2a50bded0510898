"""Where does shading by gradients fail? Where noise is as high as the values' rise."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol.lighting import Phong

from .entry import Entry, colors


SIDE = 32
RISE = 10.0
"""Value units per voxel, at the surface."""


@cache
def random() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(SIDE,) * 3)


def noisy_ball(noise: float) -> jv.Volume:
    """A ball whose values fall by `RISE` per voxel from its middle, on [-1, 1]³. The noise has this standard
    deviation, in units of the rise per voxel."""
    axis = np.arange(SIDE) - (SIDE - 1) / 2
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    data = RISE * (SIDE / 3 - np.sqrt(x**2 + y**2 + z**2) + noise * random())
    return jv.Volume(data.astype(np.float32), [2 / (SIDE - 1)] * 3, [-1.0] * 3)


def off(noise: float, size: int) -> dict[str, float]:
    outward = np.random.default_rng(1).normal(size=(4096, 3))
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    points = jnp.asarray((SIDE - 1) / 2 + SIDE / 3 * outward, jnp.float32)
    volume = noisy_ball(noise)

    @jax.jit
    @jax.vmap
    def gradient(at: jax.Array) -> jax.Array:
        return jnp.stack(volume.gradient((at[0], at[1], at[2])))

    found = np.asarray(gradient(points), np.float64)
    cosine = np.abs(np.sum(found * outward, axis=-1)) / np.linalg.norm(found, axis=-1)
    return {"angle": float(np.rad2deg(np.mean(np.arccos(np.minimum(cosine, 1)))))}


def ball_picture(noise: float, size: int) -> np.ndarray:
    volume = noisy_ball(noise)
    transfer = jv.TransferFunction([-10.0, 10.0], np.ones((2, 3)), [0.0, 60.0])
    camera = jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=(size, size)).zoom(1.6)
    march = jv.March(0.02, (jv.SpaceLeaping(), jv.EarlyTermination(1e-3)))
    return colors(volume, transfer, camera, march, lighting=Phong())


NOISE = Entry(
    name="normals in noise",
    question="How much noise may values have before the normals of a surface are lost?",
    method="jaxvol.lighting.Phong",
    regime="noise, standard deviation / rise of values per voxel",
    values=(0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
    measure=off,
    metric="mean angle between a normal and that without noise, degrees",
    judged="angle",
    limit=10.0,
    does="A central difference of noise is as large as that of a rise of 0.7 standard deviations per voxel; "
    "interpolation halves it. Angles grow by some 28 degrees times the ratio, up to the 57 of random "
    "normals: what is nearly homogeneous is shaded by its noise. Smooth such volumes.",
    picture=ball_picture,
    shows="the ball, under a head light",
    pictured=(0.1, 1.0),
)

ENTRIES = (NOISE,)
