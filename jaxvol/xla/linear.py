"""Custom derivatives in both modes: a push-forward of tangents, and its transpose, a pull-back. JAX
transposes single operations of a `custom_jvp`, which fails for a loop of unknown length, and a `custom_vjp`
has no forward mode. Here, it transposes one primitive, also under forward mode."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from .compiling import compiled
from .differentiation import forward_only, not_transposed
from .platform import is_traced
from .trees import PyTree, floats, is_none


AnyArray: TypeAlias = Array | np.ndarray  # JAX keeps some constants in NumPy


def differentiable(
    plain: Callable[..., PyTree],
    recorded: Callable[..., tuple[PyTree, PyTree]],
    push: Callable[..., PyTree],
    pull: Callable[..., PyTree],
    message: str,
) -> Callable[..., PyTree]:
    """The function `plain(tree, *fixed)`, whose results are arrays, with derivatives by the floats of `tree`.

    Args:
        plain: the function.
        recorded: the function under differentiation, which also returns the residuals of its pull-back.
        push: `push(tangents, tree, *fixed)`: tangents of the results' floats. Leaves without a tangent are
            None in `tangents`.
        pull: `pull(cotangents, perturbed, residuals, tree, *fixed)`: cotangents of the leaves of `tree` that
            are `perturbed`, from those of the results' floats.
        message: error text for the transpose of a push or a pull: second derivatives with reverse mode
            outside.
    """

    def run(tree: PyTree, *fixed: Any) -> PyTree:
        arrays, static = eqx.partition((tree, fixed), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        tree_size = len(jax.tree.leaves(arrays[0]))

        def arguments(leaves: Sequence[Any]) -> tuple[Any, ...]:
            tree, fixed = eqx.combine(jax.tree.unflatten(structure, leaves), static)
            return tree, *fixed

        def like_tree(leaves: Sequence[Any], fill: object) -> PyTree:
            """A copy of `tree` with `leaves` in place of its arrays, and `fill` of its other leaves."""
            dynamic = jax.tree.unflatten(jax.tree.structure(arrays[0]), leaves)
            return eqx.combine(dynamic, jax.tree.map(lambda _: fill, static[0]))

        @jax.custom_jvp
        def function(*leaves: Array) -> PyTree:
            return plain(*arguments(leaves))

        def rule(primals: Sequence[Array], tangents: Sequence[Any]) -> tuple[PyTree, PyTree]:
            results, residuals = recorded(*arguments(primals))
            if is_traced(primals):
                results, residuals = forward_only((results, residuals), message)
            outputs, out = jax.tree.flatten(results)
            is_float = [eqx.is_inexact_array(leaf) for leaf in outputs]
            kept, kept_structure = jax.tree.flatten(residuals)
            moves = [not isinstance(tangent, SymbolicZero) for tangent in tangents[:tree_size]]
            known = len(primals)

            def pushed(constants: Sequence[AnyArray], moving: Sequence[Array]) -> list[Array]:
                tangent = iter(moving)
                tree_dot = like_tree([next(tangent) if moves_ else None for moves_ in moves], None)
                return jax.tree.leaves(push(tree_dot, *arguments(constants[:known])))

            def pulled(constants: Sequence[AnyArray], cotangents: Sequence[Array]) -> list[Array]:
                cotangent = iter(cotangents)
                results_bar = [next(cotangent) if float_ else None for float_ in is_float]
                residuals = jax.tree.unflatten(kept_structure, constants[known:])
                parts = jax.tree.unflatten(out, results_bar), like_tree(moves, False), residuals
                tree_bar = jax.tree.leaves(pull(*parts, *arguments(constants[:known])))
                assert len(tree_bar) == sum(moves)
                return forward_only(tree_bar, message) if is_traced(constants, cotangents) else tree_bar

            operands = *primals, *kept, *(t for t, moves_ in zip(tangents, moves, strict=False) if moves_)
            avals = tuple(map(jax.typeof, filter(eqx.is_inexact_array, outputs)))
            params = {"push": pushed, "pull": pulled, "avals": avals, "message": message}
            tangent = iter(_PUSH.bind(*operands, count=known + len(kept), **params))
            outputs_dot = [
                next(tangent) if float_ else SymbolicZero(jax.typeof(leaf).to_tangent_aval())
                for leaf, float_ in zip(outputs, is_float, strict=True)
            ]
            return results, jax.tree.unflatten(out, outputs_dot)

        function.defjvp(rule, symbolic_zeros=True)
        return function(*leaves)

    return run


def recomputed(function: Callable[..., PyTree], message: str) -> Callable[..., PyTree]:
    """The function with derivatives in both modes, as programs; the one of reverse mode recomputes the
    function. `message`: as for `differentiable`."""

    def floats_of(args: tuple[Any, ...], moving: PyTree) -> PyTree:
        return floats(function(*eqx.combine(moving, args)))

    def push(tangents: PyTree, args: tuple[Any, ...]) -> PyTree:
        return jax.jvp(partial(floats_of, args), (moving_leaves(args, tangents),), (tangents,))[1]

    def pull(cotangents: PyTree, perturbed: PyTree, args: tuple[Any, ...]) -> PyTree:
        _, back = jax.vjp(partial(floats_of, args), eqx.filter(args, perturbed))
        return back(cotangents)[0]

    forward, pulled = compiled(function, by_jvp=True), compiled(pull, by_jvp=True)
    run = differentiable(
        lambda args: forward(*args),
        lambda args: (forward(*args), ()),
        compiled(push, has_jvp=True),
        lambda cotangents, perturbed, _, args: pulled(cotangents, perturbed, args),
        message,
    )
    return lambda *args: run(args)


def moving_leaves(tree: PyTree, tangents: PyTree) -> PyTree:
    """The leaves of a tree that have a tangent; None in place of the others."""
    return jax.tree.map(lambda leaf, dot: None if dot is None else leaf, tree, tangents, is_leaf=is_none)


# Primitive: (constants, tangents) → tangents, linear in the tangents. `count` operands are constants.
_PUSH = Primitive("push_forward")
_PUSH.multiple_results = True


def _pushed(*operands: Array, count: int, push: Any, **_: Any) -> list[Array]:
    return push(operands[:count], operands[count:])


def _jvp(
    primals: Sequence[AnyArray], tangents: Sequence[Any], *, count: int, **params: Any
) -> tuple[Any, Any]:
    constants, moving = primals[:count], primals[count:]
    results = _PUSH.bind(*primals, count=count, **params)
    change: list[Any] = [jnp.zeros_like(leaf) for leaf in results]
    if any(not isinstance(tangent, ad.Zero) for tangent in tangents[count:]):
        moving_dot = map(ad.instantiate_zeros, tangents[count:])
        change = _PUSH.bind(*constants, *moving_dot, count=count, **params)
    if any(not isinstance(tangent, ad.Zero) for tangent in tangents[:count]):
        floats = [i for i, leaf in enumerate(constants) if eqx.is_inexact_array(leaf)]

        def by_constants(*leaves: Array) -> list[Array]:
            all_ = list(constants)
            for i, leaf in zip(floats, leaves, strict=True):
                all_[i] = leaf
            return params["push"](all_, moving)

        constants_dot = [ad.instantiate_zeros(tangents[i]) for i in floats]
        _, more = jax.jvp(by_constants, [constants[i] for i in floats], constants_dot)
        change = [a + b for a, b in zip(change, not_transposed(more, params["message"]), strict=True)]
    return results, change


def _transpose(cotangents: Sequence[Any], *operands: Any, count: int, pull: Any, **_: Any) -> list[Any]:
    return [*[None] * count, *pull(operands[:count], list(map(ad.instantiate_zeros, cotangents)))]


def _batched(
    operands: Sequence[AnyArray],
    axes: Sequence[Any],
    *,
    count: int,
    push: Any,
    pull: Any,
    avals: Any,
    message: str,
) -> tuple[Any, Any]:
    size = next(leaf.shape[axis] for leaf, axis in zip(operands, axes, strict=True) if axis is not None)
    constant_axes, moving_axes = list(axes[:count]), list(axes[count:])

    def pushes(constants: Sequence[AnyArray], moving: Sequence[Array]) -> list[Array]:
        return jax.vmap(push, in_axes=(constant_axes, moving_axes))(list(constants), list(moving))

    def pulls(constants: Sequence[AnyArray], cotangents: Sequence[Array]) -> list[Array]:
        parts = jax.vmap(pull, in_axes=(constant_axes, 0))(list(constants), list(cotangents))
        pairs = zip(parts, moving_axes, strict=True)
        return [jnp.sum(part, 0) if axis is None else jnp.moveaxis(part, 0, axis) for part, axis in pairs]

    avals = tuple(aval.update(shape=(size, *aval.shape)) for aval in avals)
    params = {"push": pushes, "pull": pulls, "avals": avals, "message": message}
    results = _PUSH.bind(*operands, count=count, **params)
    return results, [0] * len(results)


_PUSH.def_impl(_pushed)
_PUSH.def_abstract_eval(lambda *operands, avals, **_: avals)
mlir.register_lowering(_PUSH, mlir.lower_fun(_pushed, multiple_results=True))
ad.primitive_jvps[_PUSH] = _jvp
ad.primitive_transposes[_PUSH] = _transpose
batching.primitive_batchers[_PUSH] = _batched
