"""Samples at given points of a scene, shaded without an image around them."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.lighting.shading import Sample, Shader, Surroundings
from jaxvol.scene.space import Affine


def surroundings(volume, transfer):
    return Surroundings(volume, transfer, Affine(volume))


def sample_at(around, point, transmittance, pixel, direction=(0.0, 0.0, 1.0)):
    """The sample of a ray in this direction at a world point."""
    point = apart(point)
    measured = around.classification.at(around.space.coordinate(point))
    color, extinction = around.classification.classify(measured)
    toward = apart(jnp.asarray(direction, extinction.dtype))
    return Sample(point, toward, measured, color, extinction, transmittance, (pixel[0], pixel[1]))


def shaded(lighting, volume, transfer, points, transmittance=None, pixels=None, *, together=False):
    """The shaded colours of many points, each alone, or `together` as engines shade them, in twice the time
    to compile."""
    around = surroundings(volume, transfer)
    transmittance = jnp.ones(len(points)) if transmittance is None else transmittance
    pixels = jnp.zeros((len(points), 2), jnp.int32) if pixels is None else pixels
    shader = Shader.of(lighting, around)
    samples = jax.vmap(partial(sample_at, around))(points, transmittance, pixels)
    return jnp.stack((shader if together else jax.vmap(shader))(samples), axis=-1)


program = eqx.filter_jit(shaded)


def colors_of(lighting, volume, transfer, points, transmittance=1.0, pixels=None):
    """The same of up to 64 points, by one program."""
    count = len(points)
    points = np.resize(np.asarray(points, np.float32), (64, 3))
    pixels = np.resize(np.asarray([(0, 0)] if pixels is None else pixels, np.int32), (64, 2))
    transmittance = np.resize(np.float32(transmittance), 64)
    return np.asarray(program(lighting, volume, transfer, points, transmittance, pixels))[:count]


def check_gradient(value_and_gradient, scene, leaves, *, step, rtol, atol=0.0, least=0.0):
    """The gradient by each leaf is the central difference along a random direction of it; the value
    comes from the same program. `least`: slopes are at least so large, so that something is compared."""
    random, gradient = np.random.default_rng(0), value_and_gradient(scene)[1]
    for name, where in leaves.items():
        leaf = np.asarray(where(scene))
        along = random.normal(size=leaf.shape)

        def value(sign, where=where, moved=leaf, along=along):
            return float(
                value_and_gradient(eqx.tree_at(where, scene, jax.device_put(moved + sign * step * along)))[0]
            )

        expected = (value(1) - value(-1)) / (2 * step)
        assert abs(expected) > least, (name, expected)
        slope = np.sum(np.asarray(where(gradient)) * along)
        np.testing.assert_allclose(slope, expected, rtol=rtol, atol=atol, err_msg=name)


def image_of_reference(volume, transfer, camera, march, lighting):
    """The image by the reference engine, ray by ray."""
    origins, directions = camera.rays()

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0))
    @partial(jax.vmap, in_axes=(0, None))
    def image(column, row):
        line = volume, transfer, origins[row, column], directions[row, column], march
        return jv.render_ray_reference(*line, pixel=(column, row), lighting=lighting).rgba

    return np.asarray(image(*(np.arange(n) for n in camera.size)))


def in_double(scene):
    """With float64 leaves, voxels among them. Made where 64-bit types are enabled."""
    return jax.tree.map(
        lambda leaf: jax.device_put(np.asarray(leaf, float)) if eqx.is_inexact_array(leaf) else leaf, scene
    )
