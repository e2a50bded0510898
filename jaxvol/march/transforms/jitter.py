"""Jittered sampling and empty-space jittering, which keep steps from showing as rings.

Samples at the same depths in all pixels show rings around surfaces: wood grain. Both transforms shift the
samples of each pixel by a random fraction ξ of a step, which turns the rings into noise of the same energy.
"""

from dataclasses import replace
from typing import Any, ClassVar, Literal, SupportsIndex, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from ..._util.checks import Flag, flag
from ..._util.noise import blue_tile, hashed_uniforms, seed_word
from ..._util.vec3 import Scalar
from ...scene.space import Ray
from ...scene.volume import Volume
from ..march import Cell, CellRules, Transform, cut_at_entry


Pattern: TypeAlias = Literal["white", "blue"]
Seed: TypeAlias = SupportsIndex | Array
"""An integer in [0, 2³²), or a key of `jax.random`."""


class Noise(eqx.Module):
    """One random number in [0, 1) by seed, stream and pixel: `"white"`, or `"blue"`, from a repeated tile of
    128 x 128 without low frequencies. Streams are independent."""

    seed: UInt32[Array, ""]
    tile: Float[Array, "side side"] | None
    stream: int = eqx.field(static=True)

    def __init__(self, seed: Seed, pattern: Pattern, stream: int):
        self.seed = seed_word(seed)
        if pattern not in ("white", "blue"):
            raise ValueError(f'pattern must be "white" or "blue"; got {pattern!r}.')
        self.tile = blue_tile() if pattern == "blue" else None
        self.stream = stream

    def __call__(self, pixel: tuple[Int[Array, ""], Int[Array, ""]], dtype: Any) -> Scalar:
        column, row = pixel
        if self.tile is None:
            return hashed_uniforms(column, row, self.seed, dtype)[self.stream]
        side = self.tile.shape[0]
        stream = jnp.full_like(column, self.stream)
        shift_x, shift_y, _ = hashed_uniforms(stream, stream, self.seed, jnp.float32)
        x = (column + (shift_x * side).astype(column.dtype)) % side
        y = (row + (shift_y * side).astype(row.dtype)) % side
        return self.tile[y, x].astype(dtype)


class Jitter(Transform):
    """Start each ray a random fraction ξ of a step past its entry: wood grain becomes noise.

    It leaves out the first ξ d, which adds noise where the volume's bounds cut through material.

    Args:
        seed: an integer in [0, 2³²), or a key of `jax.random`. It may be traced and vmapped over.
        pattern: `"white"` (the paper's) or `"blue"`, whose low frequencies are suppressed.
        front_residual: give what is left out a narrow cell of its own, from the entry to ξ d. Cut faces then
            miss no thickness; what noise is left comes from where their values are sampled.

    Where it fails: `experiments/stability.py`, "jitter on cut faces", "jitter offsets near 1".

    Raises:
        ValueError: for an invalid seed, pattern or `front_residual`.

    Source: jittered sampling as in Kye 2013, section 2.2.
    """

    joins: ClassVar[bool] = True

    noise: Noise
    front_residual: bool = eqx.field(static=True)

    def __init__(self, seed: Seed = 0, pattern: Pattern = "white", *, front_residual: Flag = False):
        self.noise = Noise(seed, pattern, stream=0)
        self.front_residual = flag("front_residual", front_residual)

    def start(self, steps: Scalar, ray: Ray) -> Scalar:
        offset = self.noise(ray.pixel, steps.dtype)
        if self.front_residual:  # of 0, which leaves nothing out, there is no cell of its own
            offset = jnp.where(offset > 0, offset - 1, 0)
        return steps + offset

    def cut(self, cell: Cell, ray: Ray, volume: Volume) -> tuple[Cell, ...]:
        return (cut_at_entry(cell) if self.front_residual else cell,)

    def rules(self, rules: CellRules) -> CellRules:
        return replace(rules, at_entry=True) if self.front_residual else rules


class EmptySpaceJitter(Transform):
    """Advance by a random fraction ξ of a step at a ray's first transparent sample: wood grain becomes noise,
    while faces where the volume's bounds cut material stay smooth.

    Transparent is a sample of extinction 0; a ray without one keeps its wood grain. The image jumps where a
    ray's first transparent sample changes; gradients do not include these jumps.

    Args:
        seed: as in `Jitter`; the random numbers are independent of `Jitter`'s.
        pattern: as in `Jitter`.

    Where it fails: `experiments/stability.py`, "wood grain without empty samples".

    Raises:
        ValueError: for an invalid seed or pattern.

    Source: Kye 2013, section 3.1.
    """

    noise: Noise

    def __init__(self, seed: Seed = 0, pattern: Pattern = "white"):
        self.noise = Noise(seed, pattern, stream=1)

    def shift(self, ray: Ray) -> Scalar:
        return self.noise(ray.pixel, ray.length.dtype) - 1
