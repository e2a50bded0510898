"""Are chosen entries gathered in order, and scattered back to their places?"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvol.xla.compaction import CHUNK, Chosen


def test_the_chosen_ones_are_in_front_and_in_order():
    chosen_of = jax.jit(lambda masks: ((c := Chosen.of(list(masks))).number, c.indices))
    for shape, shares in (((3, 5), [0.5]), ((8, 700), [0.1, 1.0, 0.0])):
        for share in shares:
            masks = np.random.default_rng(0).random((2, *shape)) < share
            number, indices = map(np.asarray, chosen_of(masks))
            expected = np.flatnonzero(masks)
            assert number == len(expected)
            np.testing.assert_array_equal(indices[: len(expected)], expected)
            assert indices.size % CHUNK == 0
            assert np.all(indices[len(expected) :] == masks.size)


@pytest.mark.parametrize("chunk", [None, 0])
def test_each_chosen_one_is_taken_once_and_put_where_it_was(chunk):
    """In chunks, or all at once."""
    rng = np.random.default_rng(1)
    values = [rng.normal(size=(4, 900)).astype(np.float32) for _ in range(2)]
    calls = []

    @jax.jit
    def doubled(values):
        how = {} if chunk is None else {"chunk": chunk}
        chosen = Chosen.of([value > 0.5 for value in values], **how)

        def one(indices, carry):
            whole, visits = carry
            calls.append(indices.shape)
            found = chosen.take(values, indices)
            return chosen.put(whole, indices, 2 * found), visits.at[indices].add(1, mode="drop")

        whole, visits = chosen.fold(one, (jnp.zeros(7200), jnp.zeros(7200)))
        return chosen.split(whole, 2), chosen.split(visits, 2)

    for value, part, count in zip(values, *doubled(values), strict=True):
        np.testing.assert_array_equal(part, np.where(value > 0.5, 2 * value, 0))
        np.testing.assert_array_equal(count, value > 0.5)
    assert set(calls) == {(7200,) if chunk == 0 else (CHUNK,)}
