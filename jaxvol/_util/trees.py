"""Differentiable leaves of trees, and sums of trees."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree


def floats(tree: PyTree) -> PyTree:
    """The leaves that can have a gradient; None in place of the others."""
    return eqx.filter(tree, eqx.is_inexact_array)


def added(a: PyTree, b: PyTree) -> PyTree:
    """Sum of two trees, leaf by leaf."""
    return jax.tree.map(jnp.add, a, b)
