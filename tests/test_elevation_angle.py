"""Is the angle of a sweep told from the shape of shells, where it can be, and not where it cannot?"""

import numpy as np
import pytest

from experiments import elevation_angle


@pytest.mark.parametrize("reading", elevation_angle.READINGS)
def test_perfect_shells_tell_under_which_reading_they_were_made(reading):
    echo = elevation_angle.made(elevation_angle.READINGS[reading], elevation_angle.SHAPE)
    found = elevation_angle.measure(echo)
    assert found["shape that leaves least"] == elevation_angle.COSINE
    assert found["reading"] == reading


def test_bows_are_those_that_the_shells_were_made_with():
    """2.5 samples high, and the cosine of the angle."""
    half = elevation_angle.ELEVATION
    late = np.cos(np.deg2rad(np.linspace(-half, half, elevation_angle.SHAPE[0] - 1)))
    expected = 2.5 * (late - late.max()) / np.ptp(late)
    echo = elevation_angle.made(half, elevation_angle.SHAPE)
    for window in elevation_angle.WINDOWS:
        found = elevation_angle.bow(echo[1:], window)
        inner = slice(4, -4)  # planes are smoothed: fewer lie to either side of the first and the last
        np.testing.assert_allclose(found[inner] - found.max(), expected[inner], atol=0.06)


def test_shells_that_shift_by_more_than_the_readings_differ_settle_nothing():
    """Planes shifted at random by a fifth of a sample: the readings differ by a hundredth."""
    rng = np.random.default_rng(0)
    for half in elevation_angle.READINGS.values():
        echo = elevation_angle.made(half, elevation_angle.SHAPE)
        sample = np.arange(elevation_angle.SHAPE[2])
        for plane in echo[1:]:
            plane[:] = np.interp(sample + 0.2 * rng.normal(), sample, plane[0])
        assert elevation_angle.measure(echo)["reading"] == "not settled"
