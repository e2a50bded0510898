"""Gathers, stores and sums values. A GPU adds rows of equal index sequentially: zeros, which come from most
samples of finished rays, are skipped there, and shared tables are summed in copies."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .platform import on_gpu
from .sharding import varying


ALIGNED = 64  # bytes; JAX on CPU does not copy a NumPy array that begins at a multiple of it
COPIES, ROWS = 128, 2**15  # limits, on a GPU, of the copies of a table, and of the rows of all copies


def row_sums(
    number: int, index: Int[Array, "*batch"], rows: Float[Array, "*batch columns"]
) -> Float[Array, "{number} columns"]:
    """Sums of the rows of equal index, for the indices 0 to `number` - 1; there must be no others."""
    if not on_gpu():
        zeros = jnp.zeros((number, rows.shape[-1]), rows.dtype)
        return zeros.at[index].add(rows, mode="promise_in_bounds")
    index, rows = index.reshape(-1), rows.reshape(-1, rows.shape[-1])
    copies = max(1, min(COPIES, ROWS // number))
    copy = jnp.arange(index.size, dtype=index.dtype) % copies
    place = without_zeros(number * copy + index, rows, copies * number)
    zeros = jnp.zeros((copies * number, rows.shape[-1]), rows.dtype)
    return jnp.sum(zeros.at[place].add(rows, mode="drop").reshape(copies, number, -1), axis=0)


def without_zeros(
    index: Int[Array, " rows"], rows: Float[Array, "rows columns"], end: int
) -> Int[Array, " rows"]:
    """The indices of rows, with `end`, which is out of range, in place of those of zero rows."""
    return jnp.where(jnp.any(rows != 0, axis=-1), index, end)


def gather(array: Array, index: Array) -> Array:
    """`array[index]` along the first axis, for indices known to be in range, without a check."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def zeros_in_reserve(length: int, dtype: np.dtype | type) -> np.ndarray:
    """NumPy zeros that `jax.device_put` does not copy, so that unwritten pages take no memory."""
    size = length * np.dtype(dtype).itemsize
    reserved = np.zeros(size + ALIGNED, np.uint8)
    first = -reserved.ctypes.data % ALIGNED
    return reserved[first : first + size].view(dtype)


def packed_pair(a: Array, b: Array, factor: Array) -> Array:
    """(a · factor, b · factor) in one complex array: XLA would compute shared terms of two arrays twice."""
    return jax.lax.complex(a, b) * jax.lax.complex(factor, jnp.zeros_like(factor))


def unpacked_pair(pair: Array) -> tuple[Array, Array]:
    """The two arrays of a `packed_pair`."""
    return jnp.real(pair), jnp.imag(pair)


def in_memory(live: Bool[Array, ""], f: Callable[..., Any], *arguments: Any) -> Any:
    """`f(*arguments)`, stored in memory as the result of a branch, since XLA recomputes a fused value for
    each use. `live` must be true, but unknown to XLA; otherwise floats are NaN. On a GPU, where a branch
    waits for the host, an `optimization_barrier` has this effect, which it lacks on CPU."""
    if on_gpu():
        return jax.lax.optimization_barrier(f(*arguments))
    plain = jax.jit(f, inline=True)  # traced once, for its shapes and as a branch

    def always(*arguments: Any) -> Any:
        return varying(plain(*arguments), live, arguments)

    def never(*arguments: Any) -> Any:
        def filled(leaf: jax.ShapeDtypeStruct) -> Array:
            fill = jnp.nan if jnp.issubdtype(leaf.dtype, jnp.inexact) else 0
            return jnp.full(leaf.shape, fill, leaf.dtype)

        return varying(jax.tree.map(filled, jax.eval_shape(plain, *arguments)), live, arguments)

    return jax.lax.cond(live, always, never, *arguments)
