"""The medium that a volume is: extinction and albedo at a point, and proven bounds of the extinction, without
which Woodcock tracking would be biased."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar, Vec3
from ..lighting.materials import Material, shares
from ..scene.occupancy import BLOCK, Blocks
from ..scene.space import Affine
from ..scene.transfer import Measured, Transfer, classification_of
from ..scene.volume import Volume
from ..xla.memory import gather


Block: TypeAlias = Int[Array, "..."]
"""A block of a volume: the bits of its indices along x, y and z, concatenated into one integer."""


class Majorants(eqx.Module):
    """The majorant of each block, and how far empty space reaches around each empty block.

    - `table`: for each block, its majorant (1/length) if it may have extinction; else minus the chessboard
      distance, in blocks, to the nearest block that may. It has gaps: each axis is padded to a power of 2, so
      that a `Block` is the index of its entry.
    - `last`: grid coordinate of the last node along each axis.
    - `shape`: number of blocks along each axis.
    """

    table: Float[Array, " entries"]
    last: Vec3
    shape: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(
        cls, volume: Volume, blocks: Blocks, transfer: Transfer, materials: tuple[Material, ...] = ()
    ) -> "Majorants":
        """Those of the medium that `Medium.of` makes of a volume, from the volume's blocks."""
        bound = greatest_extinction(transfer, blocks, materials)
        distance = Affine(volume).occupancy(bound > 0).distance().astype(bound.dtype)
        table = jnp.where(bound > 0, bound, -distance.reshape(bound.shape))
        table = jnp.pad(table, [(0, 2 ** _bits(n) - n) for n in bound.shape])
        x, y, z = (jnp.asarray(n - 1, bound.dtype) for n in volume.shape)
        nx, ny, nz = bound.shape
        return cls(table.reshape(-1), (x, y, z), (nx, ny, nz))

    def at(self, block: Block) -> Scalar:
        return gather(self.table, block)

    def block(self, x: Array, y: Array, z: Array) -> Block:
        """The block with these indices along the axes."""
        _, by, bz = (_bits(n) for n in self.shape)
        return (x << (by + bz)) | (y << bz) | z

    def indices(self, block: Block) -> tuple[Array, Array, Array]:
        """Indices of a block along the axes."""
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
        """Clamp the coordinate to a block that rounding may have moved it out of."""
        x, y, z = (
            jnp.clip(c, BLOCK * i.astype(c.dtype), jnp.minimum(BLOCK * (i + 1).astype(c.dtype), last))
            for c, i, last in zip(coordinate, self.indices(block), self.last, strict=True)
        )
        return x, y, z


def _bits(count: int) -> int:
    """Number of bits of the integers below `count`."""
    return (count - 1).bit_length()


def greatest_extinction(
    transfer: Transfer, blocks: Blocks, materials: tuple[Material, ...] = ()
) -> Float[Array, "bx by bz"]:
    """Upper bound of the extinction in each block, 1/length; 0 where nothing is visible. Whatever comes after
    a material that fills the block is ignored. **Raises** `ValueError` for a transfer without a majorant."""
    if type(transfer).majorant is Transfer.majorant:
        raise ValueError(
            f"transfer must have a majorant; {type(transfer).__name__} does not override Transfer.majorant."
        )
    blocks, transfer, materials = jax.lax.stop_gradient((blocks, transfer, materials))
    own = transfer.majorant(blocks)
    bound = jnp.zeros_like(blocks.low)
    open_ = jnp.ones(blocks.low.shape, bool)
    for material in materials:
        may, must = _holds(material, blocks)
        bound = jnp.where(open_ & may, jnp.maximum(bound, 1 / material.mean_free_path), bound)
        open_ &= ~must
    bound = jnp.where(open_, jnp.maximum(bound, own), bound)
    return jnp.where(own > 0, bound, 0)


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


class Medium(NamedTuple):
    """A volume as a medium that scatters and absorbs light.

    - `measure`: reads from memory what is needed at a grid coordinate.
    - `classify`: maps that to extinction (1/length) and single-scattering albedo (r, g, b) in [0, 1].
    - `majorants`: upper bounds of the extinction.
    """

    measure: Callable[[Vec3], Measured]
    classify: Callable[[Measured], tuple[Scalar, Vec3]]
    majorants: Majorants

    @classmethod
    def of(
        cls, volume: Volume, blocks: Blocks, transfer: Transfer, materials: tuple[Material, ...] = ()
    ) -> "Medium":
        """The medium that `path_trace` describes."""
        classification = classification_of(transfer, volume)

        def measure(coordinate: Vec3) -> Measured:
            measured = classification.measure(coordinate)
            if not materials:
                return measured
            return (*shares(materials, volume, coordinate, measured[0]), *measured)

        def classify(measured: Measured) -> tuple[Scalar, Vec3]:
            fractions, measured = measured[: len(materials)], measured[len(materials) :]
            color, extinction = classification.classify(classification.searched(measured))
            kept = jnp.ones_like(extinction)
            visible = extinction > 0
            for share, material in zip(fractions, materials, strict=True):
                here = visible & (share > 0)
                extinction = jnp.where(here, 1 / material.mean_free_path, extinction)
                kept = jnp.where(here, 1 - material.opacity, kept)
            r, g, b = (jnp.clip(c, 0, 1) * kept for c in color)
            return extinction, (r, g, b)

        return cls(measure, classify, Majorants.of(volume, blocks, transfer, materials))
