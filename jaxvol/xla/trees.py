"""Differentiable leaves of trees, and sums of trees."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp


PyTree: TypeAlias = Any
"""A tree of arrays. The type of this name in jaxtyping is one that type checkers cannot know, on purpose."""


def is_none(leaf: Any) -> bool:
    """For `is_leaf`, where None is to be replaced or kept."""
    return leaf is None


def unchecked(module: Any, **changes: Any) -> Any:
    """A module (or a class's) with these fields, also static ones, without its constructor's checks."""
    new = isinstance(module, type)
    copy = object.__new__(module if new else type(module))
    for name, value in {**({} if new else vars(module)), **changes}.items():
        object.__setattr__(copy, name, value)
    return copy


def with_fields(tree: Any, **changes: Any) -> Any:
    """A module with other fields, of many rays, whose shapes `dataclasses.replace` would check."""
    names = list(changes)
    parts = [changes[name] for name in names]
    return eqx.tree_at(lambda tree: [getattr(tree, name) for name in names], tree, parts, is_leaf=is_none)


def floats(tree: PyTree) -> PyTree:
    """The leaves that can have a gradient; None in place of the others."""
    return eqx.filter(tree, eqx.is_inexact_array)


def zeros_of(tree: PyTree) -> PyTree:
    """Zeros for the leaves that can have a gradient."""
    return jax.tree.map(jnp.zeros_like, floats(tree))


def constant(tree: PyTree) -> PyTree:
    """The tree, without gradient. Leaves that are no arrays stay: a field may hold functions."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def strong(tree: PyTree) -> PyTree:
    """The tree without weak types (of Python numbers), whose gradients `jax.custom_vjp` loses."""

    def plain(leaf: Any) -> Any:
        return jnp.asarray(leaf, leaf.dtype) if getattr(leaf, "weak_type", False) else leaf

    # rebuilding a tree takes a tenth of the time until a program begins
    weak = any(getattr(leaf, "weak_type", False) for leaf in jax.tree.leaves(tree))
    return jax.tree.map(plain, tree) if weak else tree


def added(a: PyTree, b: PyTree) -> PyTree:
    """Sum of two trees, leaf by leaf. None if the first is None, whose sum is not asked for."""
    return None if a is None else jax.tree.map(jnp.add, a, b)
