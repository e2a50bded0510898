"""Are leaps counted as a single ray takes them, and are late starts seen?"""

import math

import numpy as np
import pytest

from experiments.atlas.leaping import EYE, WALL, above_a_wall
from experiments.ray_leaps import Counts, Marcher, Saved, grid_of


@pytest.mark.parametrize("angle", [90.0, 35.0, 8.0])
def test_a_ray_to_a_flat_wall_takes_the_leaps_of_its_heights_and_hits_where_the_plane_is(angle):
    scene = above_a_wall(angle, 1)
    counts = Marcher(scene).count(scene.camera)
    fall = math.sin(math.radians(angle))
    index = leaps = 0
    while (height := EYE - index * fall) >= math.ceil(WALL):  # below, cells hold the wall
        leaps += 1
        # of cells of unit size, less their diagonal
        index += max(math.floor(math.floor(height) - math.floor(WALL) - math.sqrt(3)), 1)
    hit = math.ceil((EYE - WALL) / fall)
    assert counts.leaps.item() == leaps
    assert counts.hit.item() == hit
    assert counts.samples.item() == hit + 1 - index  # the first of the wall ends it


def test_starts_are_the_nearest_of_four_corners_and_what_lies_before_them_is_late():
    hit = np.full((5, 5), 9)
    hit[0, 4], hit[4, 4], hit[1, 1] = 6, 3, 2
    grid = grid_of(hit, 2)
    expected = [[0, 9, 0, 6, 0], [9, 9, 6, 6, 6], [0, 9, 0, 3, 0], [9, 9, 3, 3, 3], [0, 9, 0, 3, 0]]
    np.testing.assert_array_equal(grid.start, expected)
    assert grid.spread[0, 0] == 0
    assert grid.spread[3, 3] == pytest.approx(2 / 3)
    assert grid.spread[1, 3] == pytest.approx(1 / 3)
    alone = Counts(np.full((5, 5), 4), np.full((5, 5), 2), hit, np.full((5, 5), 20))
    started = alone._replace(leaps=np.full((5, 5), 1))
    assert Saved.of(alone, started, grid) == pytest.approx((3 / 4, 1 / 2, 1 / 25))
