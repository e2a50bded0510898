"""How is something computed once, for all who use it? Behind a branch.

XLA computes what it fuses anew for each use, a fetch too; but the results of a branch lie in memory.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


def in_memory(live: Bool[Array, ""], f: Callable[..., Any], *arguments: Any) -> Any:
    """`f(*arguments)`, computed once and put in memory for all who use it; or anything where none is live."""

    def nothing(*arguments: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(f, *arguments))

    return jax.lax.cond(live, f, nothing, *arguments)
