"""Compiles functions to programs, with rules by which JAX batches and differentiates these as a whole."""

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
from .trees import PyTree


OPTIONS = {
    # 16 lanes where the processor has them; XLA's default is 8
    "xla_cpu_prefer_vector_width": 512,
    # kernels one after the other, each on all threads, rather than several at once on one thread each
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""Compiler options: programs are 10 to 20 % faster on CPU. They mean nothing on other backends."""


def compiled(
    function: Callable[..., Any], *, has_jvp: bool = False, by_jvp: bool = False, in_turn: bool = True
) -> Callable[..., Any]:
    """The function under jit, compiled with `OPTIONS` where it is not part of a larger program. `jax.vmap`
    runs it for one element after the other, in one program: batched, both sides of branches would run, and
    loops until the last element is finished, 3 to 18 times slower.

    `has_jvp`: JAX differentiates it, and cannot linearize a batching rule: operations are batched unless
    `jax.vmap` is the innermost transformation. `by_jvp`: JAX differentiates it in forward mode alone, through
    the rule, also under another `jax.jit`. `in_turn`: False to batch always, as for tangents, on which no
    branch and no loop depends.
    """
    nested, outermost = eqx.filter_jit(function), kept(function, compiler_options=OPTIONS)
    looped = _in_turn(function, nested)

    def run(*args: Any) -> Any:
        # inside a larger program or a transformation, compiler options are not allowed
        if not is_traced(args, _probe()):
            return outermost(*args)
        batched = not in_turn or (has_jvp and not _only_vmapped(args)) or (by_jvp and _is_pushed(args))
        return nested(*args) if batched else looped(*args)

    return run


@jax.jit
def _probe() -> Array:
    """A tracer wherever a program is being traced; compiled, since this is asked for each image."""
    return jnp.zeros(())


def in_program(*args: Any) -> bool:
    """Whether arguments are traced, or a program is being traced around this call."""
    return is_traced(args, _probe())


def computed_now(function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)` of concrete arrays, computed at once also where a larger program is being traced."""
    if not is_traced(_probe()):
        return function(*args)
    # not by `jax.ensure_compile_time_eval`, inside which jax 0.7 cannot compile a loop
    jitted: Any = eqx.filter_jit(function)
    return jitted.lower(*args).compile()(*args)


def _only_vmapped(args: PyTree) -> bool:
    """Whether `jax.vmap` is the innermost transformation of every traced argument."""
    kinds = {transformations(leaf)[0] for leaf in jax.tree.leaves(args) if is_traced(leaf)}
    return kinds == {"BatchTracer"}


def _is_pushed(args: PyTree) -> bool:
    """Whether a tangent is pushed through the arguments."""
    kinds = [kind for leaf in jax.tree.leaves(args) for kind in transformations(leaf)[:1]]
    return any(kind in ("JVPTracer", "LinearizeTracer") for kind in kinds)


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)


def _in_turn(function: Callable[..., Any], nested: Callable[..., Any]) -> Callable[..., Any]:
    """`nested`, which is `function` under jit, with a batching rule: a loop over the batch."""

    def run(*args: Any) -> Any:
        arrays, rest = eqx.partition(args, _is_array)
        leaves, tree = jax.tree.flatten(arrays)

        @jax.custom_batching.custom_vmap
        def one(*leaves: Array) -> Any:
            return nested(*eqx.combine(jax.tree.unflatten(tree, leaves), rest))

        @one.def_vmap
        def _(size: int, batched: Any, *leaves: Array) -> Any:
            args = eqx.combine(jax.tree.unflatten(tree, leaves), rest)
            found = _batch(function, tuple(batched), args)
            return found, jax.tree.map(lambda _: True, found)

        return one(*leaves)

    return run


def _each(function: Callable[..., Any], batched: tuple[bool, ...], args: tuple[Any, ...]) -> Any:
    """`function` of each element of the batch. `batched`: which arrays have a batch axis."""
    arrays, rest = eqx.partition(args, _is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def one(moving: list[Array]) -> Any:
        remaining = iter(moving)
        own = [next(remaining) if moves else leaf for leaf, moves in zip(leaves, batched, strict=True)]
        return function(*eqx.combine(jax.tree.unflatten(tree, own), rest))

    return jax.lax.map(one, [leaf for leaf, moves in zip(leaves, batched, strict=True) if moves])


_batch = compiled(_each)
