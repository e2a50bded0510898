"""The platform of a program, and its loops. On a GPU, the host waits for the device at each branch, and at
each turn of a loop of unknown length, as XLA copies the predicate to it."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool


State = TypeVar("State")

TURNS = 16
"""Turns of a loop between two looks at its condition, on a GPU."""


def platform() -> str:
    """Platform of the program that is traced: of `jax.default_device`, or the default backend. Arrays on
    another device make it slower, not wrong."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return jax.default_backend() if device is None else getattr(device, "platform", str(device))


def on_gpu() -> bool:
    """Whether a program that is traced now is for a GPU."""
    return platform() in ("gpu", "cuda", "rocm")


@cache
def gathers_are_fast() -> bool:
    """Whether LLVM gathers many values at once: on Intel with AVX-512. Elsewhere, a kernel with gathers runs
    sample by sample, and what surrounds them is another kernel."""
    try:
        features = Path("/proc/cpuinfo").read_text()
    except OSError:  # not Linux
        return False
    return "GenuineIntel" in features and "avx512f" in features


def while_loop(
    cond: Callable[[State], Bool[Array, ""]], body: Callable[[State], State], start: State
) -> State:
    """`jax.lax.while_loop`; on a GPU, the condition is tested once in `TURNS`, and surplus turns idle."""

    def turn(_: object, state: State) -> State:
        return jax.tree.map(partial(jnp.where, cond(state)), body(state), state)

    def turns(state: State) -> State:
        return jax.lax.fori_loop(0, TURNS, turn, state)

    return jax.lax.while_loop(cond, turns if on_gpu() else body, start)


def is_traced(*values: Any) -> bool:
    """Whether any of the values is a tracer."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def in_numpy(*values: Any) -> tuple[Any, Any]:
    """`numpy` and the values as its arrays, where they are known; else `jax.numpy` and the values."""
    return (jnp, values) if is_traced(*values) else (np, jax.tree.map(np.asarray, values))
