"""Holds the arrays of many rays as the rows of a few, so that each is gathered and scattered at once.

XLA compiles a kernel for each array that is gathered: of a ray with twenty numbers, twenty.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .memory import gather
from .trees import PyTree


class Row(NamedTuple):
    """Where a leaf lies in a `Packed` tree: rows from `first` on of the array of `kind`.

    Attributes:
        dtype: of the leaf.
        shape: of the leaf, for each ray.
    """

    kind: str
    first: int
    dtype: Any
    shape: tuple[int, ...]

    @property
    def count(self) -> int:
        """Number of rows."""
        count = 1
        for size in self.shape:
            count *= size
        return count


class Layout(NamedTuple):
    """The places of a tree's leaves."""

    structure: Any
    rows: tuple[Row, ...]

    @classmethod
    def of(cls, tree: PyTree) -> "Layout":
        """That of a tree of arrays (groups, rays in a group, ...)."""
        leaves, structure = jax.tree.flatten(tree)
        rows, used = [], dict[str, int]()
        for leaf in leaves:
            kind = "int32" if leaf.dtype == bool else str(leaf.dtype)  # truth values are integers here
            row = Row(kind, used.get(kind, 0), leaf.dtype, leaf.shape[2:])
            rows.append(row)
            used[kind] = row.first + row.count
        return cls(structure, tuple(rows))

    def pack(self, tree: PyTree) -> dict[str, Array]:
        """By kind, an array (groups, rows, rays in a group)."""
        return self._joined(tree, lambda leaf, row: jnp.moveaxis(
            leaf.reshape(*leaf.shape[:2], row.count), 2, 1
        ), axis=1)

    def unpack(self, packed: dict[str, Array]) -> PyTree:
        """The inverse of `pack`."""
        leaves = []
        for row in self.rows:
            part = jax.lax.slice_in_dim(packed[row.kind], row.first, row.first + row.count, axis=1)
            groups, _, size = part.shape
            leaves.append(jnp.moveaxis(part, 1, 2).reshape(groups, size, *row.shape).astype(row.dtype))
        return jax.tree.unflatten(self.structure, leaves)

    def take(self, packed: dict[str, Array], groups: Int[Array, " batch"]) -> dict[str, Array]:
        """By kind, an array (rows, lanes) of the rays of these groups."""

        def taken(array: Array) -> Array:
            return jnp.moveaxis(gather(array, groups), 1, 0).reshape(array.shape[1], -1)

        return {kind: taken(array) for kind, array in packed.items()}

    def lanes(self, taken: dict[str, Array]) -> PyTree:
        """The tree of what was taken, of arrays (lanes, ...)."""
        leaves = []
        for row in self.rows:
            array = taken[row.kind]
            part = array[row.first] if not row.shape else jnp.moveaxis(
                array[row.first : row.first + row.count], 0, 1
            ).reshape(-1, *row.shape)
            leaves.append(part.astype(row.dtype))
        return jax.tree.unflatten(self.structure, leaves)

    def put(self, packed: dict[str, Array], groups: Int[Array, " batch"], tree: PyTree) -> dict[str, Array]:
        """The arrays with a tree of arrays (lanes, ...) in these groups; groups past the end are dropped."""
        lanes = self._joined(tree, lambda leaf, row: leaf.reshape(-1, row.count).T, axis=0)

        def replaced(array: Array, rows: Array) -> Array:
            count, size = array.shape[1:]
            part = jnp.moveaxis(rows.reshape(count, groups.size, size), 1, 0)
            return array.at[groups].set(part, mode="drop", unique_indices=True)

        return {kind: replaced(array, lanes[kind]) for kind, array in packed.items()}

    def _joined(self, tree: PyTree, shaped: Any, axis: int) -> dict[str, Array]:
        parts = dict[str, list[Array]]()
        for leaf, row in zip(jax.tree.leaves(tree), self.rows, strict=True):
            parts.setdefault(row.kind, []).append(shaped(leaf.astype(row.kind), row))
        return {kind: jnp.concatenate(arrays, axis=axis) for kind, arrays in parts.items()}
