"""Conservative search for empty space: ranges of the values in blocks, cached with the voxels, and grids of
occupied cells, computed for each image. Cells marked empty are proven to be. No gradients."""

import itertools
import math
import operator
from collections.abc import Callable
from functools import cache, partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8, UInt32

from .._util.axes import inverse
from .._util.vec3 import Frame, Vec3
from ..xla.memo import memoized
from ..xla.memory import gather, zeros_in_reserve
from ..xla.platform import on_gpu
from ..xla.sharding import varying
from ..xla.trees import unchecked
from .volume import Volume


BLOCK = 4
"""Default number of cells of the voxel grid along the side of a block."""

LAYERS = 8
"""Layers of blocks whose extremes are computed at a time, so that they stay in the cache."""

LENGTHS = 2**19, 2**23, 2**27
"""Lengths of summed-volume tables, few so that programs are shared: for up to 318³, 808³, 2044³ voxels."""

FARTHEST = 255
"""Distance in a grid without occupied cells. Other distances, in cells, are at most one less."""

ROUNDING = 4 * float(jnp.finfo(jnp.float32).eps)
"""Relative error by which interpolation may leave the range of the surrounding nodes."""

Index = tuple[Int[Array, "*batch"], Int[Array, "*batch"], Int[Array, "*batch"]]


class Blocks(eqx.Module):
    """Ranges of the values in each block of `side`³ cells, including the nodes on its faces."""

    low: Float[Array, "*c bx by bz"]
    """Least values; channels along the first axis if there are several."""
    high: Float[Array, "*c bx by bz"]
    labels: UInt32[Array, "bx by bz"] | None
    """Bit `label % 32` is set for each label of the block's nodes."""
    slopes: tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]] | None = None
    """Least and greatest magnitude of the gradient (`Volume.gradient`); None where they are unknown."""
    side: int = eqx.field(static=True, default=BLOCK)

    @classmethod
    def of(cls, volume: Volume, *, slopes: bool = False, side: int = BLOCK) -> "Blocks":
        """The blocks of a volume, computed once for each array; `slopes`: also ranges of gradients."""
        bits, ends = _for(side, _label_bits), _for(side, _ranges)
        labels = (
            None if volume.labels is None else memoized(volume.labels, bits, partial(_label_bits, side=side))
        )
        low, high = memoized(volume.data, ends, partial(_ranges_in_numpy, side=side))
        low, high = map(volume.in_grid_order, (low, high))
        if volume.field is not None:  # values of a field may exceed those of the voxels
            low, high = jnp.full_like(low, -jnp.inf), jnp.full_like(high, jnp.inf)
        known = slopes and volume.field is None
        return cls(low, high, labels, _magnitudes(volume, side) if known else None, side)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of blocks along x, y, z."""
        return self.low.shape[-3:]

    @property
    def unordered(self) -> Bool[Array, "bx by bz"]:
        """Blocks that hold NaN, as a value or a slope."""
        unordered = ~(self.low <= self.high)
        if unordered.ndim > 3:
            unordered = jnp.any(unordered, axis=0)
        low, high = self.magnitudes
        return unordered | ~(low <= high)

    @property
    def magnitudes(self) -> tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]]:
        """`slopes`, or 0 to infinity where they are unknown."""
        if self.slopes is None:
            unknown = jnp.zeros(self.shape, self.low.dtype)
            return unknown, unknown + jnp.inf
        return self.slopes

    def may_hold(self, label: int) -> Bool[Array, "bx by bz"]:
        """Blocks that may hold a label."""
        if self.labels is None:
            return jnp.ones(self.shape, bool)
        return (self.labels >> (label % 32)) & 1 == 1


class Sums(eqx.Module):
    """A summed-volume table: the number of occupied cells in any box of a grid, by eight look-ups."""

    table: Int[Array, " entries"]
    """Entries of the grid with one more cell on each axis, then padding."""
    sizes: Int[Array, "3"] | np.ndarray
    """Number of cells along x, y, z."""

    @classmethod
    def of(cls, occupied: Bool[Array, "cx cy cz"] | np.ndarray) -> "Sums":
        """The table of a grid, computed in NumPy for a NumPy array."""
        sizes = np.asarray(occupied.shape, np.int32)
        if isinstance(occupied, np.ndarray):
            shape = tuple(n + 1 for n in occupied.shape)
            count = math.prod(shape)
            length = next(n for n in LENGTHS if n >= count) if count <= LENGTHS[-1] else count
            table = zeros_in_reserve(length, np.int32)
            entries = table[:count].reshape(shape)
            entries[1:, 1:, 1:] = occupied
            for axis in range(3):
                np.cumsum(entries, axis=axis, out=entries)
            return cls(jax.device_put(table), sizes)
        table = jnp.pad(occupied.astype(jnp.int32), ((1, 0),) * 3)
        for axis in range(3):
            if on_gpu():  # a loop launches a kernel for each layer
                table = jnp.cumsum(table, axis=axis, dtype=jnp.int32)
                continue
            # sums along the first axis, and moves it to the end; XLA's own cumulative sums are slow on CPU
            start = varying(jnp.zeros_like(table[0]), table)
            _, sums = jax.lax.scan(lambda total, layer: (total + layer,) * 2, start, table)
            table = jnp.moveaxis(sums, 0, 2)
        return cls(table.reshape(-1), sizes)

    def any_between(self, first: Index, last: Index) -> Bool[Array, "*batch"]:
        """True if any cell from `first` to `last` is occupied, both inclusive and inside the grid."""
        ny, nz = self.sizes[1] + 1, self.sizes[2] + 1
        x, y, z = (((low, -1), (high + 1, 1)) for low, high in zip(first, last, strict=True))
        count = jnp.zeros((), jnp.int32)
        for (i, sign_i), (j, sign_j), (k, sign_k) in itertools.product(x, y, z):
            count = count + sign_i * sign_j * sign_k * gather(self.table, (i * ny + j) * nz + k)
        return count > 0


class Occupancy(eqx.Module):
    """A regular grid of cells. Everything visible lies in an occupied cell."""

    occupied: Any
    """(cx, cy, cz), booleans; None in an `unshaped` grid."""
    origin: Vec3
    """Corner of the grid, along the axes of `frame`, relative to `anchor`."""
    size: Vec3
    """Side lengths of a cell."""
    frame: Frame = Frame()
    anchor: Vec3 | None = None
    """`Space.anchor`."""
    known: UInt8[Array, " cells"] | None = None
    """`distance`, if already computed."""
    sizes: Int[Array, "3"] | np.ndarray | None = None
    """Number of cells along x, y, z, where it is traced."""

    @property
    def unshaped(self) -> "Occupancy":
        """The grid without `occupied`, and with a traced number of cells."""
        return unchecked(self, occupied=None, sizes=np.asarray(self.shape, np.int32))

    @property
    def shape(self) -> tuple[Any, Any, Any]:
        """Number of cells along x, y, z."""
        if self.occupied is None:
            assert self.sizes is not None
            return self.sizes[0], self.sizes[1], self.sizes[2]
        nx, ny, nz = self.occupied.shape
        return nx, ny, nz

    def distance(self) -> UInt8[Array, " cells"]:
        """Chessboard distance of each cell to the nearest occupied one, in cells, in row-major order."""
        if self.known is not None:
            return self.known
        distance = jnp.where(self.occupied, 0, FARTHEST - 1).astype(jnp.uint8)
        for axis in (2, 1, 0):  # exact: a shortest way may take its steps along the later axes last
            planes = varying(jnp.moveaxis(distance, axis, 0))
            for backwards in (False, True):
                step = partial(_one_further, range(axis, 2))
                _, planes = jax.lax.scan(step, planes[-1 if backwards else 0], planes, reverse=backwards)
            distance = jnp.moveaxis(planes, 0, axis)
        return jnp.where(jnp.any(self.occupied), distance, jnp.uint8(FARTHEST)).reshape(-1)

    def cell(self, point: Vec3) -> Vec3:
        """Coordinate in the grid, in cells, of a point relative to `anchor`."""
        point = self.frame.components(point)
        x, y, z = ((p - low) / size for p, low, size in zip(point, self.origin, self.size, strict=True))
        return x, y, z


def _one_further(across: range, before: Array, plane: Array) -> tuple[Array, Array]:
    """Distances in a plane from those of the previous plane, with diagonal steps along the axes `across`."""
    for axis in across:
        widths, n = [(1, 1) if i == axis else (0, 0) for i in range(plane.ndim)], plane.shape[axis]
        padded = jnp.pad(before, widths, constant_values=FARTHEST)
        sides = (jax.lax.slice_in_dim(padded, i, i + n, axis=axis) for i in (0, 2))
        before = reduce(jnp.minimum, sides, before)
    plane = jnp.minimum(plane, jnp.minimum(before, FARTHEST - 2) + jnp.uint8(1))
    return plane, plane


@cache
def _for(side: int, compute: Callable[..., Any]) -> Callable[..., Any]:
    """`compute` for blocks of this side, compiled; always the same object, as `memoized` requires."""
    return jax.jit(partial(compute, side=side))


def _ranges(data: Shaped[Array, "nx ny nz *c"], side: int) -> tuple[Array, Array]:
    return widened(*_extremes(data, side))


def _ranges_in_numpy(data: Shaped[np.ndarray, "nx ny nz *c"], side: int) -> tuple[np.ndarray, np.ndarray]:
    low, high = (over_blocks(data, combine, side=side) for combine in (np.minimum, np.maximum))
    return _widened(low, high, np)


def _extremes(data: Shaped[Array, "nx ny nz *c"], side: int) -> tuple[Array, Array]:
    """Least and greatest node of each block; NaN where a node is NaN."""

    def ends_of(nodes: Array) -> tuple[Array, Array]:
        return over_blocks(nodes, jnp.minimum, side=side), over_blocks(nodes, jnp.maximum, side=side)

    count = (data.shape[0] - 1) // side
    if count == 0 or jnp.issubdtype(data.dtype, jnp.inexact):
        return ends_of(data)  # inside loops on CPU, XLA's minima and maxima lose NaN
    begins = side * jnp.arange(count)
    layers = jax.lax.map(
        lambda x: ends_of(jax.lax.dynamic_slice_in_dim(data, x, side + 1)), begins, batch_size=LAYERS
    )
    parts = [jax.tree.map(lambda layer: layer[:, 0], layers)]
    if count * side < data.shape[0] - 1:
        parts.append(ends_of(data[count * side :]))
    low, high = (jnp.concatenate(ends) for ends in zip(*parts, strict=True))
    return low, high


def _widened(low: Any, high: Any, xp: Any) -> tuple[Any, Any]:
    """Ranges of interpolated values, channels first, from those of the nodes."""
    low, high = low.astype(np.float32), high.astype(np.float32)
    slack = ROUNDING * xp.maximum(abs(low), abs(high))
    low, high = low - slack, high + slack
    return (low, high) if low.ndim == 3 else (xp.moveaxis(low, -1, 0), xp.moveaxis(high, -1, 0))


widened = jax.jit(partial(_widened, xp=jnp))


def _slope_ranges(data: Shaped[Array, "nx ny nz"], side: int) -> tuple[Array, Array, Array]:
    """Least and greatest slope along each axis of the array, and greatest gradient length, per node, by block
    (layer by layer, to save memory)."""
    last = data.shape[0] - 1

    def layer(block: Int[Array, ""]) -> tuple[Array, Array, Array]:
        node = jnp.clip(side * block + jnp.arange(side + 1), 0, last)
        # subtracted in their own type: doubles that differ little are the same in single precision
        dtype = data.dtype if data.dtype == jnp.float64 else jnp.float32
        before, middle, after = (data[jnp.clip(node + step, 0, last)].astype(dtype) for step in (-1, 0, 1))
        border = ((node == 0) | (node == last))[:, None, None]
        along_x = (after - before) * jnp.where(border, 1, 0.5).astype(dtype)
        slopes = jnp.stack([along_x, *jnp.gradient(middle, axis=(1, 2))]).astype(jnp.float32)
        blocks = partial(over_blocks, side=side)
        square = blocks(jnp.max(jnp.sum(slopes**2, axis=0), axis=0), jnp.maximum)
        low = jax.vmap(lambda part: blocks(part, jnp.minimum))(jnp.min(slopes, axis=1))
        high = jax.vmap(lambda part: blocks(part, jnp.maximum))(jnp.max(slopes, axis=1))
        # inside loops on CPU, XLA's minima and maxima lose NaN
        lost = blocks(jnp.any(jnp.isnan(slopes), axis=(0, 1)), jnp.logical_or)
        slack = ROUNDING * jnp.maximum(jnp.abs(low), jnp.abs(high))
        steepest = jnp.sqrt(square) * (1 + ROUNDING)
        low, high = (jnp.where(lost, jnp.nan, end) for end in (low - slack, high + slack))
        return low, high, steepest

    low, high, steepest = jax.lax.map(layer, jnp.arange(-(-last // side)))
    return jnp.moveaxis(low, 0, 1), jnp.moveaxis(high, 0, 1), steepest


def _magnitudes(volume: Volume, side: int) -> tuple[Array, Array]:
    """Least and greatest magnitude of the gradient in each block, in value units per world length."""
    low, high, steepest = map(volume.in_grid_order, memoized(volume.data, _for(side, _slope_ranges)))
    low, high = (jnp.stack([part[axis] for axis in inverse(volume.fetch.axes)]) for part in (low, high))
    place = jax.lax.stop_gradient((volume.spacing, volume.direction))
    return _lengths(low, high, steepest, *jax.tree.map(lambda leaf: leaf.astype(low.dtype), place))


@jax.jit
def _lengths(
    low: Array, high: Array, steepest: Array, spacing: Array, direction: Array | None
) -> tuple[Array, Array]:
    lower = upper = jnp.zeros_like(steepest)
    for begin, end, step in zip(low, high, spacing, strict=True):  # XLA's sum over axis 0 is slow on CPU
        begin, end = begin / step, end / step
        lower += jnp.maximum(jnp.maximum(begin, -end), 0) ** 2  # 0 where slopes change sign
        upper += jnp.maximum(-begin, end) ** 2
    upper = jnp.minimum(jnp.sqrt(upper), steepest / jnp.min(spacing)) * (1 + ROUNDING)
    if direction is not None:
        # slopes along sheared axes bound the length only up to this factor (Gershgorin's discs)
        gram = jnp.sum(direction[:, :, None] * direction[:, None, :], axis=0)
        shear = jnp.max(jnp.sum(jnp.abs(gram - jnp.eye(3, dtype=gram.dtype)), axis=1))
        lower = lower / (1 + shear)
        upper = jnp.where(shear < 1, upper / jnp.sqrt(jnp.where(shear < 1, 1 - shear, 1)), jnp.inf)
    return jnp.sqrt(lower) * (1 - ROUNDING), jnp.where(jnp.any(~(low <= high), axis=0), jnp.nan, upper)


def _label_bits(labels: Any, side: int) -> Any:
    bits = np.uint32(1) << (labels.astype(np.int32) % 32).astype(np.uint32)
    return over_blocks(bits, operator.or_, side=side)


def over_blocks(values: Array | np.ndarray, combine: Callable[[Any, Any], Any], *, side: int) -> Any:
    """Combine all nodes of each block, axis by axis, in the library of the array."""
    known = isinstance(values, np.ndarray)
    join, part = (np.concatenate, _part) if known else (jnp.concatenate, jax.lax.slice_in_dim)
    for axis in range(min(values.ndim, 3)):  # channels stay
        cells = values.shape[axis] - 1
        layers = partial(part, values, axis=axis)
        # the last block may be shorter; padding would copy the nodes
        count, remainder = divmod(cells, side)
        blocks = []
        if count:
            length, nodes = (count - 1) * side + 1, range(side + 1)
            blocks.append(reduce(combine, [layers(i, i + length, side) for i in nodes]))
        if remainder:
            blocks.append(reduce(combine, [layers(i, i + 1) for i in range(count * side, cells + 1)]))
        values = join(blocks, axis)
    return values


def _part(values: np.ndarray, start: int, end: int, step: int = 1, *, axis: int) -> np.ndarray:
    return values[(slice(None),) * axis + (slice(start, end, step),)]
