"""Sums of rows by index, as on a CPU and as on a GPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol._util import platform
from jaxvol._util.row_sums import COPIES, ROWS, row_sums, without_zeros


@pytest.fixture(params=["cpu", "gpu"])
def each_platform(request, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: request.param)
    return request.param


@pytest.mark.parametrize("number", [1, 5, ROWS // COPIES + 1, 2 * ROWS])
def test_sums_are_those_of_float64(number, each_platform):
    random = np.random.default_rng(number)
    index = random.integers(0, number, (7, 301))
    rows = random.normal(size=(7, 301, 3)).astype(np.float32)
    rows[random.random((7, 301)) < 0.4] = 0
    expected = np.zeros((number, 3))
    np.add.at(expected, index, rows.astype(np.float64))
    found = row_sums(number, jnp.asarray(index, jnp.int32), jnp.asarray(rows))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)


def test_nan_is_not_lost(each_platform):
    rows = jnp.asarray([[0.0, jnp.nan], [1.0, 2.0], [0.0, 0.0]])
    found = row_sums(2, jnp.asarray([1, 0, 0]), rows)
    np.testing.assert_array_equal(found, [[1, 2], [0, np.nan]])


def test_zeros_are_left_out_and_the_rows_of_one_index_are_dealt_to_copies(monkeypatch):
    """What takes time on a GPU: additions to the same place."""
    rows = jnp.asarray([[0.0, 0.0], [0.0, -1.0], [3.0, 0.0], [-0.0, 0.0]])
    np.testing.assert_array_equal(without_zeros(jnp.asarray([0, 1, 2, 3]), rows, 9), [9, 1, 2, 9])

    monkeypatch.setattr(platform, "platform", lambda: "gpu")
    index, ones = jnp.zeros(4 * COPIES, jnp.int32), jnp.ones((4 * COPIES, 1))
    program = jax.make_jaxpr(lambda index: row_sums(7, index, ones))(index)
    (scatter,) = (step for step in program.eqns if step.primitive.name == "scatter-add")
    assert scatter.invars[0].aval.shape == (7 * COPIES, 1)
    np.testing.assert_array_equal(row_sums(7, index, ones)[:, 0], [4 * COPIES] + [0] * 6)
