"""Gathers some entries of arrays, and processes them in chunks of fixed size."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .sharding import varying
from .trees import PyTree


CHUNK = 2048
"""Entries processed at a time, if nothing else is asked for."""


class Chosen(NamedTuple):
    """Chosen entries of arrays (rows, columns), of which there may be several, stacked along the rows.

    - `indices`: flat indices of the chosen entries, padded with indices past the end.
    - `number`: how many are chosen.
    - `columns`: of the arrays.
    - `chunk`: entries processed at a time.
    """

    indices: Int[Array, " entries"]
    number: Int[Array, ""]
    columns: int
    chunk: int

    @classmethod
    def of(cls, chosen: list[Bool[Array, "rows columns"]], chunk: int = CHUNK) -> "Chosen":
        """The entries where these are true."""
        whole = jnp.concatenate(chosen)
        number = jnp.sum(whole, dtype=jnp.int32)
        return cls(in_front(whole.reshape(-1), chunk), number, whole.shape[1], chunk)

    def fold(self, one: Callable[[Int[Array, " chunk"], PyTree], PyTree], start: PyTree) -> PyTree:
        """Folds `one(indices, carry)` over the chunks of indices."""

        def body(state: tuple[Int[Array, ""], PyTree]) -> tuple[Int[Array, ""], PyTree]:
            i, carry = state
            return i + 1, one(jax.lax.dynamic_slice_in_dim(self.indices, i * self.chunk, self.chunk), carry)

        begin = varying((jnp.zeros((), jnp.int32), start), self.number)
        return jax.lax.while_loop(lambda state: state[0] * self.chunk < self.number, body, begin)[1]

    def take(self, arrays: list[PyTree], indices: Int[Array, " chunk"]) -> PyTree:
        """The entries at these flat indices."""

        def taken(*leaves: Array) -> Array:
            return jnp.concatenate(leaves).reshape(-1).at[indices].get(mode="clip")

        return jax.tree.map(taken, *arrays)

    def put(self, whole: PyTree, indices: Int[Array, " chunk"], part: PyTree) -> PyTree:
        """Flat arrays with these entries at these indices."""
        return jax.tree.map(lambda leaf, new: leaf.at[indices].set(new, mode="drop"), whole, part)

    def split(self, whole: PyTree, arrays: int) -> list[PyTree]:
        """Flat arrays, split into so many arrays (rows, columns) again."""
        leaves, tree = jax.tree.flatten(whole)
        each = (leaf.reshape(arrays, -1, self.columns) for leaf in leaves)
        return [jax.tree.unflatten(tree, part) for part in zip(*each, strict=True)]


def in_front(chosen: Bool[Array, " entries"], chunk: int = CHUNK) -> Int[Array, " padded"]:
    """Indices of the chosen entries, in order, followed by indices past the end, up to a whole number of
    chunks. `chunk`: a multiple of 128.

    Like `jnp.nonzero`, in a quarter of its time for 16 384 entries on CPU, and two thirds for 65 536, where
    the scatter weighs more. XLA's cumulative sums are slow; here they are a product with a triangle of ones,
    which is exact for numbers as small as these."""
    padded = jnp.pad(chosen, (0, -chosen.size % chunk))
    rows = padded.reshape(-1, 128).astype(jnp.float32)
    within = jnp.matmul(rows, jnp.triu(jnp.ones((128, 128), rows.dtype), 1), precision="highest")
    totals = jnp.sum(rows, axis=1)
    rank = within + (jnp.cumsum(totals) - totals)[:, None]
    last = padded.size
    return (
        jnp.full(last, chosen.size, jnp.int32)
        .at[jnp.where(padded, rank.reshape(-1).astype(jnp.int32), last)]
        .set(jnp.arange(last, dtype=jnp.int32), mode="drop", unique_indices=True)
    )
