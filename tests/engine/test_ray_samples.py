"""Samples along rays: those of NumPy, sums that are the pixel's, and gradients of differences."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv

from ..modes import Rays, classified
from ..scenes import in_float64, rendered_rays, soft_transfer


MOST = 32
SIZE = 8, 6
BOX = (0.55, 1.45, 0.5, 1.2, 0.3, 1.5)


def scene() -> tuple[jv.Volume, jv.TransferFunction, jv.Camera]:
    """A ball in the corner of a grid of 13³ nodes."""
    place = np.indices((13,) * 3) - np.reshape([8.6, 8.3, 8.1], (3, 1, 1, 1))
    volume = jv.Volume(np.clip(1.1 - np.linalg.norm(place, axis=0) / 4, 0, 1), (0.15,) * 3)
    return volume, soft_transfer(), jv.Camera.looking_at(volume, (0.5, -0.9, 0.4), size=SIZE)


def distortion(samples: jv.RaySamples) -> jax.Array:
    """The loss of mip-NeRF 360 (Barron et al. 2022, equation 15) by sums over samples."""
    weight, middle = samples.weight, samples.depth
    before = jnp.cumsum(weight, axis=-1) - weight, jnp.cumsum(weight * middle, axis=-1) - weight * middle
    pairs = 2 * weight * (middle * before[0] - before[1])
    return jnp.sum(pairs + weight**2 * samples.width / 3, axis=-1)


def distortion_of_pairs(depth: Any, width: Any, weight: Any) -> Any:
    """The same in O(n²), as printed."""
    pairs = np.abs(depth[..., :, None] - depth[..., None, :]) * weight[..., :, None] * weight[..., None, :]
    return pairs.sum((-2, -1)) + (weight**2 * width).sum(-1) / 3


@eqx.filter_jit
def sampled(parts: Any, march: jv.March, most: int, mode: Any = "over", lighting: Any = None) -> Any:
    """Image, samples, and a loss of them, with its gradient."""
    (volume, transfer, camera), weights = parts, jnp.asarray(np.random.default_rng(2).normal(size=(6, 8)))

    def loss(moving: Any) -> Any:
        moved, function, source = eqx.combine(moving, (volume, transfer, camera))
        found = jv.render_rays(
            moved,
            function,
            *source.rays(),
            march,
            compositing=mode,
            outputs="samples",
            most_samples=most,
            lighting=lighting,
        )
        values = distortion(found.ray_samples) + 0.3 * jnp.sum(found.rgba, axis=-1)
        return jnp.sum(values * weights), found

    moving = eqx.filter(parts, eqx.is_inexact_array)
    (value, found), gradient = jax.value_and_grad(loss, has_aux=True)(moving)
    return found, value, gradient


def test_samples_are_those_of_numpy_and_the_loss_has_the_gradient_of_differences():
    with in_float64():
        volume, transfer, camera = parts = jax.device_put(scene())
        march = jv.March(0.11, (jv.AlphaCorrection(),), "midpoint")
        found, _, gradient = sampled(parts, march, MOST)
        samples, rays = found.ray_samples, Rays(volume, camera)
        front, width = rays.cells(0.11)
        color, extinction = classified(transfer, rays.value(front + width / 2))
        alpha = np.where(width > 0, -np.expm1(-extinction * width), 0)
        weight = alpha * np.cumprod(np.concatenate([np.ones((48, 1)), 1 - alpha[:, :-1]], axis=1), axis=1)
        shown, depth = width > 0, rays.t_in[:, None] + front + width / 2
        for name, expected in (("depth", depth), ("width", width), ("weight", weight), ("color", color)):
            leaf = np.asarray(getattr(samples, name)).reshape(48, MOST, *expected.shape[2:])
            leaf = leaf[:, : expected.shape[1]]
            np.testing.assert_allclose(leaf[shown], expected[shown], rtol=1e-9, atol=1e-9, err_msg=name)
        assert (np.sum(np.asarray(samples.width) > 0, axis=-1).reshape(-1) == shown.sum(axis=1)).all()
        assert (np.diff(samples.depth) >= 0).all()
        assert not np.asarray(found.exhausted).any()
        pairs = distortion_of_pairs(*map(np.asarray, (samples.depth, samples.width, samples.weight)))
        np.testing.assert_allclose(jax.jit(distortion)(samples), pairs, rtol=1e-9, atol=1e-12)
        random = np.random.default_rng(1)
        for name, of in (
            ("voxels", lambda p: p[0].data),
            ("spacing", lambda p: p[0].spacing),
            ("colors", lambda p: p[1].colors),
            ("extinction", lambda p: p[1].extinction),
            ("position", lambda p: p[2].position),
        ):
            way = random.choice([-1.0, 1.0], of(parts).shape) * (np.asarray(of(parts)) != 0)
            ends = [
                float(sampled(eqx.tree_at(of, parts, np.asarray(of(parts)) + h * way), march, MOST)[1])
                for h in (1e-6, -1e-6)
            ]
            slope = float(np.vdot(of(gradient), way))
            assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-8), name
            assert abs(slope) > 1e-4


TRANSFORMS: dict[str, tuple[jv.Transform, ...]] = {
    "leaps, jitter, an early end": (
        jv.AlphaCorrection(),
        jv.SpaceLeaping(),
        jv.EmptySpaceJitter(),
        jv.EarlyTermination(0.2),
    ),
    "gaps": (jv.AlphaCorrection(), jv.SpaceLeaping("distance"), jv.Clip(BOX, inside_out=True), jv.Jitter()),
}


@pytest.mark.parametrize(("name", "limit"), [("leaps, jitter, an early end", 48), ("gaps", 8)])
def test_sums_over_samples_are_the_image(name, limit):
    volume, transfer, camera = parts = scene()
    march = jv.March(0.09, TRANSFORMS[name])
    found, _, gradient = jax.device_get(sampled(parts, march, limit))
    image = jax.device_get(rendered_rays(volume, transfer, *camera.rays(), march))
    samples, whole = found.ray_samples, ~np.asarray(found.exhausted)
    np.testing.assert_allclose(found.rgba[whole], image.rgba[whole], atol=2e-6)
    np.testing.assert_allclose(samples.weight.sum(-1), found.rgba[..., 3], atol=1e-6)
    sums = np.sum(samples.weight[..., None] * samples.color, axis=-2)
    np.testing.assert_allclose(sums, found.rgba[..., :3], atol=1e-6)
    mean = np.sum(samples.weight * samples.depth, axis=-1) / np.maximum(found.rgba[..., 3], 1e-9)
    seen = np.asarray(found.rgba[..., 3]) > 1e-3
    np.testing.assert_allclose(mean[seen], np.asarray(found.details.depth)[seen], rtol=1e-5)
    counts = np.sum(np.asarray(samples.width) > 0, axis=-1)
    cells = np.ceil(Rays(volume, camera).length / 0.09).reshape(counts.shape)
    if limit > cells.max():
        assert whole.all()
        assert counts.sum() < 0.8 * cells.sum(), (counts, cells)  # the others are leapt over
    else:
        assert 4 < whole[cells > 0].sum() < (cells > 0).sum(), (whole, cells)
        assert (counts[~whole] > limit - 3).any()
    padding = np.arange(limit) >= counts[..., None]
    assert not np.asarray(samples.weight)[padding].any()
    assert (np.diff(samples.depth) >= 0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


REFUSED = {
    "no number": (
        {"outputs": "samples"},
        "most_samples is needed for outputs=\"samples\".*got outputs='samples'",
    ),
    "no samples": ({"most_samples": 4}, "most_samples is needed .* got outputs='all', most_samples=4"),
    "none": ({"outputs": "samples", "most_samples": 0}, "most_samples must be an integer from 1"),
    "maximum": (
        {"outputs": "samples", "most_samples": 4, "compositing": "maximum"},
        "compositing must weight samples .* got Maximum",
    ),
    "average": (
        {"outputs": "samples", "most_samples": 4, "compositing": "average"},
        "compositing must weight samples .* got Average",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_is_named(case):
    options, message = REFUSED[case]
    volume, transfer, _ = scene()
    with pytest.raises(ValueError, match=message):
        jv.render_rays(volume, transfer, np.zeros((1, 3)), np.ones((1, 3)), jv.March(0.1), **options)
