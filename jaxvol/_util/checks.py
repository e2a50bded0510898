"""How is a bad argument reported? By its name, what came, and what was expected.

A fault that shapes or Python values show raises `ValueError` at once. A fault that only
traced values show is raised by `equinox.error_if` when the compiled program runs.
"""

import contextlib
import operator
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import EllipsisType
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


def described(value: Any) -> str:
    """A value in a few words, for the error that refuses it."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.ndarray | jax.Array):
        library = "traced" if is_traced(value) else "JAX" if isinstance(value, jax.Array) else "NumPy"
        return f"a {library} array of shape {value.shape} and type {value.dtype}"
    if value is None or isinstance(value, bool | int | float | complex | str | os.PathLike | np.generic):
        return repr(value)
    return f"a {type(value).__name__}"


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


def finite_array(name: str, value: Arrayable, shape: tuple[int | EllipsisType | None, ...]) -> Array:
    """`value` as an array of JAX's default float type, of this shape (None: any length; `...` in front: any
    axes)."""
    spelled = str(shape).replace("None", "n").replace("Ellipsis", "*rays")
    given = value if is_traced(value) or isinstance(value, jax.Array) else _numbers(value)
    try:
        if given is None or jnp.issubdtype(given.dtype, jnp.complexfloating):
            raise TypeError
        with np.errstate(over="ignore"):  # what becomes infinite is refused below
            cast = given.astype(jnp.result_type(float)) if isinstance(given, np.ndarray) else given
        with contextlib.nullcontext() if is_traced(value) else jax.ensure_compile_time_eval():
            array = jnp.asarray(cast, dtype=float)
    except (TypeError, ValueError) as fault:
        raise ValueError(f"{name} must be numbers of shape {spelled}; got {value!r}.") from fault
    wanted = tuple(n for n in shape if n is not ...)
    held = array.shape[len(array.shape) - len(wanted) :] if ... in shape else array.shape
    if len(held) != len(wanted) or any(w not in (None, n) for w, n in zip(wanted, held, strict=True)):
        raise ValueError(f"{name} must have shape {spelled}; got shape {array.shape}.")
    if isinstance(given, np.ndarray) and not np.all(finite(cast)):
        beyond = f" in {array.dtype}" if np.all(finite(given)) else ""
        raise ValueError(f"{name} must be finite{beyond}; got {given}.")
    return require(array, finite, f"{name} must be finite; got {{got}}.")


def _numbers(value: Arrayable) -> np.ndarray | None:
    """`value` as a NumPy array of real numbers; None for what is none."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    return array if array.dtype.kind in "biufV" else None  # V: JAX's own short floats


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


def integer(name: str, value: Any, least: int, most: int | None = None, *, otherwise: str = "") -> int:
    """`value` as a whole number from `least` to `most`, both included; `otherwise`: what else it might have
    been."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        whole = operator.index(value)
    except TypeError:
        whole = None
    if whole is None or whole < least or (most is not None and whole > most):
        wanted = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name} must be an integer {wanted}{otherwise}; got {described(value)}.")
    return whole


def output_file(name: str, path: str | os.PathLike[str]) -> Path:
    """`path` as that of a file that can be written, whose folder is made: for what takes long to be made.

    **Raises:** `ValueError` for one that cannot."""
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        if path.parent.exists() and not path.parent.is_dir():
            raise NotADirectoryError(f"{path.parent} is no folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists():
            path.open("ab").close()
    except OSError as fault:
        raise ValueError(f"{name}: {path} cannot be written ({fault.strerror or fault}).") from fault
    return path
