"""Is the gradient of path tracing right with respect to voxels and transfer function?

It is compared with forward mode, which walks the same paths, with differences of quadrature (light scattered
once), and with differences of images. All fast tests share one program of the gradient.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.lighting import ConstantLight, DirectionalLight

from ..scenes import around, in_float64
from .test_path_trace import matter, middles_of, once_scattered


RANDOM = np.random.default_rng(0)
DATA = np.where(np.arange(6) < 2, 0.1, RANDOM.uniform(0.2, 1, (6,) * 3)).astype(np.float32)
"""Nothing is to be seen in a third of the volume."""
VOLUME = jv.Volume(DATA, (0.2,) * 3)
CAMERA = around(VOLUME, (8, 8))
POINTS = np.array([0.0, 0.2, 0.5, 1.0])
COLORS = np.array([(0.9, 0.5, 0.0), (0.8, 0.4, 0.0), (0.9, 0.7, 0.3), (0.5, 0.9, 1e-5)], np.float32)
EXTINCTION = np.array([0.0, 0.0, 3.0, 6.0], np.float32)
INPUTS = DATA, COLORS, EXTINCTION
SUN, SKY, NIGHT = np.array([2.0, 1.0, 3.0]), np.array([0.5, 1.0, 0.7]), np.zeros(3)
DIRECTION = 0.5, 1.0, -0.7
WEIGHTS = RANDOM.normal(size=(2, 8, 8, 4)).astype(np.float32)
"""Cotangents of two groups of paths."""


def scene(data: Any, colors: Any, extinction: Any) -> tuple[jv.Volume, jv.TransferFunction]:
    volume = eqx.tree_at(lambda volume: volume.data, VOLUME, data)
    return volume, jv.TransferFunction(POINTS, colors, extinction)


def traced(inputs: Any, sun: Any, sky: Any, key: Any, paths: int = 16) -> jv.PathTraced:
    lights = DirectionalLight(DIRECTION, sun), ConstantLight(sky)
    how: Any = {"paths": paths, "groups": 2, "lanes": 64, "anisotropy": np.float32(0.3)}
    return jv.path_trace(*scene(*inputs), CAMERA, lights, key=key, **how)


def loss(inputs: Any, weights: Any, sun: Any, sky: Any, key: Any) -> jax.Array:
    """Weighted sum over the image and its opacity, by groups and by all paths."""
    image = traced(inputs, sun, sky, key)
    assert image.groups is not None
    whole = jnp.sum(image.radiance * weights[0, ..., :3]) + jnp.sum(image.opacity * weights[1, ..., 3])
    return whole + jnp.sum(image.groups * weights)


gradient = jax.jit(jax.grad(loss))


def test_the_gradient_is_that_of_forward_mode():
    """Also with respect to an extinction of 0 and to dark colours, in the same units of rounding."""
    given = WEIGHTS, SUN, SKY, np.int32(0)
    found = map(np.asarray, gradient(INPUTS, *given))
    directions = [RANDOM.normal(size=(3, *leaf.shape)).astype(np.float32) for leaf in INPUTS]
    for at, direction in enumerate(directions):
        direction[[i for i in range(3) if i != at]] = 0
    directions = tuple(directions)

    @jax.jit
    def pushed(directions: Any) -> jax.Array:
        along = jax.vmap(lambda tangent: jax.jvp(lambda i: loss(i, *given), (INPUTS,), (tangent,))[1])
        return along(directions)

    by_leaf = [np.sum(g * d, axis=tuple(range(1, d.ndim))) for g, d in zip(found, directions, strict=True)]
    np.testing.assert_allclose(np.sum(by_leaf, axis=0), pushed(directions), rtol=2e-5)


def quadrature(data: Any) -> np.ndarray:
    """Light scattered once, with its opacity."""
    volume, transfer = scene(data, COLORS, EXTINCTION)
    light = DirectionalLight(DIRECTION, SUN)
    radiance = once_scattered(volume, transfer, CAMERA, (light,), 0.3, 192, 48)
    _, extinction, exits = matter(volume, transfer)
    points, _, width = middles_of(CAMERA, exits, 1024)
    opacity = -np.expm1(-extinction(points).sum(axis=1) * width).reshape(radiance.shape[:2])
    return np.concatenate([radiance, opacity[..., None]], axis=-1)


def test_the_gradient_by_voxels_is_that_of_quadrature():
    """Of opacity, and of light that is scattered once, since the albedo is small."""
    albedo, step = 1e-3, 1e-3
    weights = np.abs(WEIGHTS[:1]) * np.ones((2, 1, 1, 1), np.float32)
    given = weights / np.array([albedo] * 3 + [1], np.float32), SUN, NIGHT
    dim = DATA, albedo * COLORS, EXTINCTION
    planes = [np.sum(gradient(dim, *given, np.int32(key))[0], axis=(1, 2)) for key in range(40)]
    found, error = np.mean(planes, axis=0), np.std(planes, axis=0, ddof=1) / np.sqrt(len(planes))
    for plane in range(6):
        change = step * (np.arange(6) == plane)[:, None, None]
        difference = (quadrature(DATA + change) - quadrature(DATA - change)) / (2 * step)
        expected = 3 * np.sum(difference * weights[0])  # by the whole image and two groups
        assert abs(found[plane] - expected) < 3 * error[plane], plane
    assert np.all(error < 0.1 * np.abs(found).max())


def test_forward_mode_over_reverse_mode_is_refused():
    def slope(extinction: Any) -> jax.Array:
        return jax.grad(loss)((DATA, COLORS, extinction), WEIGHTS, SUN, SKY, np.int32(0))[2]

    with pytest.raises(RuntimeError, match="first derivatives in either mode"):
        jax.eval_shape(lambda at: jax.jvp(slope, (at,), (at,)), EXTINCTION)


def test_a_nan_makes_the_gradient_nan():
    for at in range(3):
        broken = [leaf.copy() for leaf in INPUTS]
        broken[at].flat[-1] = np.nan
        found = gradient(tuple(broken), WEIGHTS, SUN, SKY, np.int32(0))
        assert all(np.isnan(leaf).all() for leaf in found)


def test_the_gradient_of_a_jitted_loss_has_the_type_of_the_inputs():
    with in_float64():
        inputs = [np.asarray(leaf, np.float64) for leaf in INPUTS]
        found = jax.eval_shape(jax.grad(jax.jit(loss)), tuple(inputs), WEIGHTS, SUN, SKY, np.int32(0))
    assert [(leaf.shape, leaf.dtype) for leaf in found] == [(leaf.shape, leaf.dtype) for leaf in inputs]


@pytest.mark.slow
def test_the_gradient_by_each_input_is_that_of_differences_of_images():
    """Of light that is scattered any number of times, by a smooth change of each input."""
    weights = np.abs(WEIGHTS)
    waves = [1 + np.sin(np.arange(leaf.size)).reshape(leaf.shape).astype(np.float32) for leaf in INPUTS]
    directions = [0.2 * waves[0], 0.2 - waves[1] / 5 * COLORS, waves[2]]
    image, keys = jax.jit(loss), np.arange(400, dtype=np.int32)
    pulled = [gradient(INPUTS, weights, SUN, SKY, key) for key in keys]
    for at, direction in enumerate(directions):
        found = [np.vdot(of_inputs[at], direction) for of_inputs in pulled]

        def moved(step: float, key: Any, at: int = at, direction: Any = direction) -> float:
            inputs = list(INPUTS)
            inputs[at] = inputs[at] + np.float32(step) * direction
            return float(image(tuple(inputs), weights, SUN, SKY, key))

        one_sided = at > 0  # no colour and no extinction is below 0
        differences = [
            (4 * moved(0.1, key) - 3 * moved(0, key) - moved(0.2, key)) / 0.2
            if one_sided
            else (moved(0.1, key) - moved(-0.1, key)) / 0.2
            for key in keys + 1000
        ]
        means, errors = zip(
            *((np.mean(x), np.std(x, ddof=1) / 20) for x in (found, differences)), strict=True
        )
        assert np.hypot(*errors) < 0.1 * abs(means[0])
        assert abs(means[0] - means[1]) < 3 * np.hypot(*errors), at


@pytest.mark.slow
def test_a_batch_of_gradients_is_that_of_single_ones():
    given = WEIGHTS, SUN, SKY
    keys = jnp.arange(3, dtype=jnp.int32)
    batch = jax.jit(jax.vmap(lambda key: jax.grad(loss)(INPUTS, *given, key)))(keys)
    for at, key in enumerate(keys):
        for several, one in zip(batch, gradient(INPUTS, *given, key), strict=True):
            np.testing.assert_allclose(several[at], one, rtol=1e-4, atol=1e-4 * np.abs(one).max())


@pytest.mark.slow
def test_voxels_are_found_from_scattered_light():
    """By Adam, and the product of two independent residuals, which has no bias."""
    truth = RANDOM.uniform(0.1, 0.9, (4,) * 3).astype(np.float32)
    transfer = jv.TransferFunction([0.0, 1.0], [(0.9, 0.8, 0.7)] * 2, [0.0, 4.0])
    cameras = [
        jv.Camera.looking_at(jv.Volume(truth, (0.33,) * 3), direction, size=(12, 12))
        for direction in ((1, 0.2, 0.3), (-0.3, 1, 0.2), (0.2, -0.3, 1), (-1, -0.8, -0.9))
    ]
    lights = DirectionalLight(DIRECTION, SUN), ConstantLight(SKY)

    def images(data: Any, camera: jv.Camera, key: Any, paths: int) -> jax.Array:
        volume = jv.Volume(data, (0.33,) * 3)
        return jv.path_trace(volume, transfer, camera, lights, paths=paths, groups=2, key=key).images(
            (0, 0, 0)
        )

    views = [images(truth, camera, 1000 + at, 1024).mean(axis=0) for at, camera in enumerate(cameras)]

    @jax.jit
    @jax.value_and_grad
    def loss(data: Any, camera: jv.Camera, view: Any, key: Any) -> jax.Array:
        residual, other = images(data, camera, key, 16) - view[None]
        return jnp.mean(residual * other) / 2

    data, mean, square, losses = np.full((4,) * 3, 0.9, np.float32), 0.0, 0.0, []
    for step in range(1, 101):
        found = [
            loss(data, camera, view, np.int32(4 * step + at))
            for at, (camera, view) in enumerate(zip(cameras, views, strict=True))
        ]
        slope = sum(np.asarray(g) for _, g in found)
        mean, square = 0.9 * mean + 0.1 * slope, 0.99 * square + 0.01 * slope**2
        rate = 0.05 if step < 50 else 0.015
        data = data - rate * (mean / (1 - 0.9**step)) / (np.sqrt(square / (1 - 0.99**step)) + 1e-12)
        data = np.clip(data, 0.01, 1).astype(np.float32)
        losses.append(float(sum(value for value, _ in found)))
    before, after = (np.sqrt(np.mean((x - truth) ** 2)) for x in (0.9, data))
    assert abs(np.mean(losses[-20:])) < 0.1 * losses[0]
    assert after < 0.35 * before
