"""Over which devices does an array vary? What `jax.shard_map` asks of the arrays inside it."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree


def varies_over(leaf: Any) -> frozenset:
    """The mesh axes over which an array varies inside `jax.shard_map`; none under `check_vma=False`, where
    JAX does not tell."""
    if not isinstance(leaf, jax.core.Tracer):
        return frozenset()
    kind = jax.typeof(leaf)
    if hasattr(kind, "manual_axis_type"):
        return kind.manual_axis_type.varying
    return getattr(kind, "vma", frozenset())  # up to jax 0.9


def varying(tree: PyTree, *like: PyTree) -> PyTree:
    """A tree whose arrays vary over all the devices over which any array of `like`, or of itself, varies.

    JAX types arrays by the mesh axes over which they vary, and a loop must begin with arrays of the types
    that it ends with, where zeros do not vary. Outside of `jax.shard_map` this changes nothing."""
    axes = frozenset().union(*(varies_over(leaf) for leaf in jax.tree.leaves((tree, like))))

    def one(leaf: Any) -> Any:
        missing = tuple(sorted(axes - varies_over(leaf))) if eqx.is_array(leaf) else ()
        if not missing:
            return leaf
        if hasattr(jax.lax, "pcast"):
            return jax.lax.pcast(leaf, missing, to="varying")
        return jax.lax.pvary(leaf, missing)  # pyright: ignore  (up to jax 0.8)

    return jax.tree.map(one, tree)


def shard_number(*arrays: Any) -> Int[Array, ""]:
    """Which shard this is of arrays that are sharded along their first axis; 0 outside of `jax.shard_map`."""
    axes = frozenset().union(*map(varies_over, arrays))
    if not axes:
        return jnp.zeros((), jnp.int32)
    # JAX does not tell in which order the axes follow each other where an array has several
    names = tuple(name for name in jax.sharding.get_abstract_mesh().axis_names if name in axes)
    return jax.lax.axis_index(names).astype(jnp.int32)
