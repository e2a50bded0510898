"""Is an isosurface where it should be? Spheres, planes and plateaus; normals; gradients of one ray."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.compositing.isosurface import Crossing
from jaxvol.compositing.selection import RaySampler
from jaxvol.scene.space import Affine, enter, world_gradient
from jaxvol.scene.transfer import classification_of

from ..modes import classified
from ..scenes import RESOLUTION, rendered_rays, soft_transfer


RAYS = 64
STRAIGHT, STEEP = [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]


def seen(volume, origins, directions, step, value):
    """What rays see; always so many that all tests share a program."""
    origins, directions = (np.resize(np.asarray(part, float), (RAYS, 3)) for part in (origins, directions))
    march = jv.March(step)
    mode = jv.Isosurface(value)
    return rendered_rays(volume, soft_transfer(), origins, directions, march, compositing=mode)


def ramp(values, spacing=0.1):
    """A volume whose value depends on x alone; the last value goes on."""
    line = np.pad(np.asarray(values, np.float32), (0, RESOLUTION - len(values)), mode="edge")
    return jv.Volume(np.broadcast_to(line[:, None, None], (RESOLUTION,) * 3).copy(), [spacing] * 3)


def sphere_errors(radius):
    """Root mean square errors of depth and normal of a sphere, relative to its radius, where values are the
    distances from its center, for rays towards points inside it."""
    line = np.linspace(-1, 1, RESOLUTION)
    data = np.sqrt(sum(axis**2 for axis in np.meshgrid(line, line, line, indexing="ij")))
    volume = jv.Volume(data.astype(np.float32), [2 / (RESOLUTION - 1)] * 3, [-1.0] * 3)
    random = np.random.default_rng(0)
    origins = random.normal(size=(RAYS, 3))
    origins *= 3 / np.linalg.norm(origins, axis=-1, keepdims=True)
    directions = radius / 3 * random.uniform(-1, 1, (RAYS, 3)) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found = seen(volume, origins, directions, 0.03, radius)
    toward = -np.sum(origins * directions, axis=-1)
    depth = toward - np.sqrt(toward**2 - (9 - radius**2))
    # values grow outwards, so that normals point inwards
    normal = -(origins + depth[:, None] * directions) / radius
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1), 1, atol=1e-5)
    off = np.asarray(found.depth, np.float64) - depth, np.asarray(found.normal, np.float64) - normal
    return [np.sqrt(np.mean(error**2)) / scale for error, scale in zip(off, (radius, 1), strict=True)]


def test_a_sphere_is_met_to_second_order():
    """In nodes per radius."""
    radii = np.array([0.3, 0.45, 0.65, 0.95])
    errors = np.array([sphere_errors(radius) for radius in radii])
    for of in errors.T:
        order = -np.polyfit(np.log(radii), np.log(of), 1)[0]
        assert 1.7 < order < 2.5, errors


def test_a_plane_is_exact_up_to_the_exit():
    """The last values lie in the last part of a step, which is cut off without being asked for. Behind the
    surface, no sample is taken."""
    volume = ramp(np.linspace(0.0, 1.0, RESOLUTION), 1 / (RESOLUTION - 1))
    for value in (0.004, 0.33, 0.777, 0.985, 0.9999):
        found = seen(volume, [[-1.0, 0.2, 0.21]] * 2, [STRAIGHT, STEEP], 0.07, value)  # the second one misses
        color, _ = classified(soft_transfer(), value)
        parts = found.depth, found.rgba, found.normal, found.samples
        depth, rgba, normal, samples = (np.asarray(part)[:2] for part in parts)
        np.testing.assert_allclose(depth, [1 + value, np.inf], rtol=1e-6)
        np.testing.assert_allclose(rgba, [[*color, 1.0], [0.0] * 4], atol=1e-6)
        np.testing.assert_allclose(normal, [[-1.0, 0, 0], [0, 0, 0]], atol=1e-6)
        np.testing.assert_array_equal(samples, [int(value / 0.07) + 1, 0])


def test_what_lies_on_the_value_is_not_below_it():
    """Values that reach 1 and stay there, or leave 1; and the volume's faces are no surface."""
    for values, expected in (
        ([0, 0, 0.5, 1], 1 + 0.3),
        ([1, 1, 1, 0.5, 0], 1 + 0.2),
        ([1], np.inf),
        ([2], np.inf),
    ):
        found = seen(ramp(values), [[-1.0, 0.2, 0.2]], [STRAIGHT], 0.07, 1.0)
        np.testing.assert_allclose(found.depth, expected, rtol=1e-6)


@jax.jit
def at_crossing(volume, value, origin, direction, front, back, rises):
    """Depth, its derivative by the value, and normal, of one ray that crosses the value between depths."""
    value, front, back, rises = map(jnp.asarray, (value, front, back, rises))
    space, pixel = Affine(volume), (jnp.int32(0), jnp.int32(0))
    ray = enter(space, apart(jnp.stack(origin)), apart(jnp.stack(direction)), pixel)
    gradient = partial(world_gradient, volume, space.local)
    sampler = RaySampler(ray, classification_of(soft_transfer(), volume), gradient=gradient, space=space)

    def depth(value):
        mode = eqx.tree_at(lambda mode: mode.value, jv.Isosurface(0.0), value)
        return mode.pixel(sampler, Crossing(front, back, rises))[1]

    found, slope = jax.value_and_grad(depth)(value)
    return found, slope, jv.Isosurface(0.0).normal(sampler, found)


@pytest.mark.parametrize(("rises", "values"), [(True, [0, 0, 0.5, 1, 1]), (False, [1, 1, 1, 0.5, 0])])
def test_a_plateau_on_the_value_leaves_its_gradient(rises, values):
    """Values that change by 5 for each unit of length, and are 1 on one side."""
    ends = (0.25, 0.32) if rises else (0.18, 0.25)
    depth, slope, normal = at_crossing(ramp(values), 1.0, [-1.0, 0.2, 0.2], STRAIGHT, *ends, rises)
    np.testing.assert_allclose(depth, 0.3 if rises else 0.2, rtol=1e-6)
    np.testing.assert_allclose(slope, 1 / 5 if rises else -1 / 5, rtol=1e-4)
    np.testing.assert_allclose(normal, [-1.0 if rises else 1.0, 0, 0], atol=1e-6)


def test_normals_are_those_of_the_world():
    """Of values that are linear in it, on a grid of three spacings; 0 where values do not change."""
    spacing, slope = np.array([0.05, 0.08, 0.11]), np.array([0.5, -0.3, 0.4])
    grid = np.stack(np.meshgrid(*(s * np.arange(RESOLUTION) for s in spacing), indexing="ij"), -1)
    for data, expected in ((grid @ slope, -slope / np.linalg.norm(slope)), (0 * grid[..., 0], [0.0] * 3)):
        volume = jv.Volume(data.astype(np.float32), spacing)
        *_, normal = at_crossing(volume, 0.4, [-1.0, 0.9, 0.8], [0.8, 0.0, 0.6], 0.0, 0.5, True)
        np.testing.assert_allclose(normal, expected, atol=1e-4)
