"""Random numbers per pixel: hashes, and a tile of blue noise."""

from pathlib import Path
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int, UInt32

from ..xla.platform import is_traced
from .checks import Arrayable, integer
from .vec3 import Vec3


Word: TypeAlias = UInt32[Array, "..."]


def seed_word(seed: Arrayable) -> UInt32[Array, ""]:
    """32-bit word of a seed: an integer in [0, 2³²), if traced modulo 2³², or a key of `jax.random`."""
    if is_key(seed):
        return jax.random.bits(seed, (), jnp.uint32)
    if is_traced(seed) and jnp.shape(seed) == () and jnp.issubdtype(jnp.result_type(seed), jnp.integer):
        return jnp.asarray(seed).astype(jnp.uint32)
    word = integer("seed", seed, 0, 2**32 - 1, otherwise=", or a key of jax.random")
    return jnp.asarray(np.array(word, np.uint32), jnp.uint32)


def is_key(seed: object) -> bool:
    """Test for a single key of `jax.random`, typed or raw."""
    if not isinstance(seed, jax.Array):
        return False
    if jnp.issubdtype(seed.dtype, jax.dtypes.prng_key):
        return seed.shape == ()
    return seed.dtype == jnp.uint32 and seed.shape == (2,)


def hashed_uniforms(x: Int[Array, ""], y: Int[Array, ""], seed: UInt32[Array, ""], dtype: DTypeLike) -> Vec3:
    """Three independent uniform numbers in [0, 1), by a fifth of the operations of `jax.random`.

    Source: pcg3d of Jarzynski and Olano, "Hash Functions for GPU Rendering", JCGT 9(3), 2020.
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
    """Four independent uniform float32 numbers in [0, 1) from four words: pcg4d, of the same source."""

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


def _unit(word: Word, dtype: DTypeLike) -> Float[Array, "..."]:
    # float32 holds 24 bits exactly, which rules out rounding up to 1
    return (word >> np.uint32(8)).astype(dtype) * (2.0**-24)


def blue_tile() -> Float[Array, "side side"]:
    """Tile of blue noise in (0, 1), periodic; its ranks are by void and cluster (Ulichney 1993)."""
    ranks = np.load(Path(__file__).with_name("blue_noise.npy"))
    with jax.ensure_compile_time_eval():
        return jnp.asarray(((ranks + 0.5) / ranks.size).astype(np.float32), jnp.float32)
