"""Packs arrays of rays to rows of a few arrays, since XLA compiles a kernel for each gathered array."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .trees import PyTree


class Row(NamedTuple):
    """Place of a leaf, with its dtype and shape per ray, in a packed tree: the rows from `first` on of the
    array of `kind`. 32-bit integers and booleans are stored bitwise in float32."""

    kind: str
    first: int
    dtype: Any
    shape: tuple[int, ...]

    @property
    def number(self) -> int:
        """Number of rows."""
        return math.prod(self.shape)


class Layout(NamedTuple):
    """The places of a tree's leaves."""

    structure: Any
    rows: tuple[Row, ...]

    @classmethod
    def of(cls, tree: PyTree) -> "Layout":
        """Layout of a tree of arrays (groups, rays in a group, ...)."""
        leaves, structure = jax.tree.flatten(tree)
        rows, used = [], dict[str, int]()
        for leaf in leaves:
            kind = "float32" if leaf.dtype in (bool, jnp.int32) else str(leaf.dtype)
            row = Row(kind, used.get(kind, 0), leaf.dtype, leaf.shape[2:])
            rows.append(row)
            used[kind] = row.first + row.number
        return cls(structure, tuple(rows))

    def pack(self, tree: PyTree) -> "Packed":
        """Packs a tree to rows (rows, groups, rays in a group)."""
        rows = self._joined(tree, lambda leaf: leaf.reshape(*leaf.shape[:2], -1).transpose(2, 0, 1))
        return Packed(rows, self)

    def _joined(self, tree: PyTree, rows_of: Callable[[Array], Array]) -> dict[str, Array]:
        parts = dict[str, list[Array]]()
        for leaf, row in zip(jax.tree.leaves(tree), self.rows, strict=True):
            leaf = leaf.astype(jnp.int32) if leaf.dtype == bool else leaf
            leaf = jax.lax.bitcast_convert_type(leaf, row.kind) if leaf.dtype == jnp.int32 else leaf
            parts.setdefault(row.kind, []).append(rows_of(leaf))
        return {kind: jnp.concatenate(arrays) for kind, arrays in parts.items()}


class Packed(eqx.Module):
    """A tree of arrays as rows of one array per kind, so that a branch need not store each leaf."""

    rows: dict[str, Array]
    layout: Layout = eqx.field(static=True)

    @property
    def tree(self) -> PyTree:
        """The unpacked tree, of arrays (groups, rays in a group, ...), or (lanes, ...) after `take`."""
        leaves = []
        for row in self.layout.rows:
            array = self.rows[row.kind]
            if row.shape:
                part = jax.lax.slice_in_dim(array, row.first, row.first + row.number)
                part = jnp.moveaxis(part, 0, -1)
                part = part.reshape(*part.shape[:-1], *row.shape)
            else:
                part = array[row.first]
            if row.kind != str(row.dtype):
                part = jax.lax.bitcast_convert_type(part, jnp.int32).astype(row.dtype)
            leaves.append(part)
        return jax.tree.unflatten(self.layout.structure, leaves)

    def take(self, groups: Int[Array, " batch"]) -> "Packed":
        """Gathers the rays of groups, flattened to lanes."""

        def gathered(array: Array) -> Array:
            part = array.at[:, groups].get(mode="promise_in_bounds", wrap_negative_indices=False)
            return part.reshape(array.shape[0], -1)

        return Packed({kind: gathered(array) for kind, array in self.rows.items()}, self.layout)

    def put(self, groups: Int[Array, " batch"], tree: PyTree) -> "Packed":
        """Replaces groups by a tree of lanes; groups past the end are dropped."""
        lanes = self.layout._joined(tree, lambda leaf: leaf.reshape(leaf.shape[0], -1).T)

        def replaced(array: Array, rows: Array) -> Array:
            part = rows.reshape(array.shape[0], groups.size, array.shape[2])
            return array.at[:, groups].set(part, mode="drop", unique_indices=True)

        return Packed({kind: replaced(array, lanes[kind]) for kind, array in self.rows.items()}, self.layout)
