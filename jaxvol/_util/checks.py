"""Checks of arguments. An error names the argument, its value and the expectation: a `ValueError` at once for
shapes and known values, NaN in the program for traced ones."""

import contextlib
import operator
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import EllipsisType
from typing import Any, SupportsIndex, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..xla.platform import is_traced
from ..xla.trees import PyTree


T = TypeVar("T")

Arrayable: TypeAlias = Any
"""Argument that is converted to an array. `Any`: checked at run time, by errors that name the argument."""

Flag: TypeAlias = bool | np.bool_
"""Argument that is true or false; NumPy's comparisons give the second kind."""


def described(value: object) -> str:
    """Short description of a value for error messages."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, np.ndarray | jax.Array):
        library = "traced" if is_traced(value) else "JAX" if isinstance(value, jax.Array) else "NumPy"
        return f"a {library} array of shape {value.shape} and type {value.dtype}"
    if value is None or isinstance(value, bool | int | float | complex | str | os.PathLike | np.generic):
        return shortened(value)
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of length {len(value)}"
    return f"a {type(value).__name__}"


def shortened(value: object) -> str:
    """`repr(value)`, without its middle if it is long."""
    try:
        text = repr(value)
    except ValueError:  # Python does not write integers of more than 4300 digits
        return f"a {type(value).__name__} with a very long integer"
    return text if len(text) <= 120 else f"{text[:50]} ... {text[-50:]}"


def printable(text: str) -> str:
    """Text with control characters escaped, since a file's text might control a terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def require(value: T, holds: Callable[..., Any], message: str, *args: Any) -> T:
    """Return `value` if `holds(value, *args)` is true everywhere, else raise a `ValueError`.

    Inside a program, where that is unknown, numbers for which it is false become NaN, and so does their
    gradient: JAX would keep and export no program that calls the host. Under `jax.disable_jit` the error is
    raised there. `holds` gets NumPy arrays if all are concrete, and its answer broadcasts to `value`; `{got}`
    in the message is replaced by the value."""
    array: Any = value
    if is_traced(array, *args):
        holding = holds(array, *args)
        if is_traced(holding):
            return array * jnp.where(holding, 1, jnp.nan).astype(array.dtype)
        array = jax.lax.stop_gradient(array)  # differentiated, but known
    else:  # in NumPy, which compiles nothing
        holding = holds(*map(np.asarray, (array, *args)))
    if not np.all(holding):
        raise ValueError(message.format(got=described(array) if is_traced(array) else np.asarray(array)))
    return value


def finite(values: Arrayable) -> Any:
    """Condition for `require`: neither NaN nor infinite."""
    return abs(values) < np.inf


def all_finite(tree: PyTree) -> Any:
    """Test that all floats of a tree are finite; in NumPy if all are NumPy arrays."""
    arrays = (leaf for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array | np.ndarray))
    leaves = [leaf for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    if all(isinstance(leaf, np.ndarray) for leaf in leaves):
        return np.asarray(all(np.isfinite(leaf).all() for leaf in leaves))
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves])) if leaves else jnp.array(True)


def finite_array(
    name: str, value: Arrayable, shape: tuple[int | EllipsisType | None, ...], *, infinite: bool = False
) -> Array:
    """Convert to a finite float array of a shape (None: any length; a leading `...`: any axes)."""
    expected = str(shape).replace("None", "n").replace("Ellipsis", "*rays")
    try:
        if isinstance(value, jax.Array):
            source = value
        else:  # a sequence may hold traced numbers
            source = jnp.asarray(value) if is_traced(value) else np.asarray(value)
        # V: JAX's own 8- and 16-bit floats; keys of `jax.random` have no kind
        if getattr(source.dtype, "kind", "O") not in "biufV":
            raise TypeError
        with np.errstate(over="ignore"):  # overflow to infinity is rejected below
            cast = source.astype(jnp.result_type(float)) if isinstance(source, np.ndarray) else source
        with contextlib.nullcontext() if is_traced(value) else jax.ensure_compile_time_eval():
            array = jnp.asarray(cast, dtype=float)
    except (TypeError, ValueError) as fault:
        kind = f"numbers of shape {expected}" if shape else "a number"
        raise ValueError(f"{name} must be {kind}; got {shortened(value)}.") from fault
    lengths = [n for n in shape if n is not ...]
    sizes = array.shape[array.ndim - len(lengths) :] if ... in shape else array.shape
    if len(sizes) != len(lengths) or any(n not in (None, m) for n, m in zip(lengths, sizes, strict=True)):
        raise ValueError(f"{name} must have shape {expected}; got shape {array.shape}.")
    if infinite:
        return require(array, lambda values: abs(values) <= np.inf, f"{name} must not be NaN; got {{got}}.")
    if isinstance(source, np.ndarray) and not np.all(finite(cast)):
        beyond = f" in {array.dtype}" if np.all(finite(source)) else ""
        raise ValueError(f"{name} must be finite{beyond}; got {source}.")
    return require(array, finite, f"{name} must be finite; got {{got}}.")


def number(
    name: str, value: Arrayable, *, above: float = -np.inf, below: float = np.inf, unit: str = ""
) -> Array:
    """Convert to a finite scalar strictly between `above` and `below`."""
    bounds = (("greater than", above), ("less than", below))
    between = " and ".join(f"{word} {bound:g}" for word, bound in bounds if np.isfinite(bound))
    return require(
        finite_array(name, value, ()),
        lambda scalar: (scalar > above) & (scalar < below),
        f"{name} must be {between}{' ' + unit if unit else ''}; got {{got}}.",
    )


def not_negative(name: str, value: Arrayable, shape: tuple[int | None, ...] = ()) -> Array:
    """Convert to an array of finite numbers of at least 0; by default a scalar."""
    array = finite_array(name, value, shape)
    return require(array, lambda v: v >= 0, f"{name} must not be negative; got {{got}}.")


def increasing(name: str, value: Arrayable) -> Array:
    """Convert to an array of at least two increasing numbers; two equal ones make a step."""
    array = finite_array(name, value, (None,))
    if array.shape[0] < 2:
        raise ValueError(f"{name} must hold at least 2 control points; got {array.shape[0]}.")
    return require(
        array,
        lambda v: (v[1:] >= v[:-1]).all() & (v[2:] > v[:-2]).all(),
        f"{name} must increase from point to point, but for two equal ones that make a step; got {{got}}. "
        "Sort them, and let no three be equal.",
    )


def unit_interval(name: str, value: Arrayable, shape: tuple[int | None, ...]) -> Array:
    """Convert to an array of numbers in [0, 1]."""
    array = finite_array(name, value, shape)
    return require(array, lambda a: (a >= 0) & (a <= 1), f"{name} must be in [0, 1]; got {{got}}.")


def integer(
    name: str, value: object, minimum: int, maximum: int | None = None, *, otherwise: str = ""
) -> int:
    """Convert to an integer in a range, inclusive. `otherwise`: text about other accepted values."""
    number = None
    if isinstance(value, SupportsIndex) and not is_flag(value):
        with contextlib.suppress(TypeError):
            number = operator.index(value)
    if number is None or number < minimum or (maximum is not None and number > maximum):
        expected = f"of at least {minimum}" if maximum is None else f"from {minimum} to {maximum}"
        raise ValueError(f"{name} must be an integer {expected}{otherwise}; got {described(value)}.")
    return number


def integers(name: str, values: Arrayable) -> tuple[int, ...]:
    """Convert to a tuple of integers of at most 64 bits."""
    if np.ndim(values) != 1:
        raise ValueError(f"{name} must be a sequence of integers; got {described(values)}.")
    return tuple(integer(f"{name}[{k}]", value, -(2**63), 2**64 - 1) for k, value in enumerate(values))


def is_flag(value: object) -> bool:
    """Test for True or False of Python or NumPy."""
    return isinstance(value, bool | np.bool_)


def flag(name: str, value: object) -> bool:
    """Convert to True or False."""
    if not is_flag(value):
        raise ValueError(f"{name} must be True or False; got {described(value)}.")
    return bool(value)


def output_file(name: str, path: str | os.PathLike[str]) -> Path:
    """Path of a file, checked to be writable. `whole_file` makes its folder."""
    path = Path(path)
    try:
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        path.resolve()
        nearest = next(folder for folder in path.absolute().parents if folder.exists())
        if not nearest.is_dir():
            raise NotADirectoryError(f"{nearest} is not a folder")
        with tempfile.TemporaryFile(dir=nearest):
            pass
        if path.exists():
            path.open("ab").close()
    except (OSError, RuntimeError) as fault:  # RuntimeError: of links in a circle
        cause = getattr(fault, "strerror", None) or fault
        raise ValueError(f"{name}: {path} cannot be written ({cause}).") from fault
    return path


def check_answer(owner: object, method: str, answer: PyTree, expected: PyTree) -> None:
    """Raise a `ValueError` if a method of a custom class returned other shapes or types than expected."""

    def kinds(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda leaf: (jnp.shape(leaf), jnp.result_type(leaf).name), tree)

    try:
        is_expected = kinds(answer) == kinds(expected)
    except TypeError:  # a leaf that is no array
        is_expected = False
    if not is_expected:
        returned, wanted = (eqx.tree_pformat(tree) for tree in (answer, expected))
        types = {leaf.dtype.name for leaf in jax.tree.leaves((answer, expected)) if hasattr(leaf, "dtype")}
        hint = ""
        if types >= {"float32", "float64"}:
            hint = " Were the step, the camera or the volume made before jax_enable_x64 was set? Remake them."
        raise ValueError(f"{type(owner).__name__}.{method} must return {wanted}; got {returned}.{hint}")
