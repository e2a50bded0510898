"""What has a gradient in a tree, and how are gradients of trees added up?"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree


def floats(tree: PyTree) -> PyTree:
    """What of it can have a gradient."""
    return eqx.filter(tree, eqx.is_inexact_array)


def added(a: PyTree, b: PyTree) -> PyTree:
    """Leaf by leaf."""
    return jax.tree.map(jnp.add, a, b)
