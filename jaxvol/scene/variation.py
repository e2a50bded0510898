"""How much do a volume's values, and with them extinction and emission, vary around each block?

From it follows how long cells may be (`AdaptiveSampling`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from ..xla.memo import memoized
from .occupancy import BLOCK, over_blocks
from .volume import Volume


MARGIN = 2
"""Nodes by which a window exceeds its block: it holds all cells of BLOCK voxels whose middle lies there."""


class Windows(eqx.Module):
    """Least and greatest value of the nodes of each block of a volume and those up to MARGIN beyond it."""

    low: Float[Array, "bx by bz"]
    high: Float[Array, "bx by bz"]
    bend: Float[Array, "bx by bz"]
    """Greatest second difference between nodes, along an axis or across two; NaN where a value is."""
    first: Int[Array, "3"] | None = None
    """Index of the first block, where the volume is only a part of its grid; `whole`: blocks of that."""
    whole: tuple[int, int, int] | None = eqx.field(static=True, default=None)

    @classmethod
    def of(cls, volume: Volume) -> "Windows":
        """The windows of a volume, computed once for each array of voxels."""
        low, high, bend = map(volume.in_grid_order, memoized(volume.data, _windows))
        if volume.field is not None:  # nothing is known about it
            low, high = jnp.full_like(low, -jnp.inf), jnp.full_like(high, jnp.inf)
            bend = jnp.full_like(bend, jnp.inf)
        corner = volume.first
        if corner is None:
            return cls(low, high, bend)
        x, y, z = (-(-(n - 1) // BLOCK) for n in volume.shape)
        return cls(low, high, bend, jnp.stack(corner).astype(jnp.int32) // BLOCK, (x, y, z))


class Variation(NamedTuple):
    """How much extinction and emission (extinction × colour) change within the range of values of each
    window: of extinction and three channels, the one that changes most."""

    total: Float[Array, "bx by bz"]
    """While the value passes through the range once, 1/length."""
    turns: Float[Array, "bx by bz"]
    """Sum of all changes of slope, 1/length for each unit of the value; infinite at a step."""
    colored: Float[Array, "bx by bz"]
    """The part of `total` that is due to the colour."""
    hidden: Float[Array, "bx by bz"]
    """`colored` times the extinction."""

    @classmethod
    def unknown(cls, windows: Windows) -> "Variation":
        """Infinite: nothing is known."""
        return cls(*[jnp.full(windows.low.shape, jnp.inf)] * 4)


@jax.jit
def _windows(data: Shaped[Array, "nx ny nz"]) -> tuple[Float[Array, "bx by bz"], ...]:
    """Least and greatest value and greatest bend in each window, one layer of blocks after the other: all
    differences would take several times the volume's memory."""
    last = data.shape[0] - 1

    def layer(block: Int[Array, ""]) -> tuple[Float[Array, "by bz"], ...]:
        # one node more at each end, for differences
        row = BLOCK * block + jnp.arange(-MARGIN - 1, BLOCK + MARGIN + 2)
        values = data[jnp.clip(row, 0, last)].astype(jnp.float32)
        bend = _bend(values, ((row > 0) & (row < last))[:, None, None])
        low, high, bend = jnp.min(values[1:-1], 0), jnp.max(values[1:-1], 0), jnp.max(bend[1:-1], 0)
        each = (low, jnp.minimum), (high, jnp.maximum), (bend, jnp.maximum)
        low, high, bend = (over_blocks(part, of, MARGIN) for part, of in each)
        # inside loops on CPU, XLA's minima and maxima lose NaN
        lost = over_blocks(jnp.any(jnp.isnan(values[1:-1]), 0), jnp.logical_or, MARGIN)
        return low, high, jnp.where(lost, jnp.nan, bend)

    return jax.lax.map(layer, jnp.arange(-(-last // BLOCK)))


def _bend(values: Float[Array, "nx ny nz"], inner: Bool[Array, "nx 1 1"]) -> Float[Array, "nx ny nz"]:
    """The greatest magnitude at each node of ∂²/∂x², ∂²/∂x∂y and their like, in nodes. Those across a face of
    the volume are 0; `inner`: nodes that are not at a face along x."""
    greatest = jnp.zeros_like(values)
    for axis in range(3):
        slope, other = jnp.diff(values, axis=axis), (axis + 1) % 3
        for second, before in ((jnp.diff(slope, axis=axis), 1), (jnp.diff(slope, axis=other), 0)):
            left = [whole - n for whole, n in zip(values.shape, second.shape, strict=True)]
            found = jnp.pad(jnp.abs(second), [(min(before, n), n - min(before, n)) for n in left])
            # rows beyond a face are copies of its own
            greatest = jnp.maximum(
                greatest, jnp.where(inner, found, 0) if (axis, before) == (0, 1) else found
            )
    return greatest
