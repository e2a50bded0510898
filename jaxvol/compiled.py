"""How does XLA make a fast program? What it needs to be told, since it does not find out by itself."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .checks import is_traced


OPTIONS = {
    # 16 lanes at once where the processor has them: XLA prefers 8
    "xla_cpu_prefer_vector_width": 512,
    # kernels one after the other, each on all threads, rather than several on one thread each
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""How XLA compiles: 10 to 20 % faster on CPU, and of no meaning elsewhere."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function under jit, compiled with `OPTIONS` where it is a program of its own."""
    options: Any = {"compiler_options": OPTIONS}
    inner, alone = eqx.filter_jit(function), eqx.filter_jit(function, **options)
    # a program within another one, or within a transformation, cannot have options of its own
    return lambda *args: (inner if is_traced(args, jnp.zeros(())) else alone)(*args)


def in_memory(live: Bool[Array, ""], f: Callable[..., Any], *arguments: Any) -> Any:
    """`f(*arguments)`, computed once and put in memory for all who use it; or anything where none is live.

    What XLA fuses it computes anew for each use, a fetch too; but the results of a branch lie in memory."""

    def nothing(*arguments: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(f, *arguments))

    return jax.lax.cond(live, f, nothing, *arguments)
