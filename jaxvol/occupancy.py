"""Where might anything be seen? Ranges of a volume's values, block by block, and what a transfer function
makes of them.

The ranges depend on the volume alone. They are computed once for an array of voxels and kept as long as the
array itself: arrays do not change, so whoever puts another in a volume gets the ranges of that one. Which
blocks are visible depends on the transfer function as well, and is asked anew in every frame, in the
compiled program. Both are conservative: what is called empty is proven to be, and gradients do not see them.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Integer, Shaped, UInt8, UInt32

from ._util.memo import kept
from ._util.sharding import varying
from ._util.vec3 import Vec3
from .volume import Volume


BLOCK = 4
"""Cells of the voxel grid along the side of a block."""

FARTHEST = 255
"""Distances, in blocks, are not told beyond this."""

ROUNDING = 4 * float(jnp.finfo(jnp.float32).eps)
"""By how much interpolation may leave the range of the nodes around, relative to their size."""

Index = tuple[Int[Array, "*batch"], Int[Array, "*batch"], Int[Array, "*batch"]]


class Blocks(eqx.Module):
    """What is in each block of BLOCK³ cells, the nodes on its faces included."""

    low: Float[Array, "bx by bz"]
    high: Float[Array, "bx by bz"]
    labels: UInt32[Array, "bx by bz"] | None
    """Bit `label % 32` is set for every label of the block's nodes."""

    @classmethod
    def of(cls, volume: Volume) -> "Blocks":
        """The blocks of a volume, from memory where its voxels and labels have been seen before."""
        labels = None if volume.labels is None else kept(volume.labels, _label_bits)
        low, high = kept(volume.data, _ranges)
        if volume.field is not None:  # whose values may be other than lie between the voxels
            low, high = jnp.full_like(low, -jnp.inf), jnp.full_like(high, jnp.inf)
        return cls(low, high, labels)

    @property
    def unordered(self) -> Bool[Array, "bx by bz"]:
        """Which blocks hold NaN: nothing is known of them."""
        return ~(self.low <= self.high)

    def may_hold(self, label: int) -> Bool[Array, "bx by bz"]:
        """Which blocks may hold this label."""
        if self.labels is None:
            return jnp.ones(self.low.shape, bool)
        return (self.labels >> (label % 32)) & 1 == 1


class Sums(eqx.Module):
    """How many cells of a grid are occupied in a box of any size, from eight look-ups."""

    table: Int[Array, " entries"]
    shape: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(cls, occupied: Bool[Array, "cx cy cz"]) -> "Sums":
        table = jnp.pad(occupied.astype(jnp.int32), ((1, 0),) * 3)
        for _ in range(3):
            # Sum along the first axis, and put it last. XLA's own cumulative sums are slow windows on CPU.
            _, sums = jax.lax.scan(_add, varying(jnp.zeros_like(table[0]), table), table)
            table = jnp.moveaxis(sums, 0, 2)
        nx, ny, nz = occupied.shape
        return cls(table.reshape(-1), (nx, ny, nz))

    def any_between(self, first: Index, last: Index) -> Bool[Array, "*batch"]:
        """Whether any cell from `first` to `last`, both included and inside the grid, is occupied."""
        _, ny, nz = (n + 1 for n in self.shape)
        x, y, z = (((low, -1), (high + 1, 1)) for low, high in zip(first, last, strict=True))
        count = jnp.zeros((), jnp.int32)
        for i, sign_i in x:
            for j, sign_j in y:
                for k, sign_k in z:
                    entry = self.table.at[(i * ny + j) * nz + k].get(
                        mode="promise_in_bounds", wrap_negative_indices=False
                    )
                    count = count + sign_i * sign_j * sign_k * entry
        return count > 0


class Occupancy(eqx.Module):
    """A regular grid of cells in the world, and which of them may hold anything that is seen.

    What is visible lies in the grid, and in an occupied cell of it.

    - `origin`, `size`: world position of the grid's corner, and world lengths of one cell.
    """

    occupied: Bool[Array, "cx cy cz"]
    origin: Vec3
    size: Vec3

    def sums(self) -> Sums:
        """For questions about boxes."""
        return Sums.of(self.occupied)

    def distance(self) -> UInt8[Array, " cells"]:
        """For each cell, how many cells away the nearest occupied one is, along the axis where it is
        farthest (chessboard distance); 0 in an occupied cell, FARTHEST at most. In row-major order."""

        def spread(grid: Bool[Array, "cx cy cz"]) -> Bool[Array, "cx cy cz"]:
            for axis in range(3):
                padded = jnp.pad(grid, [(1, 1) if i == axis else (0, 0) for i in range(3)])
                n = grid.shape[axis]
                grid = grid | jax.lax.slice_in_dim(padded, 0, n, axis=axis)
                grid = grid | jax.lax.slice_in_dim(padded, 2, n + 2, axis=axis)
            return grid

        def go_on(state: tuple[Array, Array, Array]) -> Array:
            reached, _, rounds = state
            return ~jnp.all(reached) & (rounds < FARTHEST - 1)

        def grow(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            reached, distance, rounds = state
            return spread(reached), distance + (~reached).astype(distance.dtype), rounds + 1

        anything = jnp.any(self.occupied)
        start = self.occupied | ~anything, jnp.zeros(self.occupied.shape, jnp.uint8), jnp.zeros((), jnp.int32)
        _, distance, _ = jax.lax.while_loop(go_on, grow, varying(start))
        return jnp.where(anything, distance, jnp.uint8(FARTHEST)).reshape(-1)

    def cell(self, point: Vec3) -> Vec3:
        """Where a world point lies, counted in cells."""
        x, y, z = ((p - low) / size for p, low, size in zip(point, self.origin, self.size, strict=True))
        return x, y, z


def _add(total: Int[Array, "ny nz"], layer: Int[Array, "ny nz"]) -> tuple[Array, Array]:
    return total + layer, total + layer


@jax.jit
def _ranges(data: Shaped[Array, "nx ny nz"]) -> tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]]:
    low, high = _over_blocks(data, jnp.minimum), _over_blocks(data, jnp.maximum)
    low, high = low.astype(jnp.float32), high.astype(jnp.float32)
    slack = ROUNDING * jnp.maximum(abs(low), abs(high))
    return low - slack, high + slack


@jax.jit
def _label_bits(labels: Integer[Array, "nx ny nz"]) -> UInt32[Array, "bx by bz"]:
    bits = jnp.uint32(1) << (labels.astype(jnp.int32) % 32).astype(jnp.uint32)
    return _over_blocks(bits, jnp.bitwise_or)


def _over_blocks(data: Shaped[Array, "nx ny nz"], combine: Callable) -> Shaped[Array, "bx by bz"]:
    """All nodes of each block combined, axis by axis."""
    for axis in range(3):
        count = -(-(data.shape[axis] - 1) // BLOCK)
        missing = count * BLOCK + 1 - data.shape[axis]
        data = jnp.pad(data, [(0, missing) if i == axis else (0, 0) for i in range(3)], mode="edge")
        parts = [
            jax.lax.slice_in_dim(data, i, i + (count - 1) * BLOCK + 1, BLOCK, axis) for i in range(BLOCK + 1)
        ]
        data = parts[0]
        for part in parts[1:]:
            data = combine(data, part)
    return data
