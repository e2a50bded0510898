"""Compaction: selected entries of arrays, processed in chunks of fixed size."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .sharding import varying
from .trees import PyTree


CHUNK = 2048  # entries processed at a time by default
ROW = 128  # entries that are counted by one product by default


class Chosen(NamedTuple):
    """Chosen entries of one or more arrays (rows, columns), stacked along the rows.

    Attributes:
        indices: flat indices of the chosen entries, padded with indices past the end.
        number: number of chosen entries.
        columns: number of columns of the arrays.
        chunk: entries processed at a time; 0 for all entries, chosen or not.
    """

    indices: Int[Array, " entries"]
    number: Int[Array, ""]
    columns: int
    chunk: int

    @classmethod
    def of(cls, chosen: list[Bool[Array, "rows columns"]], chunk: int = CHUNK, row: int = ROW) -> "Chosen":
        """The entries where the masks are true. `row`: as for `in_front`."""
        stacked = jnp.concatenate(chosen)
        number, flat = jnp.sum(stacked, dtype=jnp.int32), stacked.reshape(-1)
        indices = in_front(flat, chunk, row) if chunk > 0 else in_place(flat)
        return cls(indices, number, stacked.shape[1], chunk)

    def fold(self, step: Callable[[Int[Array, " chunk"], PyTree], PyTree], start: PyTree) -> PyTree:
        """Folds `step(indices, carry)` over the chunks of indices."""
        if self.chunk == 0:
            return step(self.indices, start)

        def body(state: tuple[Int[Array, ""], PyTree]) -> tuple[Int[Array, ""], PyTree]:
            i, carry = state
            return i + 1, step(jax.lax.dynamic_slice_in_dim(self.indices, i * self.chunk, self.chunk), carry)

        begin = varying((jnp.zeros((), jnp.int32), start), self.number)
        return jax.lax.while_loop(lambda state: state[0] * self.chunk < self.number, body, begin)[1]

    def take(self, arrays: list[PyTree], indices: Int[Array, " chunk"]) -> PyTree:
        """Gathers the entries at flat indices."""

        def entries(*leaves: Array) -> Array:
            return jnp.concatenate(leaves).reshape(-1).at[indices].get(mode="clip")

        return jax.tree.map(entries, *arrays)

    def put(self, flat: PyTree, indices: Int[Array, " chunk"], entries: PyTree) -> PyTree:
        """Scatters entries to flat arrays."""
        return jax.tree.map(lambda leaf, new: leaf.at[indices].set(new, mode="drop"), flat, entries)

    def split(self, flat: PyTree, number: int) -> list[PyTree]:
        """Splits flat arrays into `number` arrays (rows, columns)."""
        leaves, tree = jax.tree.flatten(flat)
        parts = (leaf.reshape(number, -1, self.columns) for leaf in leaves)
        return [jax.tree.unflatten(tree, part) for part in zip(*parts, strict=True)]


def in_front(chosen: Bool[Array, " entries"], chunk: int = CHUNK, row: int = ROW) -> Int[Array, " padded"]:
    """Indices of the chosen entries, in order, then indices past the end, up to a multiple of `chunk` (itself
    a multiple of 128). Counts by products with a triangular matrix are faster than `jnp.nonzero`. `row`:
    entries that are counted by one product."""
    padded = jnp.pad(chosen, (0, -chosen.size % chunk))
    last = padded.size
    # exact: numbers of entries are below 2²⁴
    rank = _sums_before(padded.astype(jnp.float32), row).astype(jnp.int32)
    return (
        jnp.full(last, chosen.size, jnp.int32)
        .at[jnp.where(padded, rank, last)]
        .set(jnp.arange(last, dtype=jnp.int32), mode="drop", unique_indices=True)
    )


def in_place(chosen: Bool[Array, " entries"]) -> Int[Array, " entries"]:
    """Index of each chosen entry at its own position; past the end for all others."""
    return jnp.where(chosen, jnp.arange(chosen.size, dtype=jnp.int32), chosen.size)


def _sums_before(counts: Float[Array, " entries"], row: int = ROW) -> Float[Array, " entries"]:
    """Exclusive prefix sums."""
    rows = jnp.pad(counts, (0, -counts.size % row)).reshape(-1, row)
    entry = jnp.arange(row)
    earlier = (entry[:, None] < entry[None]).astype(counts.dtype)
    before = jnp.matmul(rows, earlier, precision=jax.lax.Precision.HIGHEST)
    if rows.shape[0] > 1:
        before = before + _sums_before(jnp.sum(rows, axis=1), row)[:, None]
    return before.reshape(-1)[: counts.size]
