"""Do a viewer's controls change a transfer function as they say?"""

import math

import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.viewer.editing import (
    MAX_POINTS,
    display_color,
    window_level,
    with_color,
    with_opacity,
    with_points_at,
    with_value,
    with_window_level,
    without_point,
)
from jaxvol.scene.transfer import with_shared_points


GIVEN = jv.TransferFunction(
    [10, 20, 20, 50], [(0, 0, 0), (1, 0, 0), (0, 0.5, 0), (0.2, 0.4, 0.6)], [0, 1, 3, 0.5]
)
AT = np.concatenate([np.linspace(-50, 300, 701), [19.999, 20.0, 20.001]]).astype(np.float32)


def looked_up(transfer):
    values, colors, extinction = parts_of(transfer)
    return np.stack([np.interp(AT, values, part) for part in (*colors.T, extinction)], axis=-1)


def parts_of(transfer):
    """Values, colours and extinctions, in NumPy, whose operations are no programs."""
    return tuple(np.asarray(part, float) for part in (transfer.values, transfer.colors, transfer.extinction))


def assert_same_function(one, other):
    np.testing.assert_allclose(looked_up(one), looked_up(other), atol=1e-6)


def test_shared_numbers_of_points_change_nothing():
    for given in (GIVEN, jv.colormap("gray", (0, 1), n_colors=40, unit_distance=1.0)):
        shared = with_shared_points(given)
        assert shared.values.shape == ((8,) if given is GIVEN else (256,))
        assert_same_function(shared, given)
        assert with_shared_points(shared) is shared
    assert with_shared_points(jv.colormap("gray", (0, 1), n_colors=3)).per_voxel


def test_window_and_level_move_all_points():
    moved = with_window_level(GIVEN, 80, 100)
    assert window_level(moved) == (80, 100)
    assert moved.values.tolist() == [60, 80, 80, 140]
    np.testing.assert_array_equal(moved.colors, GIVEN.colors)
    for window, level in ((0, 1), (-1, 1), (math.nan, 1), (1, math.inf)):
        with pytest.raises(ValueError, match="values must"):
            with_window_level(GIVEN, window, level)
    with pytest.raises(ValueError, match="values must increase"):
        with_window_level(GIVEN, 1e-9, 1e3)  # float32 has one number there


def test_a_point_is_set_as_it_is_shown():
    changed = with_opacity(with_color(GIVEN, 3, "#8040ff"), 3, 0.3, 0.5)
    _, colors, extinction = parts_of(changed)
    assert -np.expm1(-0.5 * extinction[3]) == pytest.approx(0.3)
    assert display_color(colors[3]) == "#8040ff"
    np.testing.assert_allclose(colors[3], jv.from_srgb([128 / 255, 64 / 255, 1]), atol=1e-6)
    np.testing.assert_array_equal(colors[:3], parts_of(GIVEN)[1][:3])
    np.testing.assert_array_equal(extinction[:3], parts_of(GIVEN)[2][:3])
    assert np.isfinite(parts_of(with_opacity(GIVEN, 3, 1.0, 0.5))[2][3])


def test_a_value_stays_between_its_neighbours():
    plain = without_point(GIVEN, 2)
    assert with_value(plain, 1, 33).values.tolist() == [10, 33, 50]
    for value in (-7.0, 1e9):
        low, middle, high = parts_of(with_value(plain, 1, value))[0]
        assert low < middle < high
    assert parts_of(with_value(plain, 2, 1e4))[0][2] == 1e4


def test_a_point_that_is_added_changes_nothing():
    split = with_points_at(GIVEN, [35])
    assert len(split.values) == 5
    assert_same_function(split, GIVEN)
    assert_same_function(without_point(split, 3), GIVEN)
    with pytest.raises(ValueError, match="at least 2"):
        without_point(without_point(without_point(GIVEN, 0), 0), 0)
    with pytest.raises(ValueError, match="no room for another"):
        with_points_at(GIVEN, np.linspace(1, 9, MAX_POINTS))


def test_a_step_alone_is_shared_and_moved():
    for value in (0.0, 20.0, -1e6):
        step = jv.TransferFunction([value, value], [(1, 0, 0), (0, 0, 1)], [0, 2])
        np.testing.assert_array_equal(looked_up(with_shared_points(step)), looked_up(step))
        assert with_window_level(step, 0, 7).values.tolist() == [7, 7]


def test_what_is_no_color_opacity_or_value_is_refused():
    for opacity in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="opacity must"):
            with_opacity(GIVEN, 1, opacity, 0.5)
    with pytest.raises(ValueError, match="values must"):
        with_value(GIVEN, 3, math.inf)
    with pytest.raises(ValueError, match="Invalid hex color"):
        with_color(GIVEN, 1, "#12")
