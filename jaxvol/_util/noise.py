"""Per-pixel random numbers: hashes, and a tile of blue noise."""

from functools import cache
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from ..xla.platform import is_traced
from .checks import integer
from .vec3 import Vec3


Word: TypeAlias = UInt32[Array, "..."]


def seed_word(seed: int | Any) -> UInt32[Array, ""]:
    """The 32-bit word of a seed: an integer in [0, 2³²), which if traced is taken modulo 2³², or a key of
    `jax.random`. Raises `ValueError` for anything else."""
    if is_key(seed):
        return jax.random.bits(seed, (), jnp.uint32)
    if is_traced(seed) and jnp.shape(seed) == () and jnp.issubdtype(jnp.result_type(seed), jnp.integer):
        return jnp.asarray(seed).astype(jnp.uint32)
    word = integer("seed", seed, 0, 2**32 - 1, otherwise=", or a key of jax.random")
    return jnp.asarray(np.array(word, np.uint32), jnp.uint32)


def is_key(seed: Any) -> bool:
    """Whether a seed is a single key of `jax.random`, typed or raw."""
    if not isinstance(seed, jax.Array):
        return False
    if jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        return seed.shape == ()
    return seed.dtype == jnp.uint32 and seed.shape == (2,)


def hashed_uniforms(x: Int[Array, ""], y: Int[Array, ""], seed: UInt32[Array, ""], dtype: Any) -> Vec3:
    """Three numbers in [0, 1), independent of each other and from key to key.

    A hash rather than `jax.random`, which takes some hundred operations per number where this takes twenty:
    drawing them must not show in the frame time. Source: pcg3d of Jarzynski and Olano,
    "Hash Functions for GPU Rendering", JCGT 9(3), 2020.
    """

    def mix(a: Word, b: Word, c: Word) -> tuple[Word, Word, Word]:
        a = a + b * c
        b = b + c * a
        return a, b, c + a * b

    mixed = mix(*(_scrambled(key.astype(jnp.uint32)) for key in (x, y, seed)))
    a, b, c = (_unit(word, dtype) for word in mix(*map(_folded, mixed)))
    return a, b, c


def hashed_uniforms_4(
    a: Word, b: Word, c: Word, d: Word
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Four float32 numbers in [0, 1), independent of each other and from key to key of four words.

    Source: pcg4d of Jarzynski and Olano, as above.
    """

    def mix(a: Word, b: Word, c: Word, d: Word) -> tuple[Word, Word, Word, Word]:
        a = a + b * d
        b = b + c * a
        c = c + a * b
        return a, b, c, d + b * c

    mixed = mix(*map(_scrambled, (a, b, c, d)))
    w, x, y, z = (_unit(word, jnp.float32) for word in mix(*map(_folded, mixed)))
    return w, x, y, z


def _scrambled(word: Word) -> Word:
    return word * np.uint32(1664525) + np.uint32(1013904223)


def _folded(word: Word) -> Word:
    return word ^ (word >> np.uint32(16))


def _unit(word: Word, dtype: Any) -> Float[Array, "..."]:
    # float32 holds 24 bits exactly, which rules out rounding up to 1
    return (word >> np.uint32(8)).astype(dtype) * (2.0**-24)


@cache
def _blue_ranks(side: int = 128, sigma: float = 1.9) -> Int[np.ndarray, "side side"]:
    """Ranks 0 … side² - 1 on a torus, with neighbours far apart in rank: void and cluster (Ulichney 1993).

    Each rank goes to the largest void: the pixel farthest, by a Gaussian of `sigma` pixels, from those taken
    so far. At first, points in the tightest clusters are moved there.
    """
    away = np.minimum(np.arange(side), side - np.arange(side))
    bell = np.exp(-(away**2) / (2 * sigma**2)).astype(np.float32)
    kernel = np.tile(np.outer(bell, bell), (2, 2))
    taken, density = np.zeros((side, side), bool), np.zeros((side, side), np.float32)

    def put(index: int, sign: int) -> int:
        y, x = divmod(index, side)
        taken[y, x] = sign > 0
        density[...] += sign * kernel[side - y : 2 * side - y, side - x : 2 * side - x]
        return index

    def largest_void() -> int:
        return int(np.where(taken, np.inf, density).argmin())

    def tightest_cluster() -> int:
        return int(np.where(taken, density, -np.inf).argmax())

    first, moved, void = side * side // 10, -1, 0
    for index in np.random.default_rng(0).permutation(side * side)[:first].tolist():
        put(index, 1)
    while moved != void:
        moved = put(tightest_cluster(), -1)
        void = put(largest_void(), 1)

    # ranks below `first`: remove points from the tightest clusters; ranks above: fill the largest voids
    start = taken.copy(), density.copy()
    below = [put(tightest_cluster(), -1) for _ in range(first)]
    taken[...], density[...] = start
    above = [put(largest_void(), 1) for _ in range(first, side * side)]
    return np.argsort(below[::-1] + above).reshape(side, side)


def blue_tile() -> Float[Array, "side side"]:
    """Blue noise on a torus: numbers in (0, 1), each equally often, with low frequencies suppressed."""
    ranks = _blue_ranks()
    with jax.ensure_compile_time_eval():
        return jnp.asarray((ranks + 0.5) / ranks.size, jnp.float32)
