"""Phong: are normals, colours and gradients those of the formula, in every engine?"""

from itertools import product
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import jaxvol as jv
from jaxvol._util.vec3 import apart
from jaxvol.engine.acceleration import VolumeAcceleration, slopes_of, with_words, words_of
from jaxvol.lighting import DirectionalLight, HeadLight, Phong, PointLight
from jaxvol.lighting.shading import Shader
from jaxvol.scene.space import Affine, world_gradient

from ..scenes import BOX, PLANE, RESOLUTION, SIZE, around, in_float64, rendered, slow
from .samples import check_gradient, image_of_reference, in_double, sample_at, surroundings


SUN = DirectionalLight((0.4, 0.9, -0.6), (0.9, 1.0, 1.2))
LIGHTS: dict[str, Any] = {
    "head": HeadLight((1.0, 0.9, 0.8)),
    "sun": SUN,
    "all": (HeadLight(), SUN, PointLight((0.6, -2.0, 1.3), (5.0, 4.0, 3.0))),
}


# ---------------------------------------------------------------- normals

SHAPE = (6, 5, 7)
"""A different number of nodes along each axis, so that none is taken for another."""


def accelerated(volume):
    """The volume as engines fetch it, with slopes stored where they can be."""
    return with_words(volume, [words_of(volume)], [slopes_of(volume)])


@jax.jit
def gradients(volume, at):
    return jax.vmap(lambda c: jnp.stack(volume.gradient(apart(c)), axis=-1))(at)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [*((kind, SHAPE) for kind in ("uint8", "int8", "int16", "float32")), ("uint8", (2, 2, 2))],
)
def test_the_gradient_is_interpolated_between_central_differences(kind, shape):
    """At the border, too, where differences are one-sided, and also where slopes are stored."""
    random = np.random.default_rng(0)
    data = random.uniform(-100, 100, shape) + (100 if kind == "uint8" else 0)
    volume = jv.Volume(data.astype(kind), (0.5, 0.8, 1.1))
    inner = random.uniform(0, np.asarray(shape) - 1, (400, 3)).astype(np.float32)
    at = np.concatenate([inner, np.indices(shape, np.float32).reshape(3, -1).T])
    nodes = np.gradient(np.asarray(volume.data, float), *np.asarray(volume.spacing, float))
    expected = np.stack([map_coordinates(part, at.T, order=1) for part in nodes], axis=-1)
    stored = slopes_of(volume) is not None
    assert stored == (kind in ("uint8", "int8"))
    for each in (volume, accelerated(volume)) if stored else (volume,):
        np.testing.assert_allclose(gradients(each, at), expected, atol=2e-3)


def test_slopes_are_stored_for_those_who_read_them():
    march = jv.March(0.1)
    for lighting, stored in ((None, False), (Phong(), True)):
        assert (VolumeAcceleration.of(shells(), soft(), march, lighting).slopes[0] is not None) == stored


def normals(volume, space, points):
    """Unit gradients at world points."""
    gradient = jax.jit(jax.vmap(lambda point: jnp.stack(world_gradient(volume, space, apart(point)))))
    found = np.asarray(gradient(np.float32(points)))
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


def angles(a, b):
    """Angles in degrees between unit vectors; by the chord, as a cosine near 1 is rounded."""
    return np.rad2deg(2 * np.arcsin(np.linalg.norm(a - b, axis=-1) / 2))


def test_normals_are_those_of_the_world_under_a_toroidal_map():
    probe, shape = jv.ToroidalMap(20.0, 30.0, (0.9, 2.3), (0.8, 2.4), (0.0, 60.0)), (64, 60, 56)
    space = probe.locate(Affine(jv.Volume(empty := np.zeros(shape, np.float32))), jv.Volume(empty))
    to_world = jax.jit(jax.vmap(lambda c: jnp.stack(space.point(apart(c)))))
    ramp = np.array([0.5, -0.7, 0.4]) / np.linalg.norm([0.5, -0.7, 0.4])
    nodes = np.indices(shape).reshape(3, -1).T.astype(np.float32)
    points = np.asarray(to_world(nodes))
    volume = jv.Volume((points @ ramp).astype(np.float32).reshape(shape))
    inner = points.reshape(*shape, 3)[3:-3:7, 3:-3:7, 3:-3:7].reshape(-1, 3) + 0.1
    assert np.max(angles(normals(volume, space, inner), ramp[None])) < 0.5


# ---------------------------------------------------------------- colours of samples

COLOR = np.array([0.8, 0.5, 0.3])
POINT = np.array([0.1, 0.2, 0.3])


def unit(*vector):
    return np.asarray(vector) / np.linalg.norm(vector)


VIEWS = [unit(0, 0, 1), unit(0.3, -0.2, 0.9), unit(-0.8, 0.5, 0.1), unit(0.1, 0.2, -0.9)]


def of_gradient(gradient):
    """A volume whose values have this gradient."""
    nodes = np.indices((4, 4, 4)).reshape(3, -1).T - 1.5
    data = (nodes @ np.asarray(gradient, float)).reshape(4, 4, 4)
    return jv.Volume(data.astype(np.float32), origin=(-1.5, -1.5, -1.5))


@eqx.filter_jit
@eqx.filter_value_and_grad(has_aux=True)
def all_slopes(scene, viewer):
    """The sum of a sample's colour, the colour, and the derivative of the sum by volume and lighting."""
    (volume, lighting), zero = scene, jnp.zeros(2, jnp.int32)
    around = surroundings(volume, jv.TransferFunction((0.0, 1.0), np.ones((2, 3)), (1.0, 1.0)))
    sample = sample_at(around, jnp.asarray(POINT, viewer.dtype), jnp.ones((), viewer.dtype), zero, -viewer)
    sample = sample._replace(color=apart(jnp.asarray(COLOR, viewer.dtype)))
    color = jnp.stack(Shader.of(lighting, around)(sample))
    return jnp.sum(color), color


def color_of(lighting, gradient, viewer):
    scene = of_gradient(gradient), lighting
    return np.asarray(all_slopes(scene, np.float32(viewer))[0][1])


def by_formula(normal, viewer, lights, power=10.0):
    """Phong's formula with the default coefficients, for (direction to a light, irradiance)."""
    normal = np.asarray(normal) * (-1 if np.dot(normal, viewer) < 0 else 1)
    color = 0.1 * COLOR
    for toward, irradiance in lights:
        facing = np.dot(normal, toward)
        if facing > 0:
            mirrored = max(np.dot(2 * facing * normal - toward, viewer), 0)
            color = color + (COLOR * 0.7 * facing + 0.2 * mirrored**power) * irradiance
    return color


def test_a_sample_is_lit_by_the_formula():
    """Ambient light counts once, both sides are lit, and a lamp's light falls with the square of its
    distance."""
    one, two, three = np.array([1.0, 0.5, 0.2]), np.array([0.5, 1.0, 2.0]), np.array([0.4, 0.8, 0.3])
    for normal, viewer, (i, toward) in product(VIEWS, VIEWS, enumerate(VIEWS)):
        other = VIEWS[i - 1]
        lights = HeadLight(one), DirectionalLight(-3 * toward, two), PointLight(POINT + 2 * other, 4 * three)
        expected = by_formula(normal, viewer, [(viewer, one), (toward, two), (other, three)])
        np.testing.assert_allclose(color_of(Phong(lights), normal, viewer), expected, atol=5e-5)


def test_a_plane_that_faces_the_head_light_has_vtks_colour_whatever_the_length_of_its_gradient():
    """A light of irradiance 1 is VTK's light of colour 1."""
    dark = DirectionalLight((0, 0, 1), (0, 0, 0)), PointLight((9, 9, 9), (0, 0, 0))
    for length in (1e-15, 1e-6, 1, 1e6, 1e15):
        found = color_of(Phong((HeadLight(), *dark)), length * VIEWS[1], VIEWS[1])
        np.testing.assert_allclose(found, 0.8 * COLOR + 0.2, atol=2e-5)


def test_without_a_gradient_there_is_ambient_light_and_no_derivative():
    scene = of_gradient((0, 0, 0)), Phong(LIGHTS["all"])
    (_, color), (slope, _) = all_slopes(scene, np.float32([0, 0, 1]))
    np.testing.assert_allclose(color, 0.1 * COLOR, rtol=1e-6)
    np.testing.assert_array_equal(slope.data, 0)


OF_SAMPLES = {
    "voxels": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "ambient": lambda s: s[1].ambient,
    "diffuse": lambda s: s[1].diffuse,
    "specular": lambda s: s[1].specular,
    "specular power": lambda s: s[1].specular_power,
    "irradiance of the head light": lambda s: s[1].lights[0].irradiance,
    "direction": lambda s: s[1].lights[1].direction,
    "irradiance": lambda s: s[1].lights[1].irradiance,
    "position of the lamp": lambda s: s[1].lights[2].position,
    "intensity": lambda s: s[1].lights[2].intensity,
}


def test_gradients_of_a_sample_match_central_differences():
    """Slow tests below are of images."""
    with in_float64():
        viewer = jax.device_put(np.asarray(VIEWS[1], float))
        lights = HeadLight(), DirectionalLight(-VIEWS[0]), PointLight(POINT + 2 * VIEWS[1], (3.0, 4.0, 5.0))
        scene = in_double((of_gradient(0.7 * unit(0.2, -0.1, 1)), Phong(lights)))

        def value_and_gradient(scene):
            (value, _), gradient = all_slopes(scene, viewer)
            return value, gradient

        check_gradient(value_and_gradient, scene, OF_SAMPLES, step=1e-6, rtol=1e-6, least=1e-3)


# ---------------------------------------------------------------- images


def shells(kind="uint8"):
    """Two nested balls with empty space around them, in values of 0 to 255."""
    axis = np.linspace(-1.4, 1.4, RESOLUTION)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    away, beside = np.linalg.norm(points, axis=-1), np.linalg.norm(points - [0.3, 0.2, -0.1], axis=-1)
    data = np.clip(160 * (1.1 - away), 0, 80) + np.clip(400 * (0.6 - beside), 0, 170)
    step = 2.8 / (RESOLUTION - 1)
    return jv.Volume(np.round(data).astype(kind), (step, step, step), (-1.4, -1.4, -1.4))


def soft():
    colors = [(0.1, 0.2, 0.9), (0.2, 0.3, 0.8), (0.3, 0.9, 0.2), (0.9, 0.4, 0.1), (0.9, 0.8, 0.2)]
    points = zip((0.0, 12.0, 60.0, 120.0, 255.0), colors, (0.0, 0.0, 0.2, 0.3, 0.9), strict=True)
    return jv.TransferFunction.from_points(list(points), 0.2)


def scene_of(transforms, kind="uint8", quadrature="left", size=SIZE):
    volume = shells(kind)
    return volume, soft(), around(volume, size), jv.March(0.11, transforms, quadrature)


LEAPING = jv.EmptySpaceJitter(4), jv.AlphaCorrection(), jv.SpaceLeaping(), jv.EarlyTermination(0.05)


@pytest.mark.parametrize(
    ("transforms", "kind", "light", "quadrature"),
    [
        (LEAPING, "uint8", "head", "midpoint"),
        *slow(
            ((jv.Jitter(3, "blue", front_residual=True), jv.AlphaCorrection()), "float32", "sun", "left"),
            ((jv.Clip(BOX, [PLANE]), jv.AlphaCorrection()), "uint8", "all", "preintegrated"),
            (LEAPING, "int16", "all", "left"),
        ),
    ],
)
def test_images_are_those_of_the_reference(transforms, kind, light, quadrature):
    scene, lighting = scene_of(transforms, kind, quadrature), Phong(LIGHTS[light])
    found = rendered(*scene, lighting=lighting)
    assert np.asarray(found.rgba)[..., :3].max() > 0.1
    np.testing.assert_allclose(found.rgba, image_of_reference(*scene, lighting), atol=2e-5)


# ---------------------------------------------------------------- gradients

STEP = 2e-5

LEAVES: dict[str, Any] = {
    "ambient": lambda s: s[4].ambient,
    "diffuse": lambda s: s[4].diffuse,
    "specular": lambda s: s[4].specular,
    "specular power": lambda s: s[4].specular_power,
    "irradiance of the head light": lambda s: s[4].lights[0].irradiance,
    "position of the lamp": lambda s: s[4].lights[1].position,
    "intensity": lambda s: s[4].lights[1].intensity,
    "direction": lambda s: s[4].lights[2].direction,
    "irradiance": lambda s: s[4].lights[2].irradiance,
    "voxels": lambda s: s[0].data,
    "spacing": lambda s: s[0].spacing,
    "extinction": lambda s: s[1].extinction,
    "colors": lambda s: s[1].colors,
    "position": lambda s: s[2].position,
    "step": lambda s: s[3].step,
}


def smooth_scene(quadrature):
    """A float64 scene without samples where the formula has a kink: all normals face viewer and lights.
    Values rise with z, from what is invisible to what is visible and on to what is invisible."""
    x, y, z = np.meshgrid(*(np.arange(6.0),) * 3, indexing="ij")
    data = 0.14 * z + 0.03 * np.sin(x) + 0.04 * np.cos(0.7 * y + 0.3 * z)
    colors = (0.9, 0.5, 0.2), (0.2, 0.8, 0.4), (0.8, 0.3, 0.7), (0.5, 0.6, 0.9)
    volume = jv.Volume(data.astype(np.float32), (0.3, 0.4, 0.5), (-0.9, -1.2, -1.5))
    camera = jv.Camera((0.7, -0.6, 7.0), (0.1, 0.05, 0.0), (0, 1, 0), 20.0, size=(4, 3))
    lamp = PointLight((0.5, 0.4, 6.0), (20.0, 18.0, 16.0))
    transfer = jv.TransferFunction((-0.2, 0.2, 0.5, 0.8), colors, (0.0, 0.0, 0.9, 0.0))
    lights = HeadLight(), lamp, DirectionalLight(-(camera.position - camera.focal_point))
    march = jv.March(0.23, (jv.Jitter(3), jv.AlphaCorrection()), quadrature)
    return in_double((volume, transfer, camera, march, Phong(lights)))


def loss(scene):
    image = jv.render(*scene[:4], lighting=scene[4], outputs="rgba")
    return jnp.sum(jnp.asarray(np.random.default_rng(3).uniform(0.2, 1, (3, 4, 4))) * image.rgba)


@pytest.mark.slow
@pytest.mark.parametrize("quadrature", ["midpoint", "preintegrated"])
def test_gradients_are_those_of_differences(quadrature):
    """Also by an extinction of 0, where invisible samples have their light. One-sided differences, since
    extinction is never negative; of second order."""
    with in_float64():
        scene, random = smooth_scene(quadrature), np.random.default_rng(4)
        program = eqx.filter_jit(eqx.filter_value_and_grad(loss))
        slopes, here = program(scene)[1], float(program(scene)[0])
        for leaf, where in LEAVES.items():
            direction = jnp.asarray(random.uniform(0.2, 1, where(scene).shape))
            if leaf == "extinction" and quadrature == "preintegrated":
                direction = direction.at[1].set(direction[0])  # both are 0: see `March`
            one, two = (
                float(program(eqx.tree_at(where, scene, where(scene) + n * STEP * direction))[0])
                for n in (1, 2)
            )
            expected = (4 * one - two - 3 * here) / (2 * STEP)
            assert abs(expected) > 1e-4, leaf
            found = float(jnp.sum(where(slopes) * direction))
            assert abs(found - expected) <= 1e-5 * abs(expected), (leaf, found, expected)


class Bell(jv.Field):
    """255 exp(-sharpness r²) around the middle of the volume."""

    sharpness: Any

    def value(self, volume, coordinate):
        middle = [(n - 1) / 2 for n in volume.shape]
        square = sum((c - m) ** 2 * h**2 for c, m, h in zip(coordinate, middle, volume.spacing, strict=True))
        return 255 * jnp.exp(-self.sharpness * square)


@pytest.mark.slow
def test_fields_are_shaded_and_have_gradients():
    """Whose parameters the replay must pull back from the normals, too. By a light from the side, since a
    head light on a sphere does not change with its sharpness."""
    with in_float64():
        volume = jv.Volume(np.zeros((8, 8, 8), np.float32), (0.4,) * 3, (-1.4,) * 3)
        constant = jv.TransferFunction((0.0, 255.0), np.ones((2, 3)), (0.5, 0.5))
        rest = in_double((volume, constant, around(volume, (4, 3)), jv.March(0.11), Phong(SUN)))

        @jax.jit
        @jax.value_and_grad
        def loss(sharpness):
            volume, transfer, camera, march, lighting = rest
            shown = eqx.tree_at(lambda v: v.field, volume, Bell(sharpness), is_leaf=lambda x: x is None)
            image = jv.render(shown, transfer, camera, march, lighting=lighting, outputs="rgba")
            return jnp.sum(image.rgba[..., :3])

        at, step = jnp.asarray(1.3), 1e-5
        expected = float(loss(at + step)[0] - loss(at - step)[0]) / (2 * step)
        assert abs(expected) > 1e-3
        np.testing.assert_allclose(loss(at)[1], expected, rtol=1e-6)
