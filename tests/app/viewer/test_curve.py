"""Do the points of a viewer make the transfer function that they show?"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvol as jv
from jaxvol.app.viewer.curve import MOST, Curve


GIVEN = jv.TransferFunction(
    [10, 20, 20, 50], [(0, 0, 0), (1, 0, 0), (0, 0.5, 0), (0.2, 0.4, 0.6)], [0, 1, 3, 0.5]
)
CURVE = Curve.of(GIVEN, 0.5)
AT = np.concatenate([np.linspace(-50, 300, 701), [19.999, 20.0, 20.001]]).astype(np.float32)


@eqx.filter_jit
def looked_up(transfer):
    color, extinction = jax.vmap(transfer)(jnp.asarray(AT))
    return jnp.stack([*color, extinction], axis=-1)


def test_padding_changes_nothing_and_gives_one_shape():
    padded = CURVE.padded()
    assert padded.values.shape == (MOST,)
    np.testing.assert_allclose(looked_up(padded), looked_up(GIVEN), atol=1e-6)
    assert CURVE.without(3).padded().values.shape == (MOST,)
    many = jv.colormap("gray", (0, 1), n_colors=40)
    assert not Curve.of(many, 1).editable
    assert Curve.of(many, 1).padded().values.shape == (40,)


def test_window_and_level_move_all_points():
    moved = CURVE.over(80, 100)
    assert (moved.window, moved.level) == (80, 100)
    assert moved.values == (60, 80, 80, 140)
    assert moved.colors == CURVE.colors
    for window, level in ((0, 1), (-1, 1), (math.nan, 1), (1, math.inf)):
        with pytest.raises(ValueError, match="window must be above 0"):
            CURVE.over(window, level)


def test_a_point_is_set_as_it_is_shown():
    changed = CURVE.changed(3, color=(0.5, 0.25, 1.0), opacity=0.3)
    assert changed.opacity(3) == pytest.approx(0.3)
    assert changed.display_color(3) == pytest.approx((0.5, 0.25, 1.0), abs=1e-5)
    transfer = changed.transfer()
    assert transfer.opacity(0.5)[3] == pytest.approx(0.3)
    assert np.isfinite(CURVE.changed(3, opacity=1.0).extinctions[3])


def test_a_value_stays_between_its_neighbours():
    plain = CURVE.without(2)
    assert plain.changed(1, value=33).values == (10, 33, 50)
    for value in (-7.0, 1e9):
        moved = plain.changed(1, value=value)
        assert moved.values[0] < moved.values[1] < moved.values[2]
    assert plain.changed(2, value=1e4).values[2] == 1e4
    moved.padded()  # a legal transfer function


def test_a_point_that_is_added_changes_nothing():
    split = CURVE.split(2)
    assert len(split) == 5
    np.testing.assert_allclose(looked_up(split.padded()), looked_up(CURVE.padded()), atol=1e-6)
    assert split.without(3) == CURVE
    with pytest.raises(ValueError, match="no room"):
        CURVE.split(3)
    with pytest.raises(ValueError, match="at least 2"):
        CURVE.without(0).without(0).without(0)
    with pytest.raises(ValueError, match="no room for another point in a step: two are at 20"):
        CURVE.split(1)


def test_a_step_alone_is_padded_moved_and_made_a_ramp():
    for value in (0.0, 20.0, -1e6):
        given = jv.TransferFunction([value, value], [(1, 0, 0), (0, 0, 1)], [0, 2])
        step = Curve.of(given, 1.0)
        assert step.padded().values.shape == (MOST,)
        np.testing.assert_array_equal(looked_up(step.padded()), looked_up(given))
        assert step.over(0, 7).values == (7, 7)
        assert step.over(4, 7).values == (5, 9)
        assert step.over(4, 7).over(0, value) == step


def test_what_is_no_color_opacity_or_value_is_refused():
    changes: list[dict[str, Any]] = [{"color": (0, 2, 0)}, {"opacity": -0.1}, {"opacity": math.nan}]
    changes.append({"value": math.inf})
    for change in changes:
        with pytest.raises(ValueError, match="in \\[0, 1\\]"):
            CURVE.changed(1, **change)
    with pytest.raises(ValueError, match="no point 9"):
        CURVE.changed(9, opacity=0.5)
