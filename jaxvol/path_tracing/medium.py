"""A volume as a medium: extinction, albedo, and proven bounds of the extinction, for unbiased tracking."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.vec3 import Scalar, Vec3
from ..lighting.materials import Material, shares
from ..lighting.medium import clipped
from ..scene.occupancy import BLOCK, Blocks
from ..scene.space import Affine
from ..scene.transfer import Measured, Transfer, classification_of
from ..scene.volume import Volume
from ..xla.memory import gather
from .likelihood import OF_IMAGES, Sampling, jumping


DENSEST = 2.0**7
"""Upper bound of the extinction, per voxel. Matter that dense is opaque; if it were denser, only the time
would grow, since flights beside it stop once a mean free path."""

Block: TypeAlias = tuple[Int[Array, "..."], Int[Array, "..."], Int[Array, "..."]]
"""Indices of a block of a volume along x, y and z."""


class Majorants(eqx.Module):
    """Majorants of blocks, and distances from empty blocks to the nearest others.

    Attributes:
        table: for each block, its majorant (1/length) if it may have extinction; else minus the chessboard
            distance, in blocks, to the nearest block that may.
        last: grid coordinate of the last node along each axis.
        empty: majorant of empty blocks (1/length).
        floor: minimum rate at which collisions are drawn (1/length), with weights where it exceeds the
            extinction; None: collisions are drawn at the rate of the extinction.
    """

    table: Float[Array, "bx by bz"]
    last: Vec3
    empty: Scalar | float = 0.0
    floor: Scalar | None = None

    @classmethod
    def of(
        cls,
        volume: Volume,
        blocks: Blocks,
        transfer: Transfer,
        materials: tuple[Material, ...],
        sampling: Sampling,
    ) -> "Majorants":
        """Majorants of the medium of a volume. **Raises** `ValueError` for a transfer without majorant."""
        if type(transfer).majorant is Transfer.majorant:
            name = type(transfer).__name__
            raise ValueError(f"transfer must have a majorant; {name} does not override Transfer.majorant.")
        blocks, transfer, materials = jax.lax.stop_gradient((blocks, transfer, materials))
        majorant, none = transfer.majorant(blocks), jnp.zeros(blocks.shape, bool)
        bound, open_ = jnp.zeros_like(blocks.low), ~none
        for material in materials:  # a material that fills the block hides the next ones
            if material.label is not None:
                may, fills = blocks.may_hold(material.label), none
            elif material.values is None:
                may, fills = ~none, ~none
            else:
                low, high = material.values
                may = (blocks.high >= low) & (blocks.low <= high)
                fills = (blocks.low >= low) & (blocks.high <= high)
            bound = jnp.where(open_ & may, jnp.maximum(bound, 1 / material.mean_free_path), bound)
            open_ &= ~fills
        bound = jnp.where(open_, jnp.maximum(bound, majorant), bound)
        bound = jnp.where(majorant > 0, jnp.minimum(bound, _densest(volume)), 0)
        distance = Affine(volume).occupancy(bound > 0).distance().astype(bound.dtype)
        x, y, z = (jnp.asarray(n - 1, bound.dtype) for n in volume.shape)
        last, distance = (x, y, z), distance.reshape(bound.shape)
        if not sampling.collisions:
            return cls(jnp.where(bound > 0, sampling.margin * bound, -distance), last)
        sides = [n * step for n, step in zip(last, volume.spacing, strict=True)]
        floor = sampling.collisions / jnp.sqrt(sum(side * side for side in sides))
        table = jnp.where(bound > 0, sampling.margin * jnp.maximum(bound, floor), -distance)
        return cls(table, last, sampling.margin * floor, floor)

    def at(self, block: Block) -> Scalar:
        (x, y, z), (_, ny, nz) = block, self.table.shape
        return gather(self.table.reshape(-1), (x * ny + y) * nz + z)

    def majorant(self, entry: Scalar) -> Scalar:
        """The majorant of an entry of the table."""
        return jnp.maximum(entry, self.empty)

    def holding(self, coordinate: Vec3) -> Block:
        """The block nearest to a grid coordinate."""
        x, y, z = (
            jnp.clip(jnp.floor(c / BLOCK).astype(jnp.int32), 0, n - 1)
            for c, n in zip(coordinate, self.table.shape, strict=True)
        )
        return x, y, z

    def within(self, coordinate: Vec3, block: Block) -> Vec3:
        """Clamp a coordinate to its block, beyond which rounding may have moved it."""
        x, y, z = (
            jnp.clip(c, BLOCK * i.astype(c.dtype), jnp.minimum(BLOCK * (i + 1).astype(c.dtype), last))
            for c, i, last in zip(coordinate, block, self.last, strict=True)
        )
        return x, y, z


class Medium(NamedTuple):
    """A volume as a medium that scatters and absorbs light.

    Attributes:
        measure: reads the measurements at a grid coordinate from memory.
        classify: maps measurements to extinction (1/length) and single-scattering albedo (r, g, b) in [0, 1].
        majorants: upper bounds of the extinction.
    """

    measure: Callable[[Vec3], Measured]
    classify: Callable[[Measured], tuple[Scalar, Vec3]]
    majorants: Majorants

    @classmethod
    def of(
        cls,
        volume: Volume,
        blocks: Blocks,
        transfer: Transfer,
        materials: tuple[Material, ...] = (),
        sampling: Sampling = OF_IMAGES,
    ) -> "Medium":
        """The medium that `path_trace` describes."""
        majorants = Majorants.of(volume, blocks, transfer, materials, sampling)
        return cls.within(majorants, volume, transfer, materials)

    @classmethod
    def within(
        cls,
        majorants: Majorants,
        volume: Volume,
        transfer: Transfer,
        materials: tuple[Material, ...],
        jumping: Callable[[Scalar, Array], Scalar] = jumping,
    ) -> "Medium":
        """The medium of known majorants. `jumping`: as in `likelihood`, for the mode of differentiation."""
        classification, densest = classification_of(transfer, volume), _densest(volume)

        def measure(coordinate: Vec3) -> Measured:
            measured = classification.measure(coordinate)
            if not materials:
                return measured
            value = measured[0]

            def labelled(label: int) -> Scalar:
                return (volume.label(coordinate) == label).astype(value.dtype)

            return (*shares(materials, labelled, value), *measured)

        def classify(measured: Measured) -> tuple[Scalar, Vec3]:
            fractions, measured = measured[: len(materials)], measured[len(materials) :]
            color, extinction = classification.classify(classification.searched(measured))
            kept = jnp.ones_like(extinction)
            visible = extinction > 0
            for share, material in zip(fractions, materials, strict=True):
                inside = visible & (share > 0)
                extinction = jumping(extinction, ~visible & (share > 0))
                extinction = jnp.where(inside, 1 / material.mean_free_path, extinction)
                kept = jnp.where(inside, 1 - material.opacity, kept)
            extinction = jnp.minimum(extinction, densest)
            r, g, b = (clipped(c) * kept for c in color)
            return extinction, (r, g, b)

        return cls(measure, classify, majorants)


def _densest(volume: Volume) -> Scalar:
    """Upper bound of the extinction (1/length)."""
    return jax.lax.stop_gradient(DENSEST / jnp.min(volume.spacing))
