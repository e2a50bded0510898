"""Memoizes results computed from immutable arrays for the arrays' lifetime, so that none becomes stale."""

import weakref
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array

from .compiling import computed_now
from .platform import is_traced, on_gpu
from .trees import PyTree


T = TypeVar("T")


def memoized(
    array: Array | np.ndarray, compute: Callable[[Any], T], in_numpy: Callable[[Any], Any] | None = None
) -> T:
    """`compute(array)`, computed once in the lifetime of a concrete array (under `jax.vmap`, of the batch),
    without a gradient. `in_numpy`: the function in NumPy, used unless the array is committed to a device."""
    if not isinstance(array, jax.Array):  # NumPy arrays are mutable
        return compute(array)
    if is_traced(array):
        return _of_batch(compute)(jax.lax.stop_gradient(array))
    key = id(array), compute
    if key not in _MEMORY:
        if in_numpy is None or array.committed or on_gpu():
            _MEMORY[key] = computed_now(compute, array)
        else:
            with jax.ensure_compile_time_eval():
                _MEMORY[key] = jax.tree.map(jax.device_put, in_numpy(np.asarray(array)))
        weakref.finalize(array, _MEMORY.pop, key, None)
    return _MEMORY[key]


def memoized_of(tree: PyTree, compute: Callable[[Any], T]) -> T:
    """`compute(tree)`, computed once in the lifetime of the tree's arrays, which must be concrete."""
    leaves, structure = jax.tree.flatten(tree)
    key = tuple(map(id, leaves)), structure, compute
    if key not in _MEMORY:
        _MEMORY[key] = computed_now(compute, tree)
        when_any_dies(leaves, lambda: _MEMORY.pop(key, None))
    return _MEMORY[key]


def when_any_dies(parts: Sequence[Any], forget: Callable[[], Any]) -> None:
    """Calls `forget` once, when the first of the parts is freed."""
    finalizers: list[Any] = []

    def first() -> None:
        forget()
        for finalizer in finalizers:
            finalizer.detach()

    finalizers += [weakref.finalize(part, first) for part in parts]


@cache
def _of_batch(compute: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`compute` of one array, with a batching rule that memoizes the results of a batch."""
    single, batch = jax.custom_batching.custom_vmap(compute), jax.vmap(compute)

    @single.def_vmap
    def _(size: int, batched: list[bool], arrays: Array) -> Any:
        results = memoized(arrays, batch)
        return results, jax.tree.map(lambda _: True, results)

    return single


_MEMORY: dict[Hashable, Any] = {}
