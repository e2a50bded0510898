"""Adds rows up by an index that each has: the transpose of looking rows up in a table.

On a GPU, rows of one index are added by atomic operations, one after the other. (On an H200, 1.5 ms for a
million rows of one index.) So zeros, which most samples of a march that has ended give, are left out there,
and a table that many samples share is summed in copies.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .platform import on_gpu


COPIES, ROWS = 128, 2**15
"""On a GPU, the most copies of a table, and the most rows of all its copies."""


def row_sums(
    number: int, index: Int[Array, "*batch"], rows: Float[Array, "*batch columns"]
) -> Float[Array, "{number} columns"]:
    """The sum of the rows of each index from 0 to before `number`, in which all indices lie."""
    if not on_gpu():
        zeros = jnp.zeros((number, rows.shape[-1]), rows.dtype)
        return zeros.at[index].add(rows, mode="promise_in_bounds")
    index, rows = index.reshape(-1), rows.reshape(-1, rows.shape[-1])
    copies = max(1, min(COPIES, ROWS // number))
    copy = jnp.arange(index.size, dtype=index.dtype) % copies
    place = without_zeros(number * copy + index, rows, copies * number)
    zeros = jnp.zeros((copies * number, rows.shape[-1]), rows.dtype)
    return jnp.sum(zeros.at[place].add(rows, mode="drop").reshape(copies, number, -1), axis=0)


def without_zeros(
    index: Int[Array, " rows"], rows: Float[Array, "rows columns"], end: int
) -> Int[Array, " rows"]:
    """The indices of rows, but `end`, which is none, where nothing is to be added."""
    return jnp.where(jnp.any(rows != 0, axis=-1), index, end)
