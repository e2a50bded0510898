"""Platform of a program, and loops for it. On a GPU, the host waits for the device at each branch, and at
each turn of a loop of unknown length, since XLA copies the predicate to the host."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool


State = TypeVar("State")

TURNS = 16  # turns of a loop between two tests of its condition, on a GPU


def platform() -> str:
    """Platform of a traced program: that of `jax.default_device`, or the default backend. The program is
    correct, but slower, for arrays on another device."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return jax.default_backend() if device is None else getattr(device, "platform", str(device))


def on_gpu() -> bool:
    """Tests whether a program traced now is for a GPU."""
    return platform() in ("gpu", "cuda", "rocm")


@cache
def gathers_are_fast() -> bool:
    """Tests whether LLVM vectorizes gathers: on Intel with AVX-512. Elsewhere, a kernel with gathers runs
    sample by sample, so that other operations belong in another kernel."""
    try:
        features = Path("/proc/cpuinfo").read_text()
    except OSError:  # not Linux
        return False
    return "GenuineIntel" in features and "avx512f" in features


def while_loop(
    cond: Callable[[State], Bool[Array, ""]], body: Callable[[State], State], start: State
) -> State:
    """`jax.lax.while_loop`; on a GPU, the condition is tested every `TURNS` turns, and surplus turns idle."""

    def turn(_: object, state: State) -> State:
        return jax.tree.map(partial(jnp.where, cond(state)), body(state), state)

    def turns(state: State) -> State:
        return jax.lax.fori_loop(0, TURNS, turn, state)

    return jax.lax.while_loop(cond, turns if on_gpu() else body, start)


def is_traced(*values: Any) -> bool:
    """Tests whether any of the values is a tracer."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def in_numpy(*values: Any) -> tuple[Any, Any]:
    """`numpy` and the values as its arrays if they are concrete; else `jax.numpy` and the values."""
    return (jnp, values) if is_traced(*values) else (np, jax.tree.map(np.asarray, values))


def stack(leaves: Sequence[Array | np.ndarray | np.generic]) -> Array:
    """`jnp.stack`, which compiles no program if the arrays are concrete."""
    xp, leaves = in_numpy(*leaves)
    return jnp.asarray(xp.stack(leaves), leaves[0].dtype)
