"""Mesh axes over which an array varies inside `jax.shard_map`."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Int

from .trees import PyTree


def varies_over(leaf: object) -> frozenset[Any]:
    """Mesh axes over which an array varies inside `jax.shard_map`; none under `check_vma=False`."""
    if not isinstance(leaf, jax.core.Tracer):
        return frozenset()
    kind = jax.typeof(leaf)
    if hasattr(kind, "manual_axis_type"):
        return kind.manual_axis_type.varying
    return getattr(kind, "vma", frozenset())  # up to jax 0.9


def varying(tree: PyTree, *like: PyTree) -> PyTree:
    """The tree with arrays that vary over all mesh axes of `like` and itself. These axes are part of an
    array's type, which a loop must keep, and zeros vary over none. Identity outside of `jax.shard_map`."""
    axes = frozenset().union(*(varies_over(leaf) for leaf in jax.tree.leaves((tree, like))))
    if not axes:
        return tree

    def cast(leaf: PyTree) -> PyTree:
        missing = tuple(sorted(axes - varies_over(leaf))) if eqx.is_array(leaf) else ()
        if not missing:
            return leaf
        if hasattr(jax.lax, "pcast"):
            return jax.lax.pcast(leaf, missing, to="varying")
        return jax.lax.pvary(leaf, missing)  # pyright: ignore[reportAttributeAccessIssue]  (up to jax 0.8)

    return jax.tree.map(cast, tree)


def shard_number(*arrays: Any) -> Int[Array, ""]:
    """Index of this shard of arrays sharded along their first axis; 0 outside of `jax.shard_map`."""
    axes = frozenset().union(*map(varies_over, arrays))
    if not axes:
        return jnp.zeros((), jnp.int32)
    # JAX does not report the order of several mesh axes of an array
    names = tuple(name for name in jax.sharding.get_abstract_mesh().axis_names if name in axes)
    return jax.lax.axis_index(names).astype(jnp.int32)
