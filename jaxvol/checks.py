"""How is a bad argument reported? By its name, what came, and what was expected.

A fault that shapes or Python values show raises `ValueError` at once. A fault that only
traced values show is raised by `equinox.error_if` when the compiled program runs.
"""

import contextlib
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .sharding import varies_over


T = TypeVar("T")

Arrayable: TypeAlias = Any
"""What a caller may give for an array: an array of any library, nested sequences, a number. Any, since it
is checked by its value, with an error that names the argument."""


def is_traced(*values: Any) -> bool:
    """Whether any of the values is known only when the compiled program runs."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def require(value: T, holds: Callable[..., Any], message: str, *others: Any) -> T:
    """`value`, once `holds(value, *others)` is true everywhere.

    **Arguments:**

    - `holds`: asked of NumPy arrays where values are concrete, else of traced ones; so it is made of what
        both have, operators and methods.
    - `message`: the error; `{got}` in it becomes the value.

    **Returns:** the value. Use what is returned: a check on a traced value vanishes without it.

    **Raises:** `ValueError` at once for a concrete value, an Equinox runtime error for a traced one. Inside
    `jax.shard_map`, which Equinox's errors do not work in, a traced value becomes NaN instead.
    """
    if is_traced(value, *others):
        if any(map(varies_over, jax.tree.leaves((value, others)))):
            return jax.tree.map(lambda leaf: jnp.where(jnp.all(holds(value, *others)), leaf, jnp.nan), value)
        # apart from what Equinox says around it, which under a plain `jax.jit` is long
        message = f"\n\n{message.format(got='a value known only when the program runs')}\n"
        return eqx.error_if(value, ~jnp.all(holds(value, *others)), message)
    # by NumPy, which compiles nothing
    if not np.all(holds(*(np.asarray(given) for given in (value, *others)))):
        raise ValueError(message.format(got=np.asarray(value)))
    return value


def finite(values: Any) -> Any:
    """For `require`: everything but NaN and infinity."""
    return abs(values) < np.inf


def all_finite(tree: Any) -> Array:
    """Whether no float of a tree's arrays is NaN or infinite; found when the program runs."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves])) if leaves else jnp.array(True)


def finite_array(name: str, value: Arrayable, shape: tuple[int | None, ...]) -> Array:
    """`value` as an array of JAX's default float type, of this shape (None: any length)."""
    spelled = str(shape).replace("None", "n")
    try:
        if not is_traced(value) and not isinstance(value, jax.Array):
            value = np.asarray(value)
            if value.dtype.kind not in "biufV":  # V: JAX's own short floats
                raise TypeError
            value = value.astype(jnp.result_type(float))
        with contextlib.nullcontext() if is_traced(value) else jax.ensure_compile_time_eval():
            array = jnp.asarray(value, dtype=float)
    except (TypeError, ValueError) as fault:
        raise ValueError(f"{name} must be numbers of shape {spelled}; got {value!r}.") from fault
    fits = array.ndim == len(shape) and all(
        want in (None, got) for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name} must have shape {spelled}; got shape {array.shape}.")
    return require(array, finite, f"{name} must be finite; got {{got}}.")


def number(
    name: str, value: Arrayable, *, above: float = -np.inf, below: float = np.inf, unit: str = ""
) -> Array:
    """`value` as a finite scalar strictly between `above` and `below`."""
    bounds = (("greater than", above), ("less than", below))
    between = " and ".join(f"{word} {bound:g}" for word, bound in bounds if np.isfinite(bound))
    return require(
        finite_array(name, value, ()),
        lambda scalar: (scalar > above) & (scalar < below),
        f"{name} must be {between}{' ' + unit if unit else ''}; got {{got}}.",
    )


def unit_interval(name: str, value: Arrayable, shape: tuple[int | None, ...]) -> Array:
    """`value` as an array of numbers in [0, 1]."""
    array = finite_array(name, value, shape)
    return require(array, lambda a: (a >= 0) & (a <= 1), f"{name} must be in [0, 1]; got {{got}}.")


def integer(name: str, value: Any, least: int) -> int:
    """`value` as a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}; got {value!r}.")
    return int(value)
