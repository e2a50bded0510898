"""Rays that end at given depths, and several rays a pixel: against closed forms, and against a clip by the
plane at which rays end."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.scene.rendering import Details, pooled

from .. import oracle, switch
from ..scenes import in_float64, to_float64, uniform_transfer
from .test_gradients import scene_of, weighed


SIGMA, SIZE, FINER = 0.7, (12, 10), 2
EXACT = jv.March(0.05, (jv.AlphaCorrection(), jv.SpaceLeaping()), "midpoint")
POSITION, LOW, HIGH = np.array([4.0, -5.0, 2.5]), np.zeros(3), np.array([2.0, 1.5, 1.0])


def rays_of(position, size):
    """Directions of a camera at `position` that looks at the middle of the box, 16 degrees high."""
    forward = (LOW + HIGH) / 2 - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    x, y = ((np.arange(n) + 0.5) / n * 2 - 1 for n in size)
    x, y = np.meshgrid(x * size[0] / size[1], -y)
    half = np.tan(np.radians(8))
    way = forward + half * (x[..., None] * right + y[..., None] * np.cross(right, forward))
    return way / np.linalg.norm(way, axis=-1, keepdims=True)


def pool(image):
    return image.reshape(SIZE[1], FINER, SIZE[0], FINER).mean(axis=(1, 3))


def seen(position, until):
    """Opacity, depth times opacity, and the derivative of the mean opacity by `until`, of a uniform box."""
    way = rays_of(position, tuple(FINER * n for n in SIZE)).reshape(-1, 3)
    near, far = oracle.box_interval(np.broadcast_to(position, way.shape), way, LOW, HIGH)
    until = np.kron(until, np.ones((FINER, FINER))).ravel()
    length = np.clip(np.minimum(far, until) - near, 0, None)
    left = np.exp(-SIGMA * length)
    by_until = np.where((near < until) & (until < far), SIGMA * left, 0)
    depth = (1 - left) * (near + 1 / SIGMA) - length * left
    return [pool(each) for each in (1 - left, depth, by_until)]


def test_a_uniform_box_is_seen_up_to_a_depth_by_several_rays_a_pixel():
    """And its gradients, by the depths and by the camera, are those of the closed form."""
    with in_float64():
        volume = jv.Volume(np.ones((5, 4, 3)), HIGH / (4, 3, 2))
        camera = jv.Camera(POSITION, (LOW + HIGH) / 2, (0, 0, 1), 16.0, size=SIZE)

        @jax.jit
        def found(position, until):
            def opacity(position, until):
                view = eqx.tree_at(lambda camera: camera.position, camera, position)
                how = {"march": to_float64(EXACT), "until": until}
                image = jv.render(volume, uniform_transfer(SIGMA), view, antialias=FINER, **how)
                rays = jv.render_rays(volume, uniform_transfer(SIGMA), *camera.rays(), **how)
                return image.rgba[..., 3].sum(), (image, rays.rgba[..., 3])

            return jax.value_and_grad(opacity, (0, 1), has_aux=True)(position, until)

        until = np.random.default_rng(0).uniform(5.5, 8.5, SIZE[::-1])
        until[::3] = np.inf
        until[1, :2] = 0, -1
        found = jax.device_get(found(*jax.device_put((POSITION, until))))
        (_, (image, of_rays)), (by_position, by_until) = found
        opacity, depth, slope = seen(POSITION, until)
        assert 0.1 < np.mean(slope > 0) < 0.9
        np.testing.assert_allclose(np.asarray(image.rgba)[..., 3], opacity, atol=1e-12)
        np.testing.assert_array_equal(np.isinf(image.details.depth), opacity == 0)
        shown = opacity > 0
        np.testing.assert_allclose(
            image.details.depth[shown], (depth / np.where(shown, opacity, 1))[shown], rtol=1e-4
        )
        np.testing.assert_allclose(by_until, slope, atol=1e-12)
        for axis, nudge in enumerate(1e-5 * np.eye(3)):
            ends = [seen(POSITION + sign * nudge, until)[0].sum() for sign in (1, -1)]
            np.testing.assert_allclose(by_position[axis], (ends[0] - ends[1]) / 2e-5, rtol=1e-5)
        way = rays_of(POSITION, SIZE).reshape(-1, 3)
        near, far = oracle.box_interval(np.broadcast_to(POSITION, way.shape), way, LOW, HIGH)
        length = np.clip(np.minimum(far, until.ravel()) - near, 0, None)
        np.testing.assert_allclose(np.ravel(of_rays), -np.expm1(-SIGMA * length), atol=1e-12)


CUT = np.array([0.9, 0.8, 0.8]), np.array([0.4, -0.9, 0.5])
HOLLOW = 0.4, 1.2, 0.3, 1.1, 0.3, 1.1
"""A plane through the scene of `test_gradients`, and a normal toward its camera."""


def in_both_ways(adjoint, on):
    """Image and gradients by all leaves and by the plane, with rays that end at it, and clipped by it."""
    every = switch.transforms(box=HOLLOW, planes=()) | {"clip": jv.Clip(planes=[CUT])}

    def loss(scene, plane, clips):
        volume, transfer, camera, march = scene
        march = eqx.tree_at(lambda m: _clip(m, every).inner.origins, march, plane[0][None])
        march = eqx.tree_at(lambda m: _clip(m, every).inner.normals, march, plane[1][None])
        origins, directions = camera.rays()
        rate, height = directions @ plane[1], (origins - plane[0][None, None]) @ plane[1]
        until = jnp.where((rate < 0) & ~clips, -height / jnp.where(rate < 0, rate, 1), jnp.inf)
        image = jv.render(volume, transfer, camera, march, adjoint=adjoint, until=until)
        return weighed(image.rgba, image.details.depth), image

    program = eqx.filter_jit(
        eqx.filter_value_and_grad(lambda given, clips: loss(*given, clips), has_aux=True)
    )
    plane = jax.device_put(CUT)
    for clips in (True, False):
        chosen = on | ({"clip"} if clips else set())
        given = [switch.switch(each, name in chosen, name.title()) for name, each in every.items()]
        scene = scene_of(tuple(given), "float64", most=128)
        (_, image), found = jax.device_get(program((scene, plane), jax.device_put(np.asarray(clips))))
        # the clip's own, which both runs get from `plane`
        yield image, (found[0][:3], found[0][3].step, found[1])


def _clip(march, every):
    return march.transforms[list(every).index("clip")]


@pytest.mark.parametrize("adjoint", ["replay", pytest.param("direct", marks=pytest.mark.slow)])
def test_rays_that_end_at_a_plane_see_what_a_clip_leaves(adjoint):
    """With every transform, through gaps that the plane cuts, too."""
    with in_float64():
        for on in (
            {"jitter", "shift", "alignment", "leaping"},
            {"hollow", "alignment", "leaping", "termination"},
        ):
            (clipped, of_clipped), (ended, of_ended) = in_both_ways(adjoint, on)
            assert 0.05 < np.mean(clipped.rgba[..., 3] > 0) < 0.9
            for one, two in ((clipped.rgba, ended.rgba), (clipped.details.depth, ended.details.depth)):
                np.testing.assert_allclose(two, one, atol=1e-10)
            one, two = (
                jax.tree.leaves(eqx.filter(part, eqx.is_inexact_array)) for part in (of_clipped, of_ended)
            )
            assert all(np.linalg.norm(part) > 0.1 for part in of_clipped[-1])
            for expected, found in zip(one, two, strict=True):
                np.testing.assert_allclose(found, expected, atol=1e-8 * (1 + np.linalg.norm(expected)))


def test_a_pixel_of_several_rays_has_what_these_have():
    """Depth and normal as opacity weighs them, one of them invisible; of four invisible ones none."""
    opacity = np.array([[0.5, 0, 0, 0], [0.25, 0.25, 0, 0]], np.float32)
    depth = np.array([[1, np.inf, np.inf, np.inf], [2, 4, np.inf, np.inf]], np.float32)
    rgba = np.stack([opacity * n for n in (0.1, 0.2, 0.3, 1)], -1).astype(np.float32)
    normal = np.zeros((2, 4, 3), np.float32)
    normal[0, 0, 0] = normal[1, 0, 1] = normal[1, 1, 2] = 1
    some, samples = opacity > 0.3, np.arange(8, dtype=np.int32).reshape(2, 4)
    given: Any = jax.device_put((rgba, some, (depth, samples, depth, some, normal)))
    found = jax.device_get(pooled(jv.Rendering(*given[:2], Details(*given[2])), 2))
    np.testing.assert_allclose(found.rgba[..., 3], [[0.25, 0]])
    np.testing.assert_allclose(found.details.depth, [[(0.5 + 0.5 + 1) / 1, np.inf]])
    np.testing.assert_allclose(
        found.details.normal, [[np.array([2, 1, 1]) / np.sqrt(6), (0, 0, 0)]], atol=1e-7
    )
    np.testing.assert_array_equal(found.details.samples, [[0 + 1 + 4 + 5, 2 + 3 + 6 + 7]])
    np.testing.assert_array_equal(found.exhausted, [[True, False]])
    np.testing.assert_array_equal(found.details.aligned, [[True, False]])
    assert np.isinf(found.details.error[0, 0])
