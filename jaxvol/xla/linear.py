"""Gives a function derivatives in both modes: a push-forward of tangents, and its transpose, a pull-back. A
`custom_jvp` is transposed operation by operation, which fails for a loop of unknown length; a `custom_vjp`
has no forward mode. Here, JAX transposes a primitive as a whole, also under forward mode."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from .compiling import compiled
from .differentiation import forward_only, not_transposed
from .platform import is_traced
from .trees import PyTree, floats, is_none


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
        recorded: the same, where it is differentiated, and the arrays that its pull-back needs.
        push: `push(tangents, tree, *fixed)`: the tangents of the function's floats, from those of the tree's,
            None where these do not move.
        pull: `pull(cotangents, perturbed, residuals, tree, *fixed)`: the cotangents of those of the tree's
            leaves that are `perturbed`, from those of the function's floats.
        message: of the error where a push or a pull is to be transposed, that is, for second derivatives with
            reverse mode outside.
    """

    def run(tree: PyTree, *fixed: Any) -> PyTree:
        arrays, static = eqx.partition((tree, fixed), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        of_tree = len(jax.tree.leaves(arrays[0]))

        def given(leaves: Sequence[Any]) -> tuple[Any, ...]:
            tree, fixed = eqx.combine(jax.tree.unflatten(structure, leaves), static)
            return tree, *fixed

        def like_tree(leaves: Sequence[Any], other: Any) -> PyTree:
            """A tree with these in place of the arrays, and `other` in place of other leaves."""
            found = jax.tree.unflatten(jax.tree.structure(arrays[0]), leaves)
            return eqx.combine(found, jax.tree.map(lambda _: other, static[0]))

        @jax.custom_jvp
        def function(*leaves: Array) -> PyTree:
            return plain(*given(leaves))

        def rule(primals: Sequence[Array], tangents: Sequence[Any]) -> tuple[PyTree, PyTree]:
            found, residuals = recorded(*given(primals))
            if is_traced(primals):
                found, residuals = forward_only((found, residuals), message)
            outputs, out = jax.tree.flatten(found)
            is_float = [eqx.is_inexact_array(leaf) for leaf in outputs]
            kept, kept_structure = jax.tree.flatten(residuals)
            moves = [not isinstance(tangent, SymbolicZero) for tangent in tangents[:of_tree]]
            known = len(primals)

            def pushed(constants: Sequence[Array], moving: Sequence[Array]) -> list[Array]:
                rest = iter(moving)
                each = like_tree([next(rest) if moves_ else None for moves_ in moves], None)
                return jax.tree.leaves(push(each, *given(constants[:known])))

            def pulled(constants: Sequence[Array], cotangents: Sequence[Array]) -> list[Array]:
                rest = iter(cotangents)
                each = [next(rest) if float_ else None for float_ in is_float]
                residuals = jax.tree.unflatten(kept_structure, constants[known:])
                parts = jax.tree.unflatten(out, each), like_tree(moves, False), residuals
                of = jax.tree.leaves(pull(*parts, *given(constants[:known])))
                assert len(of) == sum(moves)
                return forward_only(of, message) if is_traced(constants, cotangents) else of

            operands = *primals, *kept, *(t for t, moves_ in zip(tangents, moves, strict=False) if moves_)
            known_, avals = known + len(kept), tuple(map(jax.typeof, filter(eqx.is_inexact_array, outputs)))
            how = {"push": pushed, "pull": pulled, "avals": avals}
            tangent = iter(_PUSH.bind(*operands, count=known_, message=message, **how))
            of_outputs = [
                next(tangent) if float_ else SymbolicZero(jax.typeof(leaf).to_tangent_aval())
                for leaf, float_ in zip(outputs, is_float, strict=True)
            ]
            return found, jax.tree.unflatten(out, of_outputs)

        function.defjvp(rule, symbolic_zeros=True)
        return function(*leaves)

    return run


def recomputed(function: Callable[..., PyTree], message: str) -> Callable[..., PyTree]:
    """The function and its derivative in reverse mode as programs, of which the second recomputes the first.
    `message`: as for `differentiable`."""

    def floats_of(args: tuple[Any, ...], moving: PyTree) -> PyTree:
        return floats(function(*eqx.combine(moving, args)))

    def push(tangents: PyTree, args: tuple[Any, ...]) -> PyTree:
        return jax.jvp(partial(floats_of, args), (moving_leaves(args, tangents),), (tangents,))[1]

    def pull(cotangents: PyTree, perturbed: PyTree, args: tuple[Any, ...]) -> PyTree:
        _, back = jax.vjp(partial(floats_of, args), eqx.filter(args, perturbed))
        return back(cotangents)[0]

    forward, pulled = (compiled(each, by_jvp=True) for each in (function, pull))
    pushed = compiled(push, has_jvp=True)
    run = differentiable(
        lambda args: forward(*args),
        lambda args: (forward(*args), ()),
        pushed,
        lambda cotangents, perturbed, _, args: pulled(cotangents, perturbed, args),
        message,
    )
    return lambda *args: run(args)


def moving_leaves(tree: PyTree, tangents: PyTree) -> PyTree:
    """The leaves of a tree that have a tangent; None in place of the others."""
    return jax.tree.map(lambda leaf, of: None if of is None else leaf, tree, tangents, is_leaf=is_none)


# From constants, of which there are `count`, and tangents to tangents, in which it is linear.
_PUSH = Primitive("push_forward")
_PUSH.multiple_results = True


def _pushed(*operands: Array, count: int, push: Any, **_: Any) -> list[Array]:
    return push(operands[:count], operands[count:])


def _jvp(primals: Sequence[Array], tangents: Sequence[Any], *, count: int, **how: Any) -> tuple[Any, Any]:
    constants, moving = primals[:count], primals[count:]
    found = _PUSH.bind(*primals, count=count, **how)
    change: list[Any] = [jnp.zeros_like(leaf) for leaf in found]
    if any(not isinstance(tangent, ad.Zero) for tangent in tangents[count:]):
        of_moving = map(ad.instantiate_zeros, tangents[count:])
        change = _PUSH.bind(*constants, *of_moving, count=count, **how)
    if any(not isinstance(tangent, ad.Zero) for tangent in tangents[:count]):
        floats = [i for i, leaf in enumerate(constants) if eqx.is_inexact_array(leaf)]

        def by_constants(*leaves: Array) -> list[Array]:
            all_ = list(constants)
            for i, leaf in zip(floats, leaves, strict=True):
                all_[i] = leaf
            return how["push"](all_, moving)

        given = [constants[i] for i in floats], [ad.instantiate_zeros(tangents[i]) for i in floats]
        more = not_transposed(jax.jvp(by_constants, *given)[1], how["message"])
        change = [a + b for a, b in zip(change, more, strict=True)]
    return found, change


def _transpose(cotangents: Sequence[Any], *operands: Any, count: int, pull: Any, **how: Any) -> list[Any]:
    given = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    return [*[None] * count, *pull(operands[:count], given)]


def _batched(
    operands: Sequence[Array],
    axes: Sequence[Any],
    *,
    count: int,
    push: Any,
    pull: Any,
    avals: Any,
    message: str,
) -> tuple[Any, Any]:
    size = next(leaf.shape[axis] for leaf, axis in zip(operands, axes, strict=True) if axis is not None)
    of_constants, of_moving = list(axes[:count]), list(axes[count:])

    def pushes(constants: Sequence[Array], moving: Sequence[Array]) -> list[Array]:
        return jax.vmap(push, in_axes=(of_constants, of_moving))(list(constants), list(moving))

    def pulls(constants: Sequence[Array], cotangents: Sequence[Array]) -> list[Array]:
        found = jax.vmap(pull, in_axes=(of_constants, 0))(list(constants), list(cotangents))
        both = zip(found, of_moving, strict=True)
        return [jnp.sum(of, 0) if axis is None else jnp.moveaxis(of, 0, axis) for of, axis in both]

    own = tuple(aval.update(shape=(size, *aval.shape)) for aval in avals)
    how = {"push": pushes, "pull": pulls, "avals": own, "message": message}
    found = _PUSH.bind(*operands, count=count, **how)
    return found, [0] * len(found)


_PUSH.def_impl(_pushed)
_PUSH.def_abstract_eval(lambda *operands, avals, **_: avals)
mlir.register_lowering(_PUSH, mlir.lower_fun(_pushed, multiple_results=True))
ad.primitive_jvps[_PUSH] = _jvp
ad.primitive_transposes[_PUSH] = _transpose
batching.primitive_batchers[_PUSH] = _batched
