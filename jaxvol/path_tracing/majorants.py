"""How dense is a medium at most? A bound of the extinction for each block of a volume.

Woodcock tracking is unbiased only where its majorant is nowhere below the extinction. So these are proven:
interpolation never leaves the range of a block's nodes, and a piecewise linear function is greatest at an
end of a range of values, or at a control point inside. Rounding is allowed for on top.
"""

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar, Vec3
from ..labels import LabelTransferFunction
from ..lighting.materials import Material
from ..occupancy import BLOCK, Blocks
from ..space import Affine
from ..transfer import Transfer, TransferFunction, points_below
from ..volume import Volume


ROUNDING = 32 * float(jnp.finfo(jnp.float32).eps)
"""By how much an interpolated extinction may exceed its bound, relative to the greatest of its table."""

Block: TypeAlias = Int[Array, "..."]
"""A block of a volume: the bits of its index along x, y and z after each other, in one whole number."""


class Majorants(eqx.Module):
    """The bound of each block, and how far empty space reaches around a block without extinction.

    - `table`: by block; the majorant (1/length) where there may be extinction. Elsewhere minus the chessboard
      distance, in blocks, to the nearest block where there may be. It has gaps: each axis counts to a power
      of 2, so that a block's index is its entry's.
    - `last`: grid coordinate of the last node along each axis.
    - `shape`: how many blocks there are along each axis.
    """

    table: Float[Array, " entries"]
    last: Vec3
    shape: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(
        cls, volume: Volume, blocks: Blocks, transfer: Transfer, materials: tuple[Material, ...] = ()
    ) -> "Majorants":
        """The majorants of a volume's medium, as `Medium` has it, from the volume's blocks.

        **Raises:** `ValueError` for a transfer function of a kind that has no bound here.
        """
        bound = greatest_extinction(transfer, blocks, materials)
        distance = Affine(volume).occupancy(bound > 0).distance().astype(bound.dtype)
        table = jnp.where(bound > 0, bound, -distance.reshape(bound.shape))
        table = jnp.pad(table, [(0, 2 ** _bits(n) - n) for n in bound.shape])
        x, y, z = (jnp.asarray(n - 1, bound.dtype) for n in volume.shape)
        nx, ny, nz = bound.shape
        return cls(table.reshape(-1), (x, y, z), (nx, ny, nz))

    def at(self, block: Block) -> Scalar:
        """The entry of a block in the table."""
        return self.table.at[block].get(mode="promise_in_bounds", wrap_negative_indices=False)

    def block(self, x: Array, y: Array, z: Array) -> Block:
        """The block of these indices along the axes."""
        _, by, bz = (_bits(n) for n in self.shape)
        return (x << (by + bz)) | (y << bz) | z

    def indices(self, block: Block) -> tuple[Array, Array, Array]:
        """The indices of a block along the axes."""
        _, by, bz = (_bits(n) for n in self.shape)
        return block >> (by + bz), (block >> bz) & (2**by - 1), block & (2**bz - 1)

    def holding(self, coordinate: Vec3) -> Block:
        """The block that holds a grid coordinate, or the nearest one."""
        return self.block(
            *(
                jnp.clip(jnp.floor(c / BLOCK).astype(jnp.int32), 0, n - 1)
                for c, n in zip(coordinate, self.shape, strict=True)
            )
        )

    def within(self, coordinate: Vec3, block: Block) -> Vec3:
        """The coordinate, put back into a block that rounding may have moved it out of."""
        x, y, z = (
            jnp.clip(c, BLOCK * i.astype(c.dtype), jnp.minimum(BLOCK * (i + 1).astype(c.dtype), last))
            for c, i, last in zip(coordinate, self.indices(block), self.last, strict=True)
        )
        return x, y, z


def _bits(count: int) -> int:
    """Bits of the numbers below `count`."""
    return (count - 1).bit_length()


def greatest_extinction(
    transfer: Transfer, blocks: Blocks, materials: tuple[Material, ...] = ()
) -> Float[Array, "bx by bz"]:
    """A bound of the extinction in each block, 1/length; 0 where nothing is visible.

    Where a block may hold a material, its 1/λ counts; what comes after a material that fills the block does
    not. It carries no gradient.
    """
    blocks, transfer, materials = jax.lax.stop_gradient((blocks, transfer, materials))
    bound = jnp.zeros_like(blocks.low)
    open_ = jnp.ones(blocks.low.shape, bool)
    for material in materials:
        may, must = _holds(material, blocks)
        bound = jnp.where(open_ & may, jnp.maximum(bound, 1 / material.mean_free_path), bound)
        open_ &= ~must
    bound = jnp.where(open_, jnp.maximum(bound, _of_transfer(transfer, blocks)), bound)
    return jnp.where(transfer.visible(blocks), bound, 0)


def _holds(material: Material, blocks: Blocks) -> tuple[Bool[Array, "bx by bz"], Bool[Array, "bx by bz"]]:
    """Whether a block may hold a material, and whether it holds nothing else."""
    if material.label is not None:
        may = blocks.may_hold(material.label)
        return may, jnp.zeros_like(may)
    if material.values is None:
        everywhere = jnp.ones(blocks.low.shape, bool)
        return everywhere, everywhere
    low, high = material.values
    return (blocks.high >= low) & (blocks.low <= high), (blocks.low >= low) & (blocks.high <= high)


def _of_transfer(transfer: Transfer, blocks: Blocks) -> Float[Array, "bx by bz"]:
    if isinstance(transfer, TransferFunction):
        return greatest_between(transfer.values, transfer.extinction, blocks.low, blocks.high)
    if isinstance(transfer, LabelTransferFunction):
        bound, each = jnp.zeros_like(blocks.low), transfer.stacked
        for label in range(each.values.shape[0] - 1):
            inside = greatest_between(each.values[label], each.extinction[label], blocks.low, blocks.high)
            bound = jnp.where(blocks.may_hold(label), jnp.maximum(bound, inside), bound)
        return bound
    raise ValueError(
        "transfer must be a TransferFunction or a LabelTransferFunction, whose greatest extinction is known; "
        f"got {type(transfer).__name__}."
    )


def greatest_between(
    values: Float[Array, " n"],
    extinction: Float[Array, " n"],
    low: Float[Array, "*blocks"],
    high: Float[Array, "*blocks"],
) -> Float[Array, "*blocks"]:
    """A bound of the piecewise linear extinction from `low` to `high`, rounding included."""
    low, high = low.astype(values.dtype), high.astype(values.dtype)
    ends = jnp.maximum(jnp.interp(low, values, extinction), jnp.interp(high, values, extinction))
    first, end = points_below(values, low, strictly=True), points_below(values, high)
    inside = _greatest_of_range(extinction, first, end)
    return jnp.maximum(ends, inside) + ROUNDING * extinction.max()


def _greatest_of_range(
    entries: Float[Array, " n"], first: Int[Array, "*batch"], end: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """The greatest entry from `first` to before `end`; 0 of none. Two look-ups among the greatest of all
    runs whose length is a power of two."""
    runs, length = [entries], 1
    while 2 * length <= entries.shape[0]:
        shorter = runs[-1]
        runs.append(jnp.maximum(shorter, jnp.concatenate([shorter[length:], shorter[-length:]])))
        length *= 2
    table, n = jnp.stack(runs), entries.shape[0]
    count = end - first
    level = sum((count >= 2**k).astype(jnp.int32) for k in range(1, len(runs)))
    level = jnp.broadcast_to(level, count.shape)
    left = table[level, jnp.clip(first, 0, n - 1)]
    right = table[level, jnp.clip(end - 2**level, 0, n - 1)]
    return jnp.where(count > 0, jnp.maximum(left, right), 0)
