"""Access to the voxels around a coordinate: one by one, from packed words, or recording each fetch."""

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._util.axes import XYZ, Axes, inverse, permuted
from .._util.vec3 import Scalar, Vec3
from ..xla.memory import gather, in_memory, without_zeros
from ..xla.platform import gathers_are_fast, on_gpu


T = TypeVar("T")

Voxels: TypeAlias = Any
"""An array (nx, ny, nz) or (nx, ny, nz, channels); None if a `Packed` copy replaces it."""

DType: TypeAlias = np.dtype[Any]

Voxel: TypeAlias = Any
"""A number, or a tuple of numbers for several channels."""

Cube: TypeAlias = list[list[list[Voxel]]]
"""Eight voxels, [x][y][z]."""

Node: TypeAlias = tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]
"""Indices along x, y, z."""

SLOPE_BITS = 10
"""Bits of a doubled slope of 8-bit voxels, an integer between -510 and 510."""


class Window(eqx.Module):
    """The box of a grid that is in memory. Coordinates outside read its faces."""

    first: Int[Array, "3"]
    """Node at which the box begins, along x, y, z."""
    nodes: tuple[int, int, int] = eqx.field(static=True)
    """Number of nodes of the grid along x, y, z."""
    axes: Axes = eqx.field(static=True)
    """Order of the array's axes in memory: (2, 1, 0) for data[z, y, x]."""


class Fetch(eqx.Module):
    """Access to voxels of the full grid, or of a `window` of it, in memory."""

    window: Window | None = eqx.field(default=None, kw_only=True)
    steady: bool = eqx.field(default=False, kw_only=True, static=True)
    """Whether node and fractions are stored in memory in forward-mode derivatives. Otherwise XLA recomputes
    them for each use, and may round a coordinate on a plane of nodes to either side, so that the fractions
    of one node are combined with the voxels of another. It takes 1 to 4 % of a gradient."""
    changes: UInt32[Array, " nodes"] | None = eqx.field(default=None, kw_only=True)
    """Directions from each node in which labels change (`engine.acceleration.changes_of`), if known."""

    @abstractmethod
    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        """The cube of eight voxels that begins at a flat index, along the array's axes."""

    def place(self, data: Voxels, coordinate: Vec3) -> tuple[Int[Array, ""], Vec3]:
        """The node of the array below a grid coordinate, as a flat index, and the fractions past it."""
        node, fraction = self.split(data, coordinate)
        return flat_index(node, self._stored(data)), fraction

    def _always(self, data: Voxels) -> Bool[Array, ""] | None:
        """The condition for `in_memory`; None for fetches that store nothing in memory."""
        return None

    @property
    def axes(self) -> Axes:
        """Order of the array's axes (`Window.axes`)."""
        return XYZ if self.window is None else self.window.axes

    def cube(self, data: Voxels, coordinate: Vec3) -> tuple[Cube, Vec3]:
        """The eight voxels around a grid coordinate, and its fractional position between them."""
        place, always = partial(self.place, data), self._always(data)
        if always is None or on_gpu() or gathers_are_fast() or self.steady:
            base, fraction = place(coordinate)
        else:
            # In memory, since on processors with slow gathers LLVM does not vectorize code that fetches
            # voxels: node and fractions would take two fifths of a fetch.
            base, fraction = in_memory(always, place, coordinate)
        return transposed(self.cube_from(data, base, coordinate[0].dtype), self.axes), fraction

    def interpolated(self, data: Voxels, coordinate: Vec3) -> Voxel:
        """Trilinear interpolation at a grid coordinate."""
        return trilinear(*self.cube(data, coordinate))

    def _stored(self, data: Voxels) -> tuple[Any, ...]:
        """Numbers of voxels along the axes of the array."""
        return data.shape

    def shape(self, data: Voxels) -> tuple[Any, Any, Any]:
        """Number of nodes of the grid."""
        if self.window is not None:
            return self.window.nodes
        nx, ny, nz = data.shape[:3]
        return nx, ny, nz

    def split(self, data: Voxels, coordinate: Vec3) -> tuple[Node, Vec3]:
        """The node of the array below a grid coordinate, along its axes, and the fractions past it, along
        x, y, z."""
        always = self._always(data)
        if self.steady and always is not None:
            node, fraction = _steady_split(coordinate, always, self.shape(data))
        else:
            node, fraction = split(coordinate, self.shape(data))
        if self.window is None:
            return node, fraction
        # integers are shifted, so that the fractions are those of the full grid
        past = [node[axis] - self.window.first[axis] for axis in self.axes]
        i, j, k = (jnp.clip(index, 0, n - 2) for index, n in zip(past, data.shape[:3], strict=True))
        return (i, j, k), fraction

    def nearest(self, data: Voxels, coordinate: Vec3) -> Int[Array, ""]:
        """Flat index of the node nearest to a grid coordinate; -1 outside the grid."""
        node, inside = [jnp.floor(c + 0.5).astype(jnp.int32) for c in coordinate], jnp.array(True)
        for index, n in zip(node, self.shape(data), strict=True):
            inside &= (index >= 0) & (index < n)
        if self.window is not None:
            past = [node[axis] - self.window.first[axis] for axis in self.axes]
            node = [jnp.clip(index, 0, n - 1) for index, n in zip(past, data.shape, strict=True)]
        return jnp.where(inside, flat_index((node[0], node[1], node[2]), data.shape), -1)

    def of_slopes_at(self, begin: Int[Array, ""]) -> "Fetch":
        """A fetch for one call of `slopes`, at the node of flat index `begin`: XLA computes the index on one
        thread unless it comes from memory."""
        return self

    def slopes(self, data: Voxels, coordinate: Vec3) -> Vec3:
        """Slopes along x, y and z at a grid coordinate, in value units per node (`Volume.gradient`)."""
        node, fraction = self.split(data, coordinate)
        slopes = [self._slopes_of_nodes(data, node, axis, coordinate[0].dtype) for axis in range(3)]
        return self._interpolated_slopes(slopes, fraction)

    def _interpolated_slopes(self, slopes: list[Cube], fraction: Vec3) -> Vec3:
        """Slopes along x, y and z, from the slopes of eight nodes along the array's axes."""
        interpolated = [trilinear(transposed(cube, self.axes), fraction) for cube in slopes]
        return permuted(interpolated, inverse(self.axes))

    def _slopes_of_nodes(self, data: Voxels, node: Node, axis: int, dtype: DType) -> Cube:
        """Slopes along an axis of the array at the eight nodes that begin at `node`."""

        def neighbours(offset: int) -> Cube:
            at = list(node)
            at[axis] = jnp.clip(node[axis] + offset, 0, self._stored(data)[axis] - 2)
            base = flat_index((at[0], at[1], at[2]), self._stored(data))
            return _with_first(axis, self.cube_from(data, base, dtype))

        def slope(one_sided: Bool[Array, ""], before: Scalar, after: Scalar) -> Scalar:
            return (after - before) * jnp.where(one_sided, 1, 0.5).astype(dtype)

        # At the border a cube begins with the first node, or ends with the last one.
        first, last = node[axis] == 0, node[axis] == self._stored(data)[axis] - 2
        (a, b), (c, d) = neighbours(-1), neighbours(1)
        b = jax.tree.map(partial(jnp.where, first), a, b)
        c = jax.tree.map(partial(jnp.where, last), d, c)
        lower, upper = jax.tree.map(partial(slope, first), a, c), jax.tree.map(partial(slope, last), b, d)
        return _with_first(axis, [lower, upper])


def cube_of(voxel: Callable[[int, int, int], T]) -> list[list[list[T]]]:
    """The cube of `voxel(x, y, z)` for x, y and z of 0 and 1."""
    return [[[voxel(x, y, z) for z in (0, 1)] for y in (0, 1)] for x in (0, 1)]


def transposed(cube: Cube, axes: Axes) -> Cube:
    """The cube along x, y, z of a cube whose axes are in the order `axes`."""
    a, b, c = axes
    return cube_of(lambda *at: cube[at[a]][at[b]][at[c]])


def _with_first(axis: int, cube: Cube) -> Cube:
    """The cube with an axis and the first one exchanged."""
    return transposed(cube, ((0, 1, 2), (1, 0, 2), (2, 1, 0))[axis])


def trilinear(cube: Cube, fraction: Vec3) -> Voxel:
    """Trilinear interpolation of a cube."""

    def mix(f: Scalar, a: Voxel, b: Voxel) -> Voxel:
        return jax.tree.map(lambda a, b: a * (1 - f) + b * f, a, b)  # exactly a and b at the ends

    fx, fy, fz = fraction
    (y0, y1), (y2, y3) = ((mix(fz, *row) for row in plane) for plane in cube)
    return mix(fx, mix(fy, y0, y1), mix(fy, y2, y3))


class Extent(Fetch):
    """The number of nodes of a grid without voxels, whose values come from a field."""

    nodes: tuple[int, int, int] = eqx.field(static=True)

    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        raise ValueError("volume has no voxels to interpolate; read the volumes of its field.")

    def shape(self, data: Voxels) -> tuple[int, int, int]:
        return self.nodes


class Nodes(Fetch):
    """The traced number of nodes of a grid without voxels."""

    counts: Int[Array, "3"] | np.ndarray

    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        raise ValueError("volume has no voxels here.")

    def shape(self, data: Voxels) -> tuple[Any, Any, Any]:
        return self.counts[0], self.counts[1], self.counts[2]


class OneByOne(Fetch):
    """Separate fetches of the eight voxels."""

    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        return voxels_from(data, base, dtype)

    def _always(self, data: Voxels) -> Bool[Array, ""]:
        return abs(data.reshape(-1)[0].astype(jnp.float32)) + 1 != 0


class Zeros(Fetch):
    """Zeros in place of the voxels, to detect other uses of them."""

    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        return cube_of(lambda *_: _zero_voxel(data, (), dtype))


class Packed(Fetch):
    """Fetches from a packed copy of the voxels: half or a quarter as many for integers. No other array is
    read, so that kernels do not depend on the shape of the volume (`engine.acceleration.unshaped`)."""

    words: UInt32[Array, " words"] | Float[Array, " words"]
    """Words of packed integers, at least as many as voxels; or floats."""
    nodes: UInt32[Array, " words"] | None = None
    """Doubled slopes of each node of 8-bit voxels, 10 bits each: x in the highest, y from bit 12 on."""
    begin: Int[Array, ""] | None = None
    sizes: Int[Array, "3"] | np.ndarray | None = None
    """Number of nodes along x, y, z; None: that of the voxels."""
    kind: str | None = eqx.field(static=True, default=None)
    """Type of the voxels; None: that of the array."""

    def shape(self, data: Voxels) -> tuple[Any, Any, Any]:
        if self.sizes is None:
            return super().shape(data)
        return self.sizes[0], self.sizes[1], self.sizes[2]

    def of_slopes_at(self, begin: Int[Array, ""]) -> "Packed":
        return replace(self, begin=begin)

    def _always(self, data: Voxels) -> Bool[Array, ""]:
        return abs(self.words[0].astype(jnp.float32)) + 1 != 0

    def split(self, data: Voxels, coordinate: Vec3) -> tuple[Node, Vec3]:
        if self.steady or self.window is not None:
            return super().split(data, coordinate)
        return split(coordinate, self.shape(data), bounded=False)

    def _stored(self, data: Voxels) -> tuple[Any, ...]:
        return data.shape if self.sizes is None else self.shape(data)

    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        _, ny, nz = self._stored(data)
        kind = np.dtype(data.dtype if self.kind is None else self.kind)
        bits, signed = 8 * kind.itemsize, kind.kind == "i"
        if kind.kind == "f":
            return cube_of(lambda x, y, z: _word(self.words, base + (x * ny + y) * nz + z).astype(dtype))

        def voxel(word: Int[Array, ""], number: int) -> Scalar:
            if signed:  # shifting down from the top bits extends the sign
                return (word << (32 - bits * (number + 1)) >> (32 - bits)).astype(dtype)
            return (word >> (bits * number) & (2**bits - 1)).astype(dtype)

        def row(flat: Int[Array, ""]) -> list[list[Scalar]]:
            fetched = [flat] if bits == 8 else [flat, flat + nz]
            # converted, or XLA would repeat the fetch for each use
            words = [_word(self.words, index).astype(jnp.int32) for index in fetched]
            a, b, c, d = (voxel(word, number) for word in words for number in range(32 // bits))
            return [[a, b], [c, d]]

        return [row(base), row(base + ny * nz)]

    def slopes(self, data: Voxels, coordinate: Vec3) -> Vec3:
        nodes = self.nodes
        if nodes is None:
            return super().slopes(data, coordinate)
        base, fraction = self.place(data, coordinate)
        base = base if self.begin is None else self.begin
        dtype = coordinate[0].dtype
        _, ny, nz = self._stored(data)
        shift = 32 - SLOPE_BITS

        def words_from(base: Int[Array, ""]) -> Cube:
            return cube_of(lambda x, y, z: _word(nodes, base + (x * ny + y) * nz + z).astype(jnp.int32))

        # in memory, for the reason of `cube`
        words = (
            words_from(base)
            if on_gpu() or gathers_are_fast()
            else in_memory(self._always(data), words_from, base)
        )

        def slope(bits: int, word: Int[Array, ""]) -> Scalar:
            """The slope that begins `bits` below the highest bit, times a power of two."""
            return ((word << bits) & -(1 << shift)).astype(dtype)

        slopes = [jax.tree.map(partial(slope, bits), words) for bits in (0, SLOPE_BITS, shift)]
        x, y, z = self._interpolated_slopes(slopes, fraction)
        factor = 2.0 ** -(shift + 1)
        return x * factor, y * factor, z * factor


def _word(words: Array, index: Int[Array, ""]) -> Array:
    """The word at an index, or any word if the index is out of range."""
    # XLA clamps an index by comparisons of 64 bits, a quarter of a fetch. LLVM omits them if it can prove the
    # range: by static shapes, or by this mask.
    return gather(words, index & ((1 << (words.size - 1).bit_length()) - 1))


class Fetched(NamedTuple):
    """Record of a fetch of eight voxels: flat index of the first one, and the fractions along the array's
    axes if they were interpolated."""

    base: Int[Array, "..."]
    fraction: Vec3 | None = None


class Recording(Fetch):
    """A record of all fetches, so that a VJP returns one cotangent per fetch, of a cube of voxels or of the
    interpolated value. Voxels must be constants of that VJP."""

    perturbations: list[Any]
    """Terms added to the fetched values, in order of the fetches; empty: none."""
    fetched: list[Fetched] = eqx.field(static=True)
    """The record, filled while tracing."""
    state: Any = eqx.field(static=True, default_factory=lambda: _trace_state())
    """JAX's trace state where recording began."""

    def cube_from(self, data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
        return self._perturbed(voxels_from(data, base, dtype), Fetched(base))

    def interpolated(self, data: Voxels, coordinate: Vec3) -> Voxel:
        base, fraction = self.place(data, coordinate)
        cube = voxels_from(data, base, coordinate[0].dtype)
        value = trilinear(transposed(cube, self.axes), fraction)
        return self._perturbed(value, Fetched(base, permuted(fraction, self.axes)))

    def _perturbed(self, values: Any, fetched: Fetched) -> Any:
        if _trace_state() != self.state:
            raise ValueError(
                'Field.value reads a Volume inside vmap, scan or cond; adjoint="replay" cannot differentiate '
                'that. Read it outside, hold a plain array, or pass adjoint="direct".'
            )
        number = len(self.fetched)
        self.fetched.append(fetched)
        return jax.tree.map(jnp.add, values, self.perturbations[number]) if self.perturbations else values


def _trace_state() -> Any:
    """The current trace state of JAX, which differs inside transformations."""
    home: Any = core if hasattr(core, "get_opaque_trace_state") else import_module("jax.core")
    return home.get_opaque_trace_state()


def perturbations_of(data: Voxels, fetched: list[Fetched], dtype: DType) -> list[Any]:
    """Zero perturbations for the fetches from an array."""

    def zeros(fetch: Fetched) -> Any:
        voxel = _zero_voxel(data, fetch.base.shape, dtype)
        return voxel if fetch.fraction is not None else cube_of(lambda *_: voxel)

    return list(map(zeros, fetched))


def _zero_voxel(data: Voxels, shape: tuple[int, ...], dtype: DType) -> Voxel:
    zero = jnp.zeros(shape, dtype)
    return (zero,) * data.shape[3] if data.ndim > 3 else zero


_PAIRS = jax.lax.ScatterDimensionNumbers(
    update_window_dims=(1,), inserted_window_dims=(), scatter_dims_to_operand_dims=(0,)
)


def scatter_add(sums: Array, shape: tuple[int, ...], fetched: list[Fetched], cotangents: list[Any]) -> Array:
    """Add cotangents of fetched values to the flattened numbers of an array of this shape."""
    _, ny, nz, *channels = shape
    count = math.prod(channels)
    for (base, fraction), cotangent in zip(fetched, cotangents, strict=True):
        flat = base.reshape(-1)
        if fraction is None:
            base = flat
            pairs = ((x, y, _rows(jax.tree.leaves(cotangent[x][y]))) for x in (0, 1) for y in (0, 1))
        else:  # in memory, or each product would compute them again
            parts = jax.tree.leaves(cotangent)
            base, fraction, rows = in_memory(flat[0] >= 0, _flattened, base, fraction, parts)
            pairs = _interpolated_pairs(fraction, rows)
        for x, y, pair in pairs:
            # both voxels of a pair along z at once, with all channels: XLA's scatter is sequential
            pair = pair.reshape(-1, 2 * count).astype(sums.dtype)
            index, mode = count * (base + (x * ny + y) * nz), "promise_in_bounds"
            if on_gpu():
                index, mode = without_zeros(index, pair, sums.size), "drop"
            sums = jax.lax.scatter_add(sums, index[:, None], pair, _PAIRS, mode=mode)
    return sums


def _interpolated_pairs(
    fraction: Vec3, rows: Float[Array, "batch channels"]
) -> Iterator[tuple[int, int, Float[Array, "batch 2 channels"]]]:
    """Cotangents of the pairs of voxels along z, at x and y, from those of the interpolated values. Products
    by pair are contiguous: rows of eight would take three times as long."""
    fx, fy, fz = (part[:, None] for part in fraction)
    weights = jnp.where(jnp.arange(2)[None] == 1, fz, 1 - fz)
    for x, y in itertools.product((0, 1), repeat=2):
        across = (fx if x else 1 - fx) * (fy if y else 1 - fy)
        yield x, y, (across * weights)[:, :, None] * rows[:, None, :]


def _flattened(base: Array, fraction: Vec3, parts: list[Array]) -> tuple[Array, Vec3, Array]:
    fx, fy, fz = (part.reshape(-1) for part in fraction)
    return base.reshape(-1), (fx, fy, fz), _rows(parts)


def _rows(parts: Sequence[Array]) -> Float[Array, "batch parts"]:
    """Flattened arrays as columns."""
    return jnp.stack([part.reshape(-1) for part in parts], axis=-1)


def voxels_from(data: Voxels, base: Int[Array, ""], dtype: DType) -> Cube:
    """The cube of eight voxels that begins at a flat index, by a separate fetch of each number."""
    (_, ny, nz, *channels), flat = data.shape, data.reshape(-1)

    def voxel(x: int, y: int, z: int) -> Voxel:
        at = base + (x * ny + y) * nz + z
        if not channels:
            return gather(flat, at).astype(dtype)
        (c,) = channels
        return tuple(gather(flat, c * at + k).astype(dtype) for k in range(c))

    return cube_of(voxel)


def flat_index(node: Node, shape: tuple[Any, ...]) -> Int[Array, "..."]:
    """The index of a node into the flattened array."""
    i, j, k = node
    _, ny, nz, *_ = shape
    return (i * ny + j) * nz + k


def direction_bit(sides: Sequence[Any]) -> Any:
    """The bit of `Fetch.changes` for a direction, given by its sides along x, y, z: -1, 0 or 1."""
    i, j, k = sides
    return 13 + 9 * i + 3 * j + k


def nearest_node(coordinate: Vec3, shape: tuple[Any, ...]) -> Node:
    """The node nearest to a coordinate; the upper one of two equally near."""
    nearest = (jnp.floor(c + 0.5).astype(jnp.int32) for c in coordinate)
    i, j, k = (jnp.clip(index, 0, n - 1) for index, n in zip(nearest, shape[:3], strict=True))
    return i, j, k


def corners(coordinate: Vec3, shape: tuple[Any, ...]) -> list[tuple[Int[Array, ""], Scalar]]:
    """Flat index and weight of the eight nodes around a coordinate."""
    node, fraction = split(coordinate, shape)
    base, (_, ny, nz), nodes = flat_index(node, shape), shape, []
    for x, y, z in itertools.product((0, 1), repeat=3):
        sides = (f if side else 1 - f for side, f in zip((x, y, z), fraction, strict=True))
        nodes.append((base + (x * ny + y) * nz + z, math.prod(sides)))
    return nodes


def split(coordinate: Vec3, shape: tuple[Any, ...], *, bounded: bool = True) -> tuple[Node, Vec3]:
    """The node below a coordinate, and the fractions past it; the last node belongs to the cell below. Unless
    `bounded`, the node of NaN is arbitrary."""
    (i, fx), (j, fy), (k, fz) = (_below(c, n, bounded) for c, n in zip(coordinate, shape, strict=True))
    return (i, j, k), (fx, fy, fz)


SMALL = 2**22
"""Nodes along an axis up to which an index is read from a float's bits."""


def _below(coordinate: Scalar, n: Any, bounded: bool) -> tuple[Int[Array, "..."], Scalar]:
    """The node below a coordinate along an axis of `n` nodes, and the fraction past it."""
    dtype = coordinate.dtype
    last = jnp.asarray(n - 2, dtype)
    # comparisons, which keep a NaN: minima and maxima take several instructions where bounds are traced
    inside = jnp.where(coordinate < 0, 0, jnp.where(coordinate > last + 1, last + 1, coordinate))
    node = jax.lax.stop_gradient(jnp.floor(inside))
    node = jnp.where(node > last, last, node)
    index = to_index(node, n)
    if bounded:  # also the node of NaN
        index = jnp.clip(index, 0, jnp.asarray(n - 2, jnp.int32))
    return index, inside - node


def to_index(node: Scalar, n: int | np.integer | Array) -> Int[Array, "..."]:
    """The integer of a float from 0 to `n`; any for NaN."""
    if node.dtype == jnp.float32 and not (isinstance(n, int) and n > SMALL):
        # the last 23 bits: half as many instructions as XLA's conversion, which handles all numbers
        return jax.lax.bitcast_convert_type(node + 2.0**23, jnp.int32) & (2**23 - 1)
    return node.astype(jnp.int32)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _steady_split(coordinate: Vec3, live: Bool[Array, ""], shape: tuple[Any, ...]) -> tuple[Node, Vec3]:
    """`split` for `Fetch.steady`; `live`: the condition of `in_memory`."""
    return split(coordinate, shape)


@_steady_split.defjvp
def _tangent_of_split(shape: tuple[int, ...], primals: Any, tangents: Any) -> Any:
    (coordinate, live), (moves, _) = primals, tangents
    node, fraction = in_memory(live, partial(split, shape=shape), coordinate)
    clips = [lambda c, n=n: jnp.clip(c, 0, n - 1) for n in shape]
    rates = (jax.jvp(f, (c,), (move,))[1] for f, c, move in zip(clips, coordinate, moves, strict=True))
    still = jax.tree.map(lambda index: np.zeros(index.shape, jax.dtypes.float0), node)
    return (node, fraction), (still, tuple(rates))
