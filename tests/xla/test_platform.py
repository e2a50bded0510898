"""Do programs for a GPU loop and branch as they should, with the same results?"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol._util.piecewise_linear import points_below
from jaxvol.xla import platform
from jaxvol.xla.memory import in_memory
from jaxvol.xla.platform import TURNS, on_gpu, while_loop

from ..round_trips import counted


@pytest.fixture(params=["cpu", "gpu"])
def way(request, monkeypatch):
    monkeypatch.setattr(platform, "platform", lambda: request.param)
    return request.param


def test_the_default_device_decides_which_platform_a_program_is_for(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert on_gpu()
    for device in (jax.devices("cpu")[0], "cpu"):
        with jax.default_device(device):
            assert not on_gpu()


def test_a_gpu_is_known_by_each_of_its_names(monkeypatch):
    for name, is_gpu in (("gpu", True), ("cuda", True), ("rocm", True), ("tpu", False)):
        monkeypatch.setattr(platform, "platform", lambda name=name: name)
        assert on_gpu() is is_gpu


def test_surplus_turns_change_nothing(way):
    def count(last):
        return while_loop(lambda i: i < last, lambda i: i + 1, jnp.zeros((), jnp.int32))

    for last in (0, 1, TURNS, 5 * TURNS - 1):
        reached, trips = counted(count, np.int32(last))
        assert reached == last
        assert trips.number == 1 + (last if way == "cpu" else -(-last // TURNS))

    # elements of a batch stop each by itself
    halved = jax.jit(jax.vmap(lambda x: while_loop(lambda x: x > 1, lambda x: x / 2, x)))
    x = np.array([1.5, 96.0, 0.25, 2.0**40, np.nan], np.float32)
    np.testing.assert_array_equal(halved(x), [0.75, 0.75, 0.25, 1.0, np.nan])


def test_what_lies_in_memory_takes_a_branch_only_where_that_is_cheap(way):
    def twice(x):
        return in_memory(jnp.all(x > 0), lambda x: (2 * x, x + 1), x)

    x = np.arange(1, 9, dtype=np.float32)
    (doubled, more), trips = counted(twice, x)
    np.testing.assert_array_equal(doubled, 2 * x)
    np.testing.assert_array_equal(more, x + 1)
    assert trips.number == (1 if way == "cpu" else 0)
    if way == "gpu":
        assert "optimization_barrier" in str(jax.make_jaxpr(twice)(x))

    @jax.jit
    def slopes(x):  # differentiated, either way
        value, pull = jax.vjp(lambda x: twice(x)[0], x)
        ones = jnp.ones_like(value)
        return pull(ones)[0], jax.jvp(lambda x: twice(x)[0], (x,), (ones,))[1]

    np.testing.assert_array_equal(slopes(x), np.full((2, 8), 2))


@pytest.mark.parametrize("even", [True, False])
def test_points_are_counted_alike(way, even):
    rng = np.random.default_rng(0)
    points = np.linspace(-1, 3, 40) if even else np.sort(rng.uniform(-1, 3, 40))
    points = points.astype(np.float32)
    value = np.concatenate([rng.uniform(-2, 4, 300).astype(np.float32), points])
    for strictly in (False, True):
        below, trips = counted(partial(points_below, strictly=strictly), points, value)
        expected = np.searchsorted(points, value, side="left" if strictly else "right")
        np.testing.assert_array_equal(below, expected)
        assert trips.number == (1 if way == "cpu" else 0)
