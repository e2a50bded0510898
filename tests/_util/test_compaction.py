"""Are chosen entries gathered in order, and scattered back to their places?"""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol._util.compaction import CHUNK, Chosen


@pytest.mark.parametrize(
    ("shape", "share"), [((3, 5), 0.5), ((8, 700), 0.1), ((1, 3000), 1.0), ((2, 7), 0.0), ((1, CHUNK), 0.7)]
)
def test_the_chosen_ones_are_in_front_and_in_order(shape, share):
    masks = np.random.default_rng(0).random((2, *shape)) < share
    chosen = Chosen.of([jnp.asarray(mask) for mask in masks])
    expected = np.flatnonzero(masks)
    assert chosen.number == len(expected)
    np.testing.assert_array_equal(chosen.indices[: len(expected)], expected)
    assert chosen.indices.size % CHUNK == 0
    assert np.all(chosen.indices[len(expected) :] == masks.size)


def test_each_chosen_one_is_taken_once_and_put_where_it_was():
    rng = np.random.default_rng(1)
    values = [jnp.asarray(rng.normal(size=(4, 900)), jnp.float32) for _ in range(2)]
    chosen = Chosen.of([value > 0.5 for value in values])

    def one(indices, carry):
        whole, visits = carry
        found = chosen.take(values, indices)
        return chosen.put(whole, indices, 2 * found), visits.at[indices].add(1, mode="drop")

    whole, visits = chosen.fold(one, (jnp.zeros(7200), jnp.zeros(7200)))
    for value, part, count in zip(values, chosen.split(whole, 2), chosen.split(visits, 2), strict=True):
        np.testing.assert_array_equal(part, np.where(value > 0.5, 2 * value, 0))
        np.testing.assert_array_equal(count, value > 0.5)


def test_all_at_once_each_chosen_one_is_put_where_it_was_and_no_other():
    values = jnp.asarray(np.random.default_rng(1).normal(size=(4, 900)), jnp.float32)
    chosen = Chosen.of([values > 0.5], chunk=0)
    np.testing.assert_array_equal(chosen.number, np.sum(values > 0.5))
    calls = []

    def one(indices, whole):
        calls.append(indices.shape)
        return chosen.put(whole, indices, 2 * chosen.take([values], indices))

    (whole,) = chosen.split(chosen.fold(one, jnp.zeros(3600)), 1)
    assert calls == [(3600,)]
    np.testing.assert_array_equal(whole, np.where(values > 0.5, 2 * values, 0))
