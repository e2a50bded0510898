"""How is a bad argument reported? By its name, what came, and what was expected.

A fault that shapes or Python values show raises `ValueError` at once. A fault that only
traced values show is raised by `equinox.error_if` when the compiled program runs.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike


T = TypeVar("T")


def is_traced(*values: Any) -> bool:
    """Whether any of the values is known only when the compiled program runs."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def require(ok: Any, message: str, value: T) -> T:
    """`value`, once `ok` holds for all of its elements. The result must be used: a check
    on traced values vanishes with the value that carries it.

    **Raises:** `ValueError(message)` for a concrete `ok`; an Equinox runtime error with
    the same message where `ok` is traced.
    """
    if is_traced(ok):
        return eqx.error_if(value, ~jnp.all(ok), message)
    if not np.all(ok):
        raise ValueError(message)
    return value


def finite_array(name: str, value: ArrayLike | Any, shape: tuple[int | None, ...]) -> Array:
    """`value` as an array of JAX's default float type, of this shape (None: any length)."""
    try:
        array = jnp.asarray(value, dtype=float)
    except (TypeError, ValueError) as fault:
        raise ValueError(f"{name} must be numbers of shape {_spell(shape)}; got {value!r}.") from fault
    fits = array.ndim == len(shape) and all(
        want in (None, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name} must have shape {_spell(shape)}; got shape {array.shape}.")
    return require(jnp.isfinite(array), f"{name} must be finite; got {_show(array)}.", array)


def number(
    name: str, value: ArrayLike | Any, *, above: float = -np.inf, below: float = np.inf, unit: str = ""
) -> Array:
    """`value` as a finite scalar strictly between `above` and `below`."""
    scalar = finite_array(name, value, ())
    between = " and ".join(
        f"{word} {bound:g}"
        for word, bound in (("greater than", above), ("less than", below))
        if np.isfinite(bound)
    )
    message = f"{name} must be {between}{' ' + unit if unit else ''}; got {_show(scalar)}."
    return require((scalar > above) & (scalar < below), message, scalar)


def _show(array: Array) -> str:
    return "a value known only at run time" if is_traced(array) else str(np.asarray(array))


def _spell(shape: tuple[int | None, ...]) -> str:
    return "() (one number)" if not shape else str(tuple("n" if n is None else n for n in shape)).replace("'", "")
