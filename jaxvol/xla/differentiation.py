"""Detection of JAX's transformations, and errors for modes of differentiation that are not supported."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from .platform import is_traced
from .trees import PyTree


def tracers(leaf: object) -> Iterator[Any]:
    """JAX's tracers around an array, the innermost first. Those outside of a `jax.jit` are invisible."""
    while is_traced(leaf):
        yield leaf
        leaf = getattr(leaf, "primal", getattr(leaf, "val", None))


def transformations(leaf: Any) -> list[str]:
    """Names of the `tracers` around an array. Names, since JAX does not export their classes."""
    return [type(tracer).__name__ for tracer in tracers(leaf)]


def check_captured(name: str, function: object) -> None:
    """Raises `ValueError` for a closure over a value that is differentiated in reverse mode: a primitive with
    a custom derivative would miss it."""
    cells = getattr(function, "__closure__", None) or ()
    captured = jax.tree.leaves([cell.cell_contents for cell in cells])
    if any("LinearizeTracer" in transformations(leaf) for leaf in captured):
        raise ValueError(
            f"{name} captures a value that is differentiated: hold it as an array of an eqx.Module that has "
            "a __call__, or of the field or transfer function itself."
        )


def forward_only(tree: PyTree, message: str) -> PyTree:
    """Identity. Under reverse mode it raises `ValueError` with `message`."""

    @jax.custom_jvp
    def identity(leaf: Array) -> Array:
        return leaf

    @identity.defjvp
    def _(primal: tuple[Array], tangent: tuple[Array]) -> tuple[Array, Array]:
        return primal[0], not_transposed(*tangent, message)

    return jax.tree.map(lambda leaf: identity(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


def nan_derivatives(tree: PyTree, fault: Array) -> PyTree:
    """Identity whose derivatives are NaN in both modes where `fault` is true, even if they would be 0."""

    @jax.custom_jvp
    def identity(leaf: Array, factor: Array) -> Array:
        return leaf

    @identity.defjvp
    def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
        leaf, factor = primals
        return leaf, tangents[0] * factor.astype(leaf.dtype)

    factor = jnp.where(fault, jnp.nan, 1.0)
    return jax.tree.map(lambda leaf: identity(leaf, factor) if eqx.is_inexact_array(leaf) else leaf, tree)


def not_transposed(tangents: PyTree, message: str) -> PyTree:
    """Identity of tangents. Its transpose raises `ValueError` with `message`."""
    return jax.tree.map(lambda tangent: _TANGENT.bind(tangent, message=message), tangents)


def _refuse(cotangent: Any, tangent: Any, *, message: str) -> Any:
    raise ValueError(message)


# Identity whose transpose is an error. (`jax.custom_derivatives.linear_call` cannot be batched.)
_TANGENT = Primitive("forward_only")
_TANGENT.def_impl(lambda tangent, *, message: tangent)
_TANGENT.def_abstract_eval(lambda tangent, *, message: tangent)
mlir.register_lowering(_TANGENT, lambda context, tangent, *, message: [tangent])
batching.defvectorized(_TANGENT)
ad.deflinear2(_TANGENT, _refuse)
