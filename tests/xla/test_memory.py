"""Sums of rows by index, and of cubes of voxels, as on a CPU and as on a GPU."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.scene.voxel_fetch import Fetched, scatter_add
from jaxvol.xla import platform
from jaxvol.xla.memory import COPIES, ROWS, row_sums, without_zeros


@pytest.mark.parametrize(
    ("number", "name"), [(5, "cpu"), (5, "gpu"), (ROWS // COPIES + 1, "gpu"), (2 * ROWS, "gpu")]
)
def test_sums_are_those_of_float64(number, name, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: name)
    random = np.random.default_rng(number)
    index = random.integers(0, number, (7, 301)).astype(np.int32)
    rows = random.normal(size=(7, 301, 3)).astype(np.float32)
    rows[random.random((7, 301)) < 0.4] = 0
    expected = np.zeros((number, 3))
    np.add.at(expected, index, rows.astype(np.float64))
    sums = jax.jit(partial(row_sums, number))
    found = sums(index, rows)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4)
    rows[3, 5, 1] = np.nan  # is not lost
    assert np.argwhere(np.isnan(sums(index, rows))).tolist() == [[index[3, 5], 1]]


def test_zeros_are_left_out_and_the_rows_of_one_index_are_dealt_to_copies(monkeypatch):
    """What takes time on a GPU: additions to the same place."""
    rows = np.float32([[0, 0], [0, -1], [3, 0], [-0.0, 0]])
    left = jax.jit(without_zeros, static_argnums=2)(np.arange(4, dtype=np.int32), rows, 9)
    np.testing.assert_array_equal(left, [9, 1, 2, 9])
    monkeypatch.setattr(platform, "platform", lambda: "gpu")
    index, ones = np.zeros(4 * COPIES, np.int32), jax.device_put(np.ones((4 * COPIES, 1), np.float32))
    program = jax.make_jaxpr(lambda index: row_sums(7, index, ones))(index)
    (scatter,) = (step for step in program.eqns if step.primitive.name == "scatter-add")
    assert scatter.invars[0].aval.shape == (7 * COPIES, 1)


@pytest.mark.parametrize("name", ["cpu", "gpu"])
def test_cubes_are_added_to_the_voxels_that_they_were_fetched_from(name, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: name)
    shape, random = (4, 5, 6), np.random.default_rng(0)
    nodes = random.integers(0, np.array(shape) - 1, (200, 3))
    nodes[:2] = (0, 0, 0), np.array(shape) - 2  # the last pair ends with the last voxel
    parts = random.normal(size=(200, 2, 2, 2)).astype(np.float32)
    parts[random.random((200, 2, 2)) < 0.5] = 0  # pairs to which nothing is added
    for half in (0, 1):  # or to one of them
        parts[..., half][random.random((200, 2, 2)) < 0.3] = 0
    expected = np.ones(shape)
    for (i, j, k), part in zip(nodes, parts, strict=True):
        expected[i : i + 2, j : j + 2, k : k + 2] += part
    base = np.ravel_multi_index(tuple(nodes.T), shape).astype(np.int32)

    @jax.jit
    def added(voxels, base, parts):
        cube = [[[parts[:, x, y, z] for z in (0, 1)] for y in (0, 1)] for x in (0, 1)]
        return scatter_add(voxels, shape, [Fetched(base)], [cube])

    found = added(np.ones(np.prod(shape), np.float32), base, parts)
    np.testing.assert_allclose(found.reshape(shape), expected, rtol=0, atol=1e-5)
