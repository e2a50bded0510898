"""Differentiable leaves of trees, sums of trees, and copies of modules with other fields."""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp


PyTree: TypeAlias = Any
"""A tree of arrays. (Type checkers treat jaxtyping's `PyTree` as an unknown type.)"""


def is_none(leaf: object) -> bool:
    """Predicate for `is_leaf` that makes None a leaf."""
    return leaf is None


def unchecked(module: object, **changes: Any) -> Any:
    """Copy of a module with changed fields, also static ones, or a new instance of a class, without the
    constructor's checks."""
    new = isinstance(module, type)
    copy = object.__new__(module if new else type(module))
    for name, value in {**({} if new else vars(module)), **changes}.items():
        object.__setattr__(copy, name, value)
    return copy


def with_fields(tree: PyTree, **changes: Any) -> Any:
    """Copy of a module with changed fields, without the checks of shapes by `dataclasses.replace`."""
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
    """The tree without gradients. Other leaves than arrays stay: a field may hold functions."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def strong(tree: PyTree) -> PyTree:
    """The tree without weak types (of Python numbers), whose gradients `jax.custom_vjp` loses."""

    def plain(leaf: PyTree) -> PyTree:
        return jnp.asarray(leaf, leaf.dtype) if getattr(leaf, "weak_type", False) else leaf

    # rebuilding a tree would take a tenth of the time to start a program
    weak = any(getattr(leaf, "weak_type", False) for leaf in jax.tree.leaves(tree))
    return jax.tree.map(plain, tree) if weak else tree


def added(a: PyTree, b: PyTree) -> PyTree:
    """Sum of two trees, leaf by leaf; None if the first is None."""
    return None if a is None else jax.tree.map(jnp.add, a, b)
