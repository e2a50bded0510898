"""Image metrics, on images for which their values are known."""

from itertools import pairwise

import jax
import numpy as np
import pytest
from scipy.ndimage import sobel

from jaxvol.metrics import (
    boundary_noise,
    comb_frequency,
    gradient_ncc,
    ncc,
    psnr,
    rmse,
    ssim,
    standardized,
    wood_grain_energy,
)

from .scenes import in_float64


H, W = 160, 192
Y, X = np.mgrid[:H, :W].astype(float)


def wave(fx, fy, phase=0.0, amplitude=1.0):
    """A wave of energy amplitude² / 2."""
    return amplitude * np.cos(2 * np.pi * (fx * X + fy * Y) + phase)


def noise(seed, shape=(H, W)):
    return np.random.default_rng(seed).normal(size=shape)


# -- distances ----------------------------------------------------------------------------------------


def test_rmse_and_psnr_of_a_known_difference():
    image = noise(0, (H, W, 3))
    assert rmse(image, image) == 0
    assert rmse(image + 0.5, image) == pytest.approx(0.5)
    assert psnr(image + 0.01, image) == pytest.approx(40)
    assert psnr(image + 0.01, image, data_range=10) == pytest.approx(60)
    assert psnr(image, image) == np.inf
    # float32 images are compared in float64
    image = np.full((8, 8), 1000, np.float32)
    assert rmse(image, image + 1e-3) == pytest.approx(np.float32(1000 + 1e-3) - 1000.0, rel=1e-9)


def test_ssim_is_one_for_the_same_image_and_falls_with_noise():
    image = 0.5 + 0.2 * wave(0.02, 0.01)
    seen = [ssim(image + level * noise(0), image) for level in (0, 0.02, 0.1, 0.5)]
    assert seen[0] == pytest.approx(1)
    assert all(a > b + 0.05 for a, b in pairwise(seen))
    color = np.stack([image] * 3, axis=-1)
    assert ssim(color + 0.02 * noise(0)[..., None], color) == pytest.approx(seen[1])


# -- similarities -------------------------------------------------------------------------------------


def correlation(a, b, weights):
    """By NumPy's covariance."""
    (aa, ab), (_, bb) = np.cov(a.ravel(), b.ravel(), aweights=weights.ravel())
    return ab / np.sqrt(aa * bb)


def test_correlations_are_those_of_numpy_and_sobel_with_their_derivatives():
    """In float64, with weights of which some are 0; derivatives by central differences. A wave and the same
    wave shifted by a phase, over whole periods, correlate by its cosine; a constant image by 0."""

    @jax.jit
    def both(image, reference, weights):
        measured = [
            jax.value_and_grad(function)(image, reference, weights) for function in (ncc, gradient_ncc)
        ]
        return [part[0] for part in measured], [part[1] for part in measured]

    size = 24, 32
    image, reference = noise(1, size), noise(2, size)
    reference = reference + image
    weights = np.maximum(noise(3, size) + 1.5, 0)
    least = np.lib.stride_tricks.sliding_window_view(weights, (3, 3)).min(axis=(2, 3))
    slopes = [[sobel(each, axis=axis)[1:-1, 1:-1] for axis in (0, 1)] for each in (image, reference)]
    expected = [
        correlation(image, reference, weights),
        np.mean([correlation(a, b, least) for a, b in zip(*slopes, strict=True)]),
    ]
    direction, h = noise(4, size), 1e-5
    with in_float64():
        found, gradients = both(3 - 2 * image, reference, weights)
        np.testing.assert_allclose(found, -np.array(expected), rtol=1e-12)
        ends = [both(3 - 2 * image + s * direction, reference, weights)[0] for s in (h, -h)]
        rates = (np.array(ends[0]) - np.array(ends[1])) / (2 * h)
        np.testing.assert_allclose([np.vdot(g, direction) for g in gradients], rates, rtol=1e-7)
        assert not any(np.any(np.asarray(gradient)[weights == 0]) for gradient in gradients)
        waves = [np.cos(2 * np.pi * np.arange(32) / 8 + phase) * np.ones(size) for phase in (0, 0.7)]
        assert both(*waves, np.ones(size))[0][0] == pytest.approx(np.cos(0.7))
        value, gradient = both(np.full(size, 0.1), reference, weights)
        assert (value[0], value[1], np.any(gradient)) == (0, 0, False)


# -- wood grain of known frequency ----------------------------------------------------------------------


def test_comb_frequency_of_the_plane_in_the_laboratory():
    # period step / (pixel size · slope) = (1/128) / (0.5/256 · 0.35) = 11.43 pixels
    assert comb_frequency(1 / 128, (0.35, -0.7), 0.5 / 256) == pytest.approx((0.0875, -0.175))


@pytest.mark.parametrize("frequency", [(0.125, 0.0), (0.0719, -0.1037)])
def test_a_comb_has_the_energy_of_its_waves_wherever_its_frequency_lies(frequency):
    fx, fy = frequency
    amplitudes = (1.0, 0.5, 0.25)
    comb = sum(wave(h * fx, h * fy, h * 1.0, a) for h, a in enumerate(amplitudes, 1))
    for first in (1, 2, 3):
        known = sum(a**2 / 2 for a in amplitudes[:first])
        assert wood_grain_energy(-3 * comb + 7.0, frequency, first) == pytest.approx(9 * known, rel=2e-3)


def test_a_comb_of_another_frequency_and_shading_are_not_counted():
    assert wood_grain_energy(wave(0.17, 0.02), (0.0875, 0.0)) < 1e-5
    assert wood_grain_energy(wave(0.0875, 0.05), (0.0875, 0.0)) < 1e-5
    shading = X / W + (Y / H) ** 2
    assert wood_grain_energy(shading, (0.0875, 0.0)) < 1e-6 * np.var(shading)
    # off by half a bin, 28 % is lost
    assert wood_grain_energy(wave(0.1 + 0.5 / W, 0), (0.1, 0.0)) == pytest.approx(0.72 * 0.5, rel=0.01)


def test_white_noise_adds_to_a_comb_what_the_docstring_says():
    frequency = (0.0719, 0.1037)
    measured = [wood_grain_energy(noise(seed), frequency) for seed in range(60)]
    assert np.mean(measured) == pytest.approx(2.25 * 2 * 3 / (H * W), rel=0.15)


def test_harmonics_fold_at_nyquist_and_are_never_counted_twice():
    # 3 · 0.21 = 0.63 aliases to -0.37, where it is measured
    assert wood_grain_energy(wave(0.63, 0), (0.21, 0.0)) == pytest.approx(0.5, rel=2e-3)
    # 3 · 1/3 aliases to 0, and 2 · 1/3 to -1/3, the fundamental's mirror image: one wave is left
    assert wood_grain_energy(wave(1 / 3, 0), (1 / 3, 0.0)) == pytest.approx(0.5, rel=2e-3)
    # 2 · 1/4 is its own mirror image
    assert wood_grain_energy(wave(0.5, 0), (0.25, 0.0)) < 1e-6
    for lost in ((0.0, 0.0), (0.5, 0.0), (1.0, -0.5), (0.005, 0.0)):
        with pytest.raises(ValueError, match="frequency must be two bins"):
            wood_grain_energy(X, lost)


# -- wood grain anywhere ------------------------------------------------------------------------------


@pytest.mark.parametrize("frequency", [(0.0, 0.2313), (-0.3, 0.21)])
def test_a_wave_is_all_structure(frequency):
    image = wave(*frequency, phase=1.0, amplitude=0.3)
    assert wood_grain_energy(10 * image + 5) == pytest.approx(100 * 0.3**2 / 2, rel=0.01)


def test_white_noise_is_no_structure():
    measured = [wood_grain_energy(noise(seed)) for seed in range(40)]
    assert np.max(np.abs(measured)) < 0.02
    assert abs(np.mean(measured)) < 0.003
    # two-valued noise whose strength varies over the image and is 0 in most of it
    uneven = (noise(0) > 0) * (np.hypot(X - 80, Y - 60) < 50) * X / W
    assert abs(wood_grain_energy(uneven - uneven.mean())) < 0.05 * np.var(uneven)


def test_a_wave_and_noise_add_up_to_the_loss_that_the_docstring_states():
    for seed in range(4):  # as much noise as wave
        assert 0.82 * 0.5 < wood_grain_energy(wave(0.1371, 0.031) + 0.5**0.5 * noise(seed)) < 1.02 * 0.5


def test_rings_that_bend_and_narrow_are_structure_and_those_half_broken_keep_a_part():
    # around a corner, as on a sphere: the frequency grows with the radius, up to 0.45
    rings = np.cos(np.pi * 0.0012 * ((X + 50) ** 2 + (Y + 50) ** 2))
    assert 0.9 * 0.5 < wood_grain_energy(rings) < 1.01 * 0.5
    shuffled = np.random.default_rng(0).permutation(rings.ravel()).reshape(H, W)
    assert abs(wood_grain_energy(shuffled)) < 0.02 * 0.5
    # as a jitter of half a step would leave them: the metric distinguishes 1/2 from 1/10
    phase = np.random.default_rng(0).uniform(-0.25, 0.25, (H, W))
    broken = np.cos(2 * np.pi * (0.1371 * X + 0.031 * Y + phase))
    assert wood_grain_energy(broken) == pytest.approx(0.5 * np.sinc(0.5) ** 2, rel=0.15)


def test_shading_and_a_lone_pixel_are_no_structure():
    for shading in (X / W, (X / W - 0.5) ** 2 + (Y / H - 0.5) ** 2, wave(0.01, 0.005)):
        assert abs(wood_grain_energy(shading)) < 1e-3 * np.var(shading)
    image = np.zeros((H, W))
    image[70, 90] = 1
    assert wood_grain_energy(image) <= 0


def test_channels_add_up_and_an_image_of_any_size_is_covered_to_its_edges():
    image = np.stack([wave(0.1371, 0.031), 2 * wave(0.2, 0.1), 0 * X], axis=-1)
    each = [wood_grain_energy(image[..., c]) for c in range(3)]
    assert wood_grain_energy(image) == pytest.approx(sum(each))
    assert wood_grain_energy(image, (0.2, 0.1), 1) == pytest.approx(2, rel=2e-3)
    image = np.zeros((45, 70))
    image[-6:, -9:] = wave(0.3, 0.2)[:6, :9]
    assert wood_grain_energy(image) > 0


# -- noise on a face --------------------------------------------------------------


LEFT = X < 0.4 * W


def test_boundary_noise_is_the_variance_of_white_noise_in_the_region_without_shading():
    for level in (0.01, 1.0):
        image = level * noise(1) + np.where(LEFT, 0, 1e3 * wave(0.3, 0.2))
        assert boundary_noise(image, LEFT) == pytest.approx(level**2, rel=0.05)
    assert boundary_noise(0.1 * noise(2, (H, W, 3)), LEFT) == pytest.approx(3 * 0.01, rel=0.05)
    for shading in (0.3 * X + 0.1 * Y, (X - Y) ** 2 / W**2, np.sin(X) + np.cos(Y)):
        assert boundary_noise(shading, LEFT) < 1e-20
        assert boundary_noise(shading + 0.01 * noise(3), LEFT) == pytest.approx(1e-4, rel=0.05)


# -- invalid arguments ----------------------------------------------------------------------------------


BROKEN = np.where((X == 3) & (Y == 4), np.nan, 1.0)
BAD = [
    (lambda: rmse("image", "imago"), "image must be numbers"),
    (lambda: rmse(X, X[1:]), "image and reference must agree in shape"),
    (lambda: ssim(BROKEN, X), "image must be finite; got 1 of"),
    (lambda: psnr(X, BROKEN), "reference must be finite"),
    (lambda: psnr(X, X + 1, data_range=0), "data_range must be greater than 0"),
    (lambda: ssim(X[:6], X[:6]), "image must have at least 7 pixels"),
    (lambda: wood_grain_energy(X[:31]), "error must have at least 32 pixels"),
    (lambda: wood_grain_energy(X, (0.1, 0.0), harmonics=0), "harmonics must be an integer of at least 1"),
    (lambda: wood_grain_energy(X, (0.1, np.nan)), "frequency must be finite"),
    (lambda: wood_grain_energy(np.ones((2, H, W, 3))), "error must have shape"),
    (lambda: comb_frequency(0, (1, 0), 1), "step must be greater than 0"),
    (lambda: comb_frequency(1, (np.inf, 0), 1), "depth_slope must be finite"),
    (lambda: boundary_noise(X, 1.0 * LEFT), "region must be booleans of shape"),
    (lambda: boundary_noise(X, (X % 3) > 0), "3 x 3"),
    (lambda: ncc(X, X[1:]), "image and reference must agree in shape"),
    (lambda: ncc(X[0], X[0]), r"image must have shape \(height, width\); got"),
    (lambda: gradient_ncc(X[:2], X[:2]), "of at least 3 x 3 pixels; got"),
    (lambda: standardized(X, X[1:]), "weights must have the shape of the image"),
]


@pytest.mark.parametrize(("call", "message"), BAD)
def test_bad_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
