"""Are errors that are estimated from a part of an image those of the image?"""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.metrics import rmse
from jaxvol.planning.probe import PATCHES, SIDE, Probe, Truth
from jaxvol.space import Affine

from ..scenes import scaled_phantom


def camera_of(volume: jv.Volume, size: tuple[int, int] = (64, 48), zoom: float = 1.0) -> jv.Camera:
    return jv.Camera.looking_at(volume, (0.5, -1, 0.4), size=size).zoom(zoom)


def rendered(rgba) -> jv.Rendering:
    """A rendering of these pixels."""
    rgba = jnp.asarray(rgba, jnp.float32)
    return jv.Rendering(rgba, jnp.zeros(rgba.shape[:-1], bool))


def at_pixels(probe: Probe, image: np.ndarray) -> jv.Rendering:
    """A rendering of the probe's pixels, taken from an image."""
    column, row = np.asarray(probe.source.pixels).T
    return rendered(image[row, column])


@pytest.fixture(scope="module")
def volume():
    return scaled_phantom("sphere")


def test_its_rays_are_those_of_the_camera(volume):
    camera = camera_of(volume, (300, 200)).crop(10, 20, 256, 160)
    probe = Probe.of(camera, Affine(volume), 0)
    column, row = np.asarray(probe.source.pixels).T
    origins, directions = (np.asarray(part)[row - 20, column - 10] for part in camera.rays())
    np.testing.assert_allclose(probe.source.origins, origins, atol=1e-6)
    np.testing.assert_allclose(probe.source.directions, directions, atol=1e-6)


def test_an_image_of_few_patches_is_known_whole(volume):
    camera = camera_of(volume)
    probe = Probe.of(camera, Affine(volume), 0)
    random = np.random.default_rng(0)
    image, other = random.random((2, 48, 64, 4))
    # no ray that misses the volume shows anything
    hit = np.zeros((48, 64, 1))
    column, row = np.asarray(probe.source.pixels).T
    hit[row, column] = 1
    a, b = at_pixels(probe, image * hit), at_pixels(probe, other * hit)
    whole = [rendered(each * hit) for each in (image, other)]
    expected = max(rmse(*(w.image(c) for w in whole)) for c in ((0, 0, 0), (1, 1, 1)))
    assert probe.used == probe.patches
    assert probe.distance(a, b) == pytest.approx(expected, rel=1e-5)


def test_from_a_part_the_error_is_a_bound_in_most_cases(volume):
    camera = camera_of(volume, (512, 384), zoom=2)
    below = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        # errors that differ from place to place
        coarse = np.exp(random.normal(0, 0.6, (48, 64)))
        error = np.kron(coarse, np.ones((8, 8)))[..., None] * random.normal(0, 1e-3, (384, 512, 4))
        probe = Probe.of(camera, Affine(volume), seed)
        assert probe.used == PATCHES < probe.patches
        found = probe.distance(at_pixels(probe, error), at_pixels(probe, 0 * error))
        true = max(
            np.sqrt(np.mean(error[..., :3] ** 2)), np.sqrt(np.mean((error[..., :3] - error[..., 3:]) ** 2))
        )
        below += found < true
        assert 0.8 < found / true < 1.6
    assert below <= 6


def test_only_patches_that_meet_the_volume_are_rendered(volume):
    camera = camera_of(volume, (256, 256), zoom=0.3)
    probe = Probe.of(camera, Affine(volume), 0)
    assert probe.used == probe.patches < PATCHES
    assert probe.patches * SIDE**2 < 0.3 * 256**2
    away = jv.Camera((0, -9, 0), (0, -20, 0), (0, 0, 1), size=(64, 64))
    assert Probe.of(away, Affine(volume), 0).share == 0


def test_the_error_of_the_last_image_follows_from_the_halvings(volume):
    """Images that converge with the second order, and with the first."""
    probe = Probe.of(camera_of(volume), Affine(volume), 0)
    pattern = np.random.default_rng(0).normal(size=(48, 64, 4))
    limit = rendered(at_pixels(probe, 0 * pattern).rgba)
    for order in (1, 2):
        images = [at_pixels(probe, 0.01 * 2.0 ** (-order * k) * pattern) for k in range(3)]
        truth = Truth.of(probe, images)
        assert truth.own == pytest.approx(probe.distance(images[-1], limit), rel=1e-4)
        assert truth.error(images[0]) == pytest.approx(probe.distance(images[0], limit), rel=1e-4)


def test_an_image_that_is_not_finite_has_an_infinite_error(volume):
    probe = Probe.of(camera_of(volume), Affine(volume), 0)
    whole = np.zeros((48, 64, 4))
    truth = Truth(probe, at_pixels(probe, whole), 0.0)
    assert truth.error(at_pixels(probe, whole * np.nan)) == np.inf
