"""Is noise of references told from a model that does not fit, and do standard errors cover the truth?"""

import warnings
from typing import Any

import jax
import numpy as np
import pytest
from scipy import stats

import jaxvol as jv
from experiments.coverage import NOISES, Model, coverage, mean_free_path, three_opacities
from experiments.mean_free_path import lights
from jaxvol.fitting.noise import Noise, path_traced_view
from jaxvol.fitting.residuals import Triangles
from jaxvol.fitting.uncertainty import spreads


@pytest.fixture(scope="module")
def ball() -> Model:
    return mean_free_path(size=8, resolution=8)


# -- what is known of the noise ---------------------------------------------------------------------------


def test_noise_exceeds_the_limit_once_in_741_even_if_it_is_correlated_within_blocks():
    """Blocks of 4 x 4 pixels, cut at the border, of a variance that differs: the sum of squares of one
    Gaussian number for each block."""
    sigma = np.linspace(0.1, 0.4, 10)[:, None, None] * np.ones((10, 14, 3))
    noise = Noise.of([sigma**2, 4 * sigma**2])
    assert noise is not None
    blocks = np.pad(sigma**2, ((0, 2), (0, 2), (0, 0))).reshape(3, 4, 4, 4, 3).sum(axis=(1, 3, 4)).ravel()
    scales = np.concatenate([blocks, 4 * blocks])
    drawn = np.random.default_rng(0).normal(size=(100_000, len(scales))) ** 2 @ scales / scales.sum()
    assert 0.3 / 741 < np.mean(drawn > noise.largest_by_chance) < 3 / 741
    assert noise.freedom == pytest.approx(scales.sum() ** 2 / np.sum(scales**2), rel=1e-5)
    # where blocks are equal, χ² is known exactly
    equal = Noise.of([np.full((32, 32, 3), 0.04)])
    assert equal is not None
    exact = stats.chi2.isf(stats.norm.sf(3), 64) / 64
    assert equal.largest_by_chance == pytest.approx(exact, rel=0.005)


def test_pixels_without_noise_do_not_count_in_the_reduced_chi_squared():
    """Over many draws of noise in a tenth of the pixels, its mean is 1 for four fitted numbers."""
    variances = np.zeros((20, 4, 3))
    variances[:2] = 0.09
    noise, rng = Noise.of([variances]), np.random.default_rng(1)
    assert noise is not None
    jac, _ = np.linalg.qr(rng.normal(size=(24, 4)))
    drawn = 0.3 * rng.normal(size=(4000, 24))
    left = drawn - drawn @ jac @ jac.T  # after a linear fit
    found = [noise.reduced_chi_squared(squares, 4) for squares in np.sum(left**2, axis=1)]
    assert np.mean(np.asarray(found)) == pytest.approx(1, abs=3 * (2 / 20 / 4000) ** 0.5)
    assert noise.reduced_chi_squared(1.0, 24) is None
    assert Noise.of([np.zeros((4, 4, 3))]) is None


def traced(paths: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, jv.PathTraced]:
    """Radiance and hits of each path of an image, and the image."""
    rng = np.random.default_rng(seed)
    met = rng.random((4, 6, paths)) < 0.6
    radiance = met[..., None] * rng.exponential(size=(4, 6, paths, 3))
    mean = radiance.mean(axis=2)
    deviations = np.sum((radiance - mean[:, :, None]) ** 2, axis=2)
    arrays = (part.astype(np.float32) for part in (mean, met.mean(axis=2), deviations))
    image: Any = jax.device_put((*arrays, np.zeros((4, 6), bool), np.uint32(0)))
    return radiance, met, jv.PathTraced(*image[:4], paths, image[4])


def test_the_noise_of_a_path_traced_image_is_that_of_its_paths_over_the_background():
    radiance, met, image = traced(32)
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.2)):
        of_paths = radiance + (1 - met[..., None]) * np.asarray(background)
        found, variance = path_traced_view(image, jax.device_put(np.float32(background)))
        np.testing.assert_allclose(found, of_paths.mean(axis=2), rtol=1e-5)
        assert variance is not None
        np.testing.assert_allclose(variance, of_paths.var(axis=2, ddof=1) / 32, rtol=1e-4)


def test_noise_is_known_only_if_it_is_given_or_of_several_paths_for_all_views(ball):
    camera = jv.Camera((0, -4, 1), (0, 0, 0), (0, 0, 1), size=(6, 4))
    (*_, many), (*_, single), plain = traced(8), traced(1), np.zeros((4, 6, 3), np.float32)

    def noise(*images, **how):
        views = [(camera, image) for image in images]
        return jv.ImageResidual(ball.scene, views, (0, 0, 0), **how).references.noise

    error = np.asarray(many.standard_error)
    total = float(np.sum(error**2))
    for known in (noise(many), noise(single, noise=[error])):
        assert known is not None
        assert known.variance == pytest.approx(total, rel=1e-5)
    both = noise(many, plain, noise=[None, 0.1])
    assert both is not None
    assert both.variance == pytest.approx(total + 0.72, rel=1e-5)
    by_pixel = noise(plain, noise=[np.linspace(0, 0.5, 6)[:, None]])
    assert by_pixel is not None
    assert (by_pixel.noisy, float(by_pixel.variance)) == (60, pytest.approx(12 * 0.55))
    for unknown in (noise(plain), noise(single), noise(many, plain), noise(many, single)):
        assert unknown is None


# -- fits -------------------------------------------------------------------------------------------------


def test_standard_errors_cover_the_truth_where_noise_differs_tenfold_and_no_misfit_is_told(ball):
    """Over six fits. Errors are of the size that is reported: a mean square of six squares of unit Gaussians
    lies in [0.06, 3.7] in 999 of 1000 trials."""
    found = coverage(ball, NOISES["tenfold with brightness"], 6)
    assert found["within two standard errors"]["standard_errors"][".mean_free_path"] >= 5 / 6
    assert 0.06 < found["error in standard errors, rms"]["standard_errors"] ** 2 < 3.7
    assert found["false alarms"] == 0
    assert 0.6 < found["reduced chi-squared"][1] < 1.5


def test_published_templates_do_not_fit_path_traced_images_and_the_fit_says_so(ball):
    (volume, transfer, *_), paths = ball.scene(ball.truth, ball.cameras[0]), 64
    how = {"materials": ball.truth, "paths": paths}
    views = [(view, jv.path_trace(volume, transfer, view, lights(), **how)) for view in ball.cameras]
    residual = jv.ImageResidual(ball.scene, views, (0, 0, 0))
    with pytest.warns(UserWarning, match=r"The model does not fit .* times as large as noise \(reduced chi-"):
        found = jv.fit(residual, ball.start, patience=4)
    told = found.uncertainty
    assert told is not None
    assert told.reduced_chi_squared is not None
    assert told.reduced_chi_squared > 1.5
    # of blurred images, the noise is unknown
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        blurred = jv.fit(residual.blurred(0.1), ball.start, max_steps=2)
    assert blurred.uncertainty is not None
    assert blurred.uncertainty.reduced_chi_squared is None


@pytest.mark.slow
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("model", [three_opacities, mean_free_path])
def test_the_truth_lies_within_two_standard_errors_in_85_of_100_fits(model, noise):
    """Of all three kinds of noise, where standard errors for equal noise cover it in some 50 alone."""
    found = coverage(model(16, 16), NOISES[noise], 40)
    covered = found["all"]
    assert covered["standard_errors"] >= 0.85
    assert found["false alarms"] == 0
    if noise != "equal":
        assert covered["covariance_of_equal_noise"] < 0.7


def test_standard_errors_are_those_of_many_parameters_beside_a_background():
    """Of a linear model of 90 entries and 40 parameters, and 600 entries that depend on none."""
    random = np.random.default_rng(0)
    jacobian = np.concatenate([random.normal(size=(90, 40)), np.zeros((600, 40))])
    project, triangles = np.linalg.pinv(jacobian), jax.jit(Triangles.of)
    off = []
    for _ in range(200):
        noise = random.normal(0, 0.01, 690)
        found = project @ noise
        rows = np.concatenate([jacobian, (noise - jacobian @ found)[:, None]], axis=1)[:, None]
        residual, scores, informed = triangles(rows.astype(np.float32))
        both = (np.linalg.qr(np.asarray(matrix), "r") for matrix in (residual, scores))
        spread = spreads(Triangles(*jax.device_put((*both, informed))), 690, 1.0).unequal
        off.append(found / np.linalg.norm(spread, axis=1))
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1, abs=0.08)
