"""Rays that end at given depths, and several rays a pixel: against closed forms, and against a clip by the
plane at which rays end."""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.scene.rendering import Details, pooled

from .. import oracle
from ..scenes import in_float64, to_float64, uniform_transfer
from ..switch import switch
from ..transforms import transforms
from .test_gradients import scene_of, weighed


SIGMA, SIZE, FINER = 0.7, (12, 10), 2
EXACT = jv.March(0.05, (jv.AlphaCorrection(), jv.SpaceLeaping()), "midpoint")
POSITION, HIGH = np.array([4.0, -5.0, 2.5]), np.array([2.0, 1.5, 1.0])


def chords(position, until, n):
    """Where n x n rays a pixel enter a box that a camera looks at, and how much of it they see."""
    (height, width), until = until.shape, np.kron(until, np.ones((n, n))).ravel()
    forward = unit(HIGH / 2 - position)
    right = unit(np.cross(forward, (0, 0, 1)))
    x, y = np.meshgrid(*((np.arange(n * m) + 0.5) / n - m / 2 for m in (width, height)))
    pixel = 2 * np.tan(np.radians(8)) / height
    way = forward + pixel * (x[..., None] * right - y[..., None] * np.cross(right, forward))
    way = (way / np.linalg.norm(way, axis=-1, keepdims=True)).reshape(-1, 3)
    near, far = oracle.box_interval(np.broadcast_to(position, way.shape), way, np.zeros(3), HIGH)
    return near, np.clip(np.minimum(far, until) - near, 0, None), (near < until) & (until < far)


def unit(v):
    return v / np.linalg.norm(v)


def pool(rays):
    return rays.reshape(SIZE[1], FINER, SIZE[0], FINER).mean(axis=(1, 3))


def test_a_uniform_box_is_seen_up_to_a_depth_by_several_rays_a_pixel():
    """And its gradients, by the depths and by the camera, are those of the closed form."""
    with in_float64():
        volume = jv.Volume(np.ones((5, 4, 3)), HIGH / (4, 3, 2))
        camera = jv.Camera(POSITION, HIGH / 2, (0, 0, 1), 16.0, size=SIZE)
        scene = volume, uniform_transfer(SIGMA)

        @jax.jit
        def found(position, until):
            def opacity(position, until):
                view = eqx.tree_at(lambda camera: camera.position, camera, position)
                how = {"march": to_float64(EXACT), "until": until}
                image = jv.render(*scene, view, antialias=FINER, **how)
                rays = jv.render_rays(*scene, *camera.rays(), **how)
                return image.rgba[..., 3].sum(), (image.rgba[..., 3], image.depth, rays.rgba[..., 3])

            return jax.value_and_grad(opacity, (0, 1), has_aux=True)(position, until)

        until = np.random.default_rng(0).uniform(5.5, 8.5, SIZE[::-1])
        until[::3], until[1, :2] = np.inf, (0, -1)
        (_, seen), (by_position, by_until) = jax.device_get(found(*jax.device_put((POSITION, until))))
    near, length, ends = chords(POSITION, until, FINER)
    left = np.exp(-SIGMA * length)
    opacity, slope = pool(1 - left), pool(np.where(ends, SIGMA * left, 0))
    depth = pool((1 - left) * (near + 1 / SIGMA) - length * left) / np.where(opacity > 0, opacity, 1)
    assert 0.1 < np.mean(slope > 0) < 0.9
    np.testing.assert_allclose(seen[0], opacity, atol=1e-12)
    np.testing.assert_allclose(seen[1], np.where(opacity > 0, depth, np.inf), rtol=1e-4)
    np.testing.assert_allclose(by_until, slope, atol=1e-12)
    for axis, nudge in enumerate(1e-5 * np.eye(3)):
        more, less = (np.exp(-SIGMA * chords(POSITION + n, until, FINER)[1]) for n in (nudge, -nudge))
        np.testing.assert_allclose(by_position[axis], pool(less - more).sum() / 2e-5, rtol=1e-5)
    alone = chords(POSITION, until, 1)[1]
    np.testing.assert_allclose(np.ravel(seen[2]), -np.expm1(-SIGMA * alone), atol=1e-12)


CUT = np.array([0.9, 0.8, 0.8]), np.array([0.4, -0.9, 0.5])
HOLLOW = 0.4, 1.2, 0.3, 1.1, 0.3, 1.1
"""A plane through the scene of `test_gradients`, and a normal toward its camera."""


EVERY = transforms(box=HOLLOW, planes=()) | {"clip": jv.Clip(planes=[CUT])}


@cache  # what checks numbers is not found in JAX's cache
def in_one_program(adjoint):
    """A loss, with its gradient, of a scene and a plane that clips rays or ends them."""

    def loss(given, clips):
        (volume, transfer, camera, march), (point, normal) = given
        clip = lambda march: march.transforms[list(EVERY).index("clip")].inner  # noqa: E731
        where = lambda march: (clip(march).origins, clip(march).normals)  # noqa: E731
        march = eqx.tree_at(where, march, (point[None], normal[None]))
        origins, directions = camera.rays()
        rate, height = directions @ normal, (origins - point[None, None]) @ normal
        until = jnp.where((rate < 0) & ~clips, -height / jnp.where(rate < 0, rate, 1), jnp.inf)
        image = jv.render(volume, transfer, camera, march, adjoint=adjoint, until=until)
        return weighed(image.rgba, image.depth), (image.rgba, image.depth)

    return eqx.filter_jit(eqx.filter_value_and_grad(loss, has_aux=True))


def in_both_ways(adjoint, on):
    """Image and depths, and gradients by all leaves and by the plane: clipped by it, and ending at it."""
    program = in_one_program(adjoint)
    for clips in (True, False):
        chosen = on | ({"clip"} if clips else set())
        given = [switch(each, name in chosen, name.title()) for name, each in EVERY.items()]
        scene = scene_of(tuple(given), "float64", most=128)
        (_, seen), found = jax.device_get(program(jax.device_put((scene, CUT)), np.asarray(clips)))
        yield seen, jax.tree.leaves((found[0][:3], found[0][3].step, found[1]))


@pytest.mark.parametrize("adjoint", ["replay", pytest.param("direct", marks=pytest.mark.slow)])
def test_rays_that_end_at_a_plane_see_what_a_clip_leaves(adjoint):
    """With every transform, through gaps that the plane cuts, too."""
    shifted, hollow = {"jitter", "shift", "alignment", "leaping"}, {"hollow", "alignment", "termination"}
    with in_float64():
        for on in (shifted, hollow | {"leaping"}):
            (clipped, of_clipped), (ended, of_ended) = in_both_ways(adjoint, on)
            assert 0.05 < np.mean(clipped[0][..., 3] > 0) < 0.9
            assert all(np.linalg.norm(part) > 0.1 for part in of_clipped[-2:])
            for expected, found in zip(clipped, ended, strict=True):
                np.testing.assert_allclose(found, expected, atol=1e-10)
            for expected, found in zip(of_clipped, of_ended, strict=True):
                np.testing.assert_allclose(found, expected, atol=1e-8 * float(1 + np.linalg.norm(expected)))


def test_a_pixel_of_several_rays_has_what_these_have():
    """Depth and normal as opacity weighs them, one of them invisible; of four invisible ones none."""
    opacity = np.array([[0.5, 0, 0, 0], [0.25, 0.25, 0, 0]], np.float32)
    depth = np.array([[1, np.inf, np.inf, np.inf], [2, 4, np.inf, np.inf]], np.float32)
    rgba = np.stack([opacity * n for n in (0.1, 0.2, 0.3, 1)], -1).astype(np.float32)
    normal = np.zeros((2, 4, 3), np.float32)
    normal[0, 0, 0] = normal[1, 0, 1] = normal[1, 1, 2] = 1
    some, samples = opacity > 0.3, np.arange(8, dtype=np.int32).reshape(2, 4)
    given: Any = jax.device_put((rgba, some, (depth, samples, some, normal)))
    found = jax.device_get(pooled(jv.Rendering(given[0], given[1], Details(*given[2])), 2))
    np.testing.assert_allclose(found.rgba[..., 3], [[0.25, 0]])
    np.testing.assert_allclose(found.details.depth, [[(0.5 + 0.5 + 1) / 1, np.inf]])
    np.testing.assert_allclose(
        found.details.normal, [[np.array([2, 1, 1]) / np.sqrt(6), (0, 0, 0)]], atol=1e-7
    )
    np.testing.assert_array_equal(found.details.samples, [[0 + 1 + 4 + 5, 2 + 3 + 6 + 7]])
    np.testing.assert_array_equal(found.exhausted, [[True, False]])
    np.testing.assert_array_equal(found.details.aligned, [[True, False]])
