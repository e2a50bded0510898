"""Compilation of functions to programs, with rules by which JAX batches and differentiates them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .differentiation import transformations
from .kept_programs import kept
from .platform import is_traced


OPTIONS = {
    # 16 lanes on processors that have them; XLA's default is 8
    "xla_cpu_prefer_vector_width": 512,
    # one kernel at a time on all threads, instead of several on one thread each
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""Compiler options: programs are 10 to 20 % faster on CPU. Other backends ignore them."""


def compiled(
    function: Callable[..., Any], *, has_jvp: bool = False, by_jvp: bool = False, in_turn: bool = True
) -> Callable[..., Any]:
    """The function under jit, compiled with `OPTIONS` unless it is part of a larger program. `jax.vmap` loops
    over the elements in one program: batching would run both sides of branches, and loops until the last
    element is finished, 3 to 18 times slower.

    Args:
        function: the function.
        has_jvp: JAX differentiates the function. It cannot linearize a batching rule, so `jax.vmap` loops
            only if it is the innermost transformation; otherwise operations are batched.
        by_jvp: JAX differentiates the function in forward mode only, through the rule, also under another
            `jax.jit`.
        in_turn: False to batch always, as for tangents, on which no branch and no loop depends.
    """
    nested, outermost = eqx.filter_jit(function), kept(function, compiler_options=OPTIONS)
    looped = _with_loop_rule(function, nested)

    def run(*args: Any) -> Any:
        if not in_program(*args):  # JAX allows compiler options only for an outermost program
            return outermost(*args)
        kinds = {kind for leaf in jax.tree.leaves(args) for kind in transformations(leaf)[:1]}
        pushed = by_jvp and not kinds.isdisjoint({"JVPTracer", "LinearizeTracer"})
        batched = not in_turn or pushed or (has_jvp and kinds != {"BatchTracer"})
        return nested(*args) if batched else looped(*args)

    return run


@jax.jit
def _probe() -> Array:
    """A tracer while a program is traced. Compiled, since each image calls it."""
    return jnp.zeros(())


def in_program(*args: Any) -> bool:
    """Tests whether arguments are traced, or a program is traced around this call."""
    return is_traced(args, _probe())


def computed_now(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)` of concrete arrays, computed immediately even while a larger program is traced."""
    if not is_traced(_probe()):
        return function(*args)
    # not by `jax.ensure_compile_time_eval`, inside which each operation is a program of its own
    jitted: Any = eqx.filter_jit(function)
    return jitted.lower(*args).compile()(*args)


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)


def _with_loop_rule(function: Callable[..., Any], nested: Callable[..., Any]) -> Callable[..., Any]:
    """`nested`, which is `function` under jit, with a batching rule: a loop over the batch."""

    def run(*args: Any) -> Any:
        arrays, static = eqx.partition(args, _is_array)
        leaves, tree = jax.tree.flatten(arrays)

        @jax.custom_batching.custom_vmap
        def element(*leaves: Array) -> Any:
            return nested(*eqx.combine(jax.tree.unflatten(tree, leaves), static))

        @element.def_vmap
        def _(size: int, batched: Any, *leaves: Array) -> Any:
            args = eqx.combine(jax.tree.unflatten(tree, leaves), static)
            results = _batch(function, tuple(batched), args)
            return results, jax.tree.map(lambda _: True, results)

        return element(*leaves)

    return run


def _loop(function: Callable[..., Any], batched: tuple[bool, ...], args: tuple[Any, ...]) -> Any:
    """Loop of `function` over a batch. `batched`: mask of the arrays with a batch axis."""
    arrays, static = eqx.partition(args, _is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def element(parts: list[Array]) -> Any:
        part = iter(parts)
        leaves_ = [next(part) if moves else leaf for leaf, moves in zip(leaves, batched, strict=True)]
        return function(*eqx.combine(jax.tree.unflatten(tree, leaves_), static))

    return jax.lax.map(element, [leaf for leaf, moves in zip(leaves, batched, strict=True) if moves])


_batch = compiled(_loop)
