"""How does XLA make a fast program? What it needs to be told, since it does not find out by itself."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, PyTree

from .checks import is_traced
from .sharding import varying


OPTIONS = {
    # 16 lanes at once where the processor has them: XLA prefers 8
    "xla_cpu_prefer_vector_width": 512,
    # kernels one after the other, each on all threads, rather than several on one thread each
    "xla_cpu_enable_concurrency_optimized_scheduler": False,
}
"""How XLA compiles: 10 to 20 % faster on CPU, and of no meaning elsewhere."""


def compiled(function: Callable[..., Any], *, has_jvp: bool = False) -> Callable[..., Any]:
    """The function under jit, compiled with `OPTIONS` where it is a program of its own.

    `jax.vmap` runs it for each element of the batch in turn, as a Python loop would, but in one program.
    Batching its operations instead would turn every branch into both of its sides, and keep each loop going
    until the last element is finished: 3 to 18 times slower.

    `has_jvp`: the function is to be differentiated by JAX itself. JAX cannot linearize what has a rule for
    batching, so the rule is then used only where `jax.vmap` is all that is seen to be done to the arguments.
    Where they are also differentiated, or a `jax.jit` stands between, operations are batched.
    """
    options: Any = {"compiler_options": OPTIONS}
    inner, alone = eqx.filter_jit(function), eqx.filter_jit(function, **options)
    in_turn = _in_turn(function, inner)

    def run(*args: Any) -> Any:
        # a program within another one, or within a transformation, cannot have options of its own
        if not is_traced(args, jnp.zeros(())):
            return alone(*args)
        return inner(*args) if has_jvp and not _only_vmapped(args) else in_turn(*args)

    return run


def _only_vmapped(args: PyTree) -> bool:
    """Whether `jax.vmap` is the innermost transformation of every traced argument."""
    kinds = {transformations(leaf)[0] for leaf in jax.tree.leaves(args) if is_traced(leaf)}
    return kinds == {"BatchTracer"}


def transformations(leaf: Any) -> list[str]:
    """By which of JAX's tracers an array is traced, the innermost first. By name, since JAX does not export
    their classes; what is outside of a `jax.jit` is not seen."""
    names = []
    while is_traced(leaf):
        names.append(type(leaf).__name__)
        leaf = getattr(leaf, "primal", getattr(leaf, "val", None))
    return names


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)


def _in_turn(function: Callable[..., Any], inner: Callable[..., Any]) -> Callable[..., Any]:
    """`inner`, which is `function` under jit, with a rule for `jax.vmap`: a loop over the batch."""

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
    """`function` of each element of the batch; `batched` tells which arrays among the arguments have one."""
    arrays, rest = eqx.partition(args, _is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def one(moving: list[Array]) -> Any:
        remaining = iter(moving)
        own = [next(remaining) if moves else leaf for leaf, moves in zip(leaves, batched, strict=True)]
        return function(*eqx.combine(jax.tree.unflatten(tree, own), rest))

    return jax.lax.map(one, [leaf for leaf, moves in zip(leaves, batched, strict=True) if moves])


_batch = compiled(_each)


def recomputed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as a program, and its derivative by reverse mode as another one, which computes the
    function again rather than keeping anything for it. Under `jax.vmap` both run in turn, as `compiled` has
    it. For functions from trees to one array."""
    forward, backward = compiled(function), compiled(_pulled)

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


def _pulled(function: Callable[..., Any], perturbed: PyTree, args: tuple[Any, ...], cotangent: Any) -> Any:
    moving, fixed = eqx.partition(args, perturbed)
    _, pull = jax.vjp(lambda moving: function(*eqx.combine(moving, fixed)), moving)
    return pull(cotangent)[0]


def forward_only(tree: PyTree, message: str) -> PyTree:
    """The tree as it is; under reverse mode, `ValueError` with this message."""

    @jax.custom_jvp
    def same(leaf: Array) -> Array:
        return leaf

    @same.defjvp
    def _(primal: tuple, tangent: tuple) -> tuple[Array, Array]:
        return primal[0], _TANGENT.bind(*tangent, message=message)

    return jax.tree.map(lambda leaf: same(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


def _refuse(cotangent: Any, tangent: Any, *, message: str) -> Any:
    raise ValueError(message)


# The identity, with an error for a transpose. (`jax.custom_derivatives.linear_call` cannot be batched.)
_TANGENT = Primitive("forward_only")
_TANGENT.def_impl(lambda tangent, *, message: tangent)
_TANGENT.def_abstract_eval(lambda tangent, *, message: tangent)
mlir.register_lowering(_TANGENT, lambda context, tangent, *, message: [tangent])
batching.defvectorized(_TANGENT)
ad.deflinear2(_TANGENT, _refuse)


def in_memory(live: Bool[Array, ""], f: Callable[..., Any], *arguments: Any) -> Any:
    """`f(*arguments)`, computed once and put in memory for all who use it.

    What XLA fuses it computes anew for each use, a fetch too; but the results of a branch lie in memory. So
    `live` must always be true, in a way that XLA cannot see. That is asserted: where it is not, floats come
    out as NaN."""

    def never(*arguments: Any) -> Any:
        def filled(leaf: Any) -> Array:
            fill = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.inexact) else 0
            return jnp.full(leaf.shape, fill, leaf.dtype)

        return varying(jax.tree.map(filled, jax.eval_shape(f, *arguments)), arguments)

    return jax.lax.cond(live, f, never, *arguments)
