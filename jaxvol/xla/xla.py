"""What XLA must be told to compile fast programs, and rules for transformations of whole programs."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool

from .platform import is_traced, on_gpu
from .sharding import varying
from .trees import PyTree


OPTIONS = {
    # 16 lanes where the processor has them; XLA's default is 8
    "xla_cpu_prefer_vector_width": 512,
    # kernels one after the other, each on all threads, rather than several at once on one thread each
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""Compiler options: programs are 10 to 20 % faster on CPU. They mean nothing on other backends."""


def compiled(function: Callable[..., Any], *, has_jvp: bool = False) -> Callable[..., Any]:
    """The function under jit, compiled with `OPTIONS` where it is not part of a larger program.

    `jax.vmap` runs it for each element of the batch in turn, as a Python loop would, but in one program.
    Batching its operations instead would execute both sides of each branch, and run each loop until the last
    element is finished: 3 to 18 times slower.

    `has_jvp`: JAX itself is to differentiate the function. It cannot linearize a function with a batching
    rule, so the rule is used only where `jax.vmap` is the innermost transformation of the arguments. Where
    they are also differentiated, or a `jax.jit` lies between, operations are batched.
    """
    options: Any = {"compiler_options": OPTIONS}
    inner, alone = eqx.filter_jit(function), eqx.filter_jit(function, **options)
    in_turn = _in_turn(function, inner)

    def run(*args: Any) -> Any:
        # inside a larger program or a transformation, compiler options are not allowed
        if not is_traced(args, _probe()):
            return alone(*args)
        return inner(*args) if has_jvp and not _only_vmapped(args) else in_turn(*args)

    return run


@jax.jit
def _probe() -> Array:
    """A tracer wherever a program is being traced; compiled, since this is asked for each image."""
    return jnp.zeros(())


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


def transformations(leaf: Any) -> list[str]:
    """Names of JAX's tracers around an array, the innermost first. Names, since JAX does not export their
    classes. Transformations outside of a `jax.jit` cannot be seen."""
    names = []
    while is_traced(leaf):
        names.append(type(leaf).__name__)
        leaf = getattr(leaf, "primal", getattr(leaf, "val", None))
    return names


def forward_mode(kinds: list[list[str]]) -> bool:
    """Whether `transformations` of the leaves of a tree are forward mode (`jax.jvp`, `jax.jacfwd`), or of
    second order. A `custom_vjp` has no rule for these: JAX's own error names neither argument nor remedy."""
    return any("JVPTracer" in kind or kind.count("LinearizeTracer") > 1 for kind in kinds)


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)


def _in_turn(function: Callable[..., Any], inner: Callable[..., Any]) -> Callable[..., Any]:
    """`inner`, which is `function` under jit, with a batching rule: a loop over the batch."""

    def run(*args: Any) -> Any:
        arrays, rest = eqx.partition(args, _is_array)
        leaves, tree = jax.tree.flatten(arrays)

        @jax.custom_batching.custom_vmap
        def one(*leaves: Array) -> Any:
            return inner(*eqx.combine(jax.tree.unflatten(tree, leaves), rest))

        @one.def_vmap
        def _(size: int, batched: Any, *leaves: Array) -> Any:
            args = eqx.combine(jax.tree.unflatten(tree, leaves), rest)
            found = _batch(function, tuple(batched), args)
            return found, jax.tree.map(lambda _: True, found)

        return one(*leaves)

    return run


def _each(function: Callable[..., Any], batched: tuple[bool, ...], args: tuple[Any, ...]) -> Any:
    """`function` of each element of the batch. `batched`: which arrays among the arguments have a batch
    axis."""
    arrays, rest = eqx.partition(args, _is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def one(moving: list[Array]) -> Any:
        remaining = iter(moving)
        own = [next(remaining) if moves else leaf for leaf, moves in zip(leaves, batched, strict=True)]
        return function(*eqx.combine(jax.tree.unflatten(tree, own), rest))

    return jax.lax.map(one, [leaf for leaf, moves in zip(leaves, batched, strict=True) if moves])


_batch = compiled(_each)


def recomputed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as one program, and its reverse-mode derivative as another, which recomputes the function
    instead of keeping residuals. Both are `compiled`. For functions from trees to one array."""
    forward, backward = compiled(function), compiled(_vjp_of)

    @eqx.filter_custom_vjp
    def run(args: tuple[Any, ...]) -> Any:
        return forward(*args)

    @run.def_fwd
    def _(perturbed: Any, args: tuple[Any, ...]) -> tuple[Any, None]:
        return forward(*args), None

    @run.def_bwd
    def _(left: None, cotangent: Any, perturbed: Any, args: tuple[Any, ...]) -> Any:
        return backward(function, perturbed, args, cotangent)

    return lambda *args: run(args)


def _vjp_of(function: Callable[..., Any], perturbed: PyTree, args: tuple[Any, ...], cotangent: Any) -> Any:
    moving, fixed = eqx.partition(args, perturbed)
    _, pull = jax.vjp(lambda moving: function(*eqx.combine(moving, fixed)), moving)
    return pull(cotangent)[0]


def forward_only(tree: PyTree, message: str) -> PyTree:
    """The tree, unchanged. Under reverse mode it raises `ValueError` with this message."""

    @jax.custom_jvp
    def same(leaf: Array) -> Array:
        return leaf

    @same.defjvp
    def _(primal: tuple[Array], tangent: tuple[Array]) -> tuple[Array, Array]:
        return primal[0], _TANGENT.bind(*tangent, message=message)

    return jax.tree.map(lambda leaf: same(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


def _refuse(cotangent: Any, tangent: Any, *, message: str) -> Any:
    raise ValueError(message)


# The identity, whose transpose is an error. (`jax.custom_derivatives.linear_call` cannot be batched.)
_TANGENT = Primitive("forward_only")
_TANGENT.def_impl(lambda tangent, *, message: tangent)
_TANGENT.def_abstract_eval(lambda tangent, *, message: tangent)
mlir.register_lowering(_TANGENT, lambda context, tangent, *, message: [tangent])
batching.defvectorized(_TANGENT)
ad.deflinear2(_TANGENT, _refuse)


def gather(array: Array, index: Array) -> Array:
    """`array[index]` along the first axis, for indices known to be in range: no check is compiled."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def packed_pair(a: Array, b: Array, factor: Array) -> Array:
    """The pair (a · factor, b · factor) in one array, so that one kernel computes both: of two arrays, XLA
    would compute all that they share twice."""
    return jax.lax.complex(a, b) * jax.lax.complex(factor, jnp.zeros_like(factor))


def unpacked_pair(pair: Array) -> tuple[Array, Array]:
    """The two arrays of a `packed_pair`."""
    return jnp.real(pair), jnp.imag(pair)


def in_memory(live: Bool[Array, ""], f: Callable[..., Any], *arguments: Any) -> Any:
    """`f(*arguments)`, computed once and stored in memory.

    XLA recomputes what it fuses for each use, fetches too, but the results of a branch lie in memory. `live`
    must always be true, in a way that XLA cannot see. If it is not, floats come out as NaN.

    On a GPU, a branch would wait for the host; but there XLA fuses nothing across an `optimization_barrier`,
    which on CPU it removes before it fuses."""
    if on_gpu():
        return jax.lax.optimization_barrier(f(*arguments))
    f = jax.jit(f, inline=True)  # traced once, for its shapes and as a branch

    def never(*arguments: Any) -> Any:
        def filled(leaf: Any) -> Array:
            fill = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.inexact) else 0
            return jnp.full(leaf.shape, fill, leaf.dtype)

        return varying(jax.tree.map(filled, jax.eval_shape(f, *arguments)), live, arguments)

    return jax.lax.cond(live, f, never, *arguments)
