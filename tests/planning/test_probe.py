"""Are errors that are estimated from a part of an image those of the image?"""

import itertools
import math

import jax
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.planning.probe import (
    PATCHES,
    SIDE,
    SMALL_PATCHES,
    Probe,
    Reference,
    likely_patches,
    pixels_of,
    rays_of,
)

from ..scenes import scaled_phantom


VOLUME = scaled_phantom("sphere")
WIDTH, HEIGHT = 251, 157
"""Of an image of more patches than are rendered, those at its right and lower edges cut off."""


def camera_of(size: tuple[int, int], zoom: float = 1.0) -> jv.Camera:
    return jv.Camera.looking_at(VOLUME, (0.5, -1, 0.4), size=size).zoom(zoom)


def large() -> jv.Camera:
    return camera_of((300, 200), 2).crop(10, 20, WIDTH, HEIGHT)


def patches_of(camera: jv.Camera) -> int:
    return math.prod(-(-n // SIDE) for n in camera.size)


def probe_of(camera: jv.Camera, seed: int = 0) -> Probe:
    """All patches are likely to be visible."""
    return Probe.of(camera, np.ones(patches_of(camera), bool), seed)


def error_of(probe: Probe, image: jv.Rendering, truth: jv.Rendering) -> float:
    """Compared with an image that is known to be the truth."""
    return Reference(probe, truth, 0.0).error(image)


def share_of(probe: Probe) -> float:
    """Part of the image's pixels that may show anything."""
    return probe.mean(np.ones(probe.inside.size))


def rendered(rgba, ended=None) -> jv.Rendering:
    """A rendering of these pixels, of which one ray may have used up its samples."""
    exhausted = np.zeros(np.shape(rgba)[:-1], bool)
    if ended is not None:
        exhausted[ended] = True
    return jv.Rendering(*jax.device_put((np.asarray(rgba, np.float32), exhausted)))


def at_pixels(probe: Probe, image: np.ndarray, ended=None) -> jv.Rendering:
    """A rendering of the probe's pixels, taken from an image."""
    column, row = np.asarray(probe.source.pixels).T
    return rendered(image[row, column], ended)


def distance(a, b) -> float:
    """RMSE over black or over white, whichever is greater."""
    change = a - b
    over_white = change[..., :3] - change[..., 3:]
    return max(np.sqrt(np.mean(each**2)) for each in (change[..., :3], over_white))


@pytest.mark.parametrize("size", [(40, 48), (20, 13)])
def test_an_image_of_few_patches_is_known_whole(size):
    probe = probe_of(camera_of(size, zoom=3))
    assert probe.strata.size == SMALL_PATCHES  # as of all small images
    a, b = np.random.default_rng(0).random((2, *size[::-1], 4))
    assert share_of(probe) == pytest.approx(1)
    assert error_of(probe, at_pixels(probe, a), at_pixels(probe, b)) == pytest.approx(
        distance(a, b), rel=1e-5
    )


def test_each_patch_is_taken_once_with_its_own_rays_and_stands_for_its_neighbours():
    camera = large()
    probe = probe_of(camera)
    column, row = np.asarray(probe.source.pixels).T - np.array([[10], [20]])
    for found, expected in zip((probe.source.origins, probe.source.directions), camera.rays(), strict=True):
        np.testing.assert_allclose(found, np.asarray(expected)[row, column], atol=1e-6)
    taken = probe.strata > 0
    first = np.stack([column, row], -1).reshape(PATCHES, -1, 2)[taken, 0]
    assert len(np.unique(first, axis=0)) == taken.sum()
    assert probe.strata.sum() == patches_of(camera)
    assert share_of(probe) == pytest.approx(1, abs=0.02)


def test_from_a_part_the_error_is_a_bound_in_most_cases():
    camera, below = camera_of((WIDTH, HEIGHT), zoom=3), 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        # errors that differ from place to place
        coarse = np.kron(np.exp(random.normal(0, 0.4, (20, 32))), np.ones((8, 8)))[:HEIGHT, :WIDTH]
        error = coarse[..., None] * random.normal(0, 1e-3, (HEIGHT, WIDTH, 4))
        probe = probe_of(camera, seed)
        found, true = (
            error_of(probe, at_pixels(probe, error), at_pixels(probe, 0 * error)),
            distance(error, 0),
        )
        below += found < true
        assert 0.8 < found / true < 1.6
        # and compared with a step of half, whose own error is known from the same patches
        truth = Reference.of(probe, [at_pixels(probe, scale * error) for scale in (1, 0.5, 0.25)])
        below += truth.error(at_pixels(probe, error)) < true
    assert below <= 12


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (1300, 1000), (64, 48)])
def test_patches_where_a_coarse_image_shows_anything_are_likely_and_most_of_a_probe(size):
    """A disc of a fifth of the image's height."""
    camera = camera_of(size)
    edge = np.array([[0.3, 0.3], [0.6, 0.7]]) * np.array(size)[:, None]
    axis, rim = np.asarray(rays_of(camera, *edge.astype(int)).directions, float)

    def disc(rays):
        shows = np.asarray(rays.directions, float) @ axis > rim @ axis
        return rendered(np.repeat(shows, 4).reshape(-1, 4))

    likely = likely_patches(camera, disc)
    patches = np.arange(patches_of(camera))
    shown = np.asarray(disc(rays_of(camera, *pixels_of(camera, patches))).rgba)
    shown = shown.reshape(len(patches), -1).any(axis=1)
    assert likely[shown].all()
    assert likely.sum() < (np.sqrt(shown.sum()) + 7) ** 2
    probe = Probe.of(camera, likely, 0)
    assert probe.likely.sum() == min(likely.sum(), round(7 / 8 * probe.strata.size))
    assert probe.strata.sum() == len(patches)


# -- the truth, from images of steps of a half and a quarter ----------------------------------------------


PATTERN = np.random.default_rng(0).normal(size=(40, 48, 4))


@pytest.fixture(scope="module")
def probe():
    return probe_of(camera_of((48, 40)))


@pytest.mark.parametrize(
    ("alike", "order"), [(1.0, 0.2), *itertools.product((1.0, 0.9, 0.5, 0.0), (0.6, 1, 2))]
)
def test_the_error_of_the_last_image_follows_from_the_halvings(probe, order, alike):
    """Where errors point the same way, where each step has one of its own, and in between; of those no more
    than a bound."""
    limit = at_pixels(probe, 0 * PATTERN)
    own = np.random.default_rng(1).normal(size=(3, *PATTERN.shape))
    patterns = np.sqrt(alike) * PATTERN + np.sqrt(1 - alike) * own
    images = [at_pixels(probe, 0.01 * 2.0 ** (-order * k) * each) for k, each in enumerate(patterns)]
    truth, true = Reference.of(probe, images), [error_of(probe, each, limit) for each in images]
    found = truth.image_error, truth.error(images[0]), truth.error(images[1])
    for each, least in zip(found, (true[2], true[0], true[1]), strict=True):
        assert each == pytest.approx(least, rel=1e-3) if alike == 1 else least * 0.96 < each < least * 1.6


def test_differences_that_grow_say_that_nothing_is_known(probe):
    """Two images that miss what the third one shows, and ones that differ by rounding alone."""
    for first in (0.0, 1e-3):
        images = [at_pixels(probe, scale * PATTERN) for scale in (first, 0.0, 0.01)]
        truth = Reference.of(probe, images)
        assert truth.image_error == pytest.approx(10 * error_of(probe, images[1], images[2]))
    images = [at_pixels(probe, scale * PATTERN) for scale in (0.0, 1e-8, -1e-7)]
    assert Reference.of(probe, images).image_error < 1e-6


def test_images_of_ended_rays_or_that_are_not_finite_have_an_infinite_error(probe):
    image, ended = at_pixels(probe, 0 * PATTERN), at_pixels(probe, 0 * PATTERN, ended=7)
    assert Reference(probe, image, 0.0).error(ended) == np.inf
    assert Reference(probe, ended, 0.0).error(image) == np.inf
    assert Reference(probe, image, 0.0).error(at_pixels(probe, np.nan * PATTERN)) == np.inf
