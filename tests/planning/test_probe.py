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


def probe_of(volume: jv.Volume, camera: jv.Camera, seed: int = 0) -> Probe:
    """All blocks may be visible."""
    return Probe.of(camera, Affine(volume), jnp.ones((6, 6, 6), bool), seed)


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
    probe = probe_of(volume, camera)
    column, row = np.asarray(probe.source.pixels).T
    origins, directions = (np.asarray(part)[row - 20, column - 10] for part in camera.rays())
    np.testing.assert_allclose(probe.source.origins, origins, atol=1e-6)
    np.testing.assert_allclose(probe.source.directions, directions, atol=1e-6)


@pytest.mark.parametrize("size", [(64, 48), (9, 9), (20, 13), (3, 2), (100, 70)])
def test_an_image_of_few_patches_is_known_whole(volume, size):
    width, height = size
    camera = camera_of(volume, size, zoom=3)
    probe = probe_of(volume, camera)
    a, b = np.random.default_rng(0).random((2, height, width, 4))
    expected = max(rmse(*(rendered(w).image(c) for w in (a, b))) for c in ((0, 0, 0), (1, 1, 1)))
    assert probe.share == pytest.approx(1)
    assert probe.distance(at_pixels(probe, a), at_pixels(probe, b)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("size", "zoom"), [((512, 384), 2), ((100, 100), 3), ((109, 97), 3)])
def test_each_patch_is_taken_once_and_stands_for_its_neighbours(volume, size, zoom):
    probe = probe_of(volume, camera_of(volume, size, zoom))
    taken = probe.strata > 0
    first = np.asarray(probe.source.pixels).reshape(PATCHES, -1, 2)[taken, 0]
    assert len(np.unique(first, axis=0)) == taken.sum()
    patches = -(-size[0] // SIDE) * -(-size[1] // SIDE)
    assert 0.98 * patches < probe.strata.sum() <= patches
    assert probe.share == pytest.approx(1, abs=0.02)


def test_from_a_part_the_error_is_a_bound_in_most_cases(volume):
    camera = camera_of(volume, (512, 384), zoom=2)
    below = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        # errors that differ from place to place
        coarse = np.exp(random.normal(0, 0.4, (48, 64)))
        error = np.kron(coarse, np.ones((8, 8)))[..., None] * random.normal(0, 1e-3, (384, 512, 4))
        probe = probe_of(volume, camera, seed)
        found = probe.distance(at_pixels(probe, error), at_pixels(probe, 0 * error))
        over_white = error[..., :3] - error[..., 3:]
        true = max(np.sqrt(np.mean(each**2)) for each in (error[..., :3], over_white))
        below += found < true
        assert 0.8 < found / true < 1.6
    assert below <= 6


def test_most_patches_are_taken_where_something_is_visible(volume):
    camera = camera_of(volume, (512, 512))
    visible = jnp.zeros((6, 6, 6), bool).at[1, 4, 3].set(True)
    probe = Probe.of(camera, Affine(volume), visible, 0)
    first = np.asarray(probe.source.pixels).reshape(PATCHES, -1, 2)[:, 0]
    middle = np.asarray(volume.origin) + np.array([6, 18, 14]) * np.asarray(volume.spacing)
    origin, directions = np.asarray(camera.position), camera.rays()[1]
    at = np.asarray(directions)[first[:, 1], first[:, 0]]
    off = np.linalg.norm(np.cross(middle - origin, at), axis=1) / float(volume.spacing[0])
    assert probe.likely.sum() == 112
    assert off[probe.likely].max() < 24
    assert (off < 3).any()  # where the block is
    assert probe.strata[probe.likely].max() < probe.strata[~probe.likely].min()


def test_only_patches_that_meet_the_volume_are_rendered(volume):
    camera = camera_of(volume, (256, 256), zoom=0.3)
    probe = probe_of(volume, camera)
    assert set(probe.strata) == {0, 1}
    assert 0 < probe.share < 0.3
    away = jv.Camera((0, -9, 0), (0, -20, 0), (0, 0, 1), size=(64, 64))
    assert probe_of(volume, away).strata.sum() == 1


def test_the_error_of_the_last_image_follows_from_the_halvings(volume):
    """Images that converge with the second order, and with the first."""
    probe = probe_of(volume, camera_of(volume))
    pattern = np.random.default_rng(0).normal(size=(48, 64, 4))
    limit = rendered(at_pixels(probe, 0 * pattern).rgba)
    for order in (1, 2):
        images = [at_pixels(probe, 0.01 * 2.0 ** (-order * k) * pattern) for k in range(3)]
        truth = Truth.of(probe, images)
        assert truth.own == pytest.approx(probe.distance(images[-1], limit), rel=1e-4)
        assert truth.error(images[0]) == pytest.approx(probe.distance(images[0], limit), rel=1e-4)


def test_differences_that_grow_say_that_nothing_is_known(volume):
    """Two images that miss what the third one shows, and ones that differ by rounding alone."""
    probe = probe_of(volume, camera_of(volume))
    pattern = np.random.default_rng(0).normal(size=(48, 64, 4))
    for first in (0.0, 1e-3):
        images = [at_pixels(probe, scale * pattern) for scale in (first, 0.0, 0.01)]
        truth = Truth.of(probe, images)
        assert truth.own == pytest.approx(10 * probe.distance(images[1], images[2]))
    images = [at_pixels(probe, scale * pattern) for scale in (0.0, 1e-8, -1e-7)]
    assert Truth.of(probe, images).own < 1e-6


def test_rays_that_used_up_their_samples_have_an_infinite_error(volume):
    probe = probe_of(volume, camera_of(volume))
    image = at_pixels(probe, np.zeros((48, 64, 4)))
    ended = jv.Rendering(image.rgba, image.exhausted.at[7].set(True))
    assert Truth(probe, image, 0.0).error(ended) == np.inf
    assert Truth(probe, ended, 0.0).error(image) == np.inf


def test_an_image_that_is_not_finite_has_an_infinite_error(volume):
    probe = probe_of(volume, camera_of(volume))
    whole = np.zeros((48, 64, 4))
    truth = Truth(probe, at_pixels(probe, whole), 0.0)
    assert truth.error(at_pixels(probe, whole * np.nan)) == np.inf
