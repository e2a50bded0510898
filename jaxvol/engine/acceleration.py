"""What is computed before an image is marched: once from the voxels, a packed copy; and where space is empty.

A fetch costs the same for one byte as for four. In the packed copy, each 32-bit word holds a voxel and its
neighbour along z, and for 8-bit voxels the two next to these along y, which saves three fetches in four for
8-bit, and one in two for 16-bit voxels. It takes four or two times the memory of the voxels, and is made once
for each array of them. The slopes of 8-bit voxels take as much again.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Shaped, UInt32

from .._util.checks import check_answer
from .._util.piecewise_linear import positive_between
from .._util.vec3 import plus
from ..compositing.blending import Compositing
from ..compositing.selection import FirstVisible
from ..lighting.shading import Lighting
from ..march.beams import EmptySpaceIndex, View
from ..march.march import March, Transform
from ..ray import Scene, by_rules, end
from ..scene.camera import GivenRays, without_ends
from ..scene.occupancy import BLOCK, Blocks, Occupancy
from ..scene.several import Several, SeveralBlocks
from ..scene.transfer import Transfer, TransferFunction
from ..scene.volume import Volume, grids, read_as
from ..scene.voxel_fetch import SLOPE_BITS, Packed
from ..xla.memo import memoized, memoized_of
from ..xla.memory import zeros_in_reserve
from ..xla.platform import is_traced, platform
from ..xla.trees import constant, unchecked
from .rays import RayTiles, lines, vmap_rays
from .shifts import begin_rays
from .tiling import Tiling
from .wavefront import blinded, march_rays


LARGE = 2**24
"""Voxels from which on packed copies are not padded to a power of two."""

RESERVES = LARGE, 2**28
"""Lengths of packed copies in reserve (`zeros_in_reserve`)."""

LIMIT = 2**30
"""Bytes that a copy of the voxels may take at most, and one of their slopes."""


class VolumeAcceleration(eqx.Module):
    """What is computed before the image: a packed copy of the voxels for fetching, the slopes of nodes, and
    the ranges of blocks; None where the image has no use for it. Made once for each array of voxels."""

    words: list[UInt32[Array, " _"] | None]
    """Of each of the volume's `grids`."""
    slopes: list[UInt32[Array, " _"] | None]
    blocks: Any
    """`Blocks`, or, of several volumes, `SeveralBlocks`."""
    occupancy: Occupancy | None = None
    """In place of `blocks`, with its distances, where these are of finer blocks and nothing is traced: made
    once for each volume and transfer function."""

    @classmethod
    def of(
        cls,
        volume: Volume,
        transfer: Transfer,
        march: March,
        lighting: Lighting | None = None,
        compositing: Compositing[Any] | None = None,
    ) -> "VolumeAcceleration":
        """What is of use for an image of this kind; `occupancy` only if its `compositing` is given."""
        lit_by_gradient = lighting is not None and lighting.reads_gradient
        slopes = transfer.reads_gradient or lit_by_gradient
        # a brick of a volume is rendered once: packing it takes longer than fetching voxels one by one,
        # unless gradients fetch six cubes of them for each sample
        packs = slopes or volume.first is None
        seen = None if compositing is None else _kept_occupancy(volume, transfer, march, compositing)
        return cls(
            [words_of(grid) if packs else None for grid in grids(volume)],
            [slopes_of(grid) if slopes else None for grid in grids(volume)],
            _blocks_of(volume, transfer, march) if march.leaps and seen is None else None,
            seen,
        )

    @property
    def of_space(self) -> "VolumeAcceleration":
        """What tells where space is empty."""
        return VolumeAcceleration([], [], self.blocks, self.occupancy)

    def packed(self, scene: Scene) -> Scene:
        """The scene, with voxels fetched from their packed copy."""
        return scene._replace(volume=with_words(scene.volume, self.words, self.slopes))

    def prepared(self, scene: Scene) -> Scene:
        """The scene, packed, and with what is computed once for each image."""
        return self.packed(scene).prepared()


def _blocks_of(volume: Volume, transfer: Transfer, march: March) -> Blocks | SeveralBlocks:
    if not isinstance(volume.field, Several):
        return Blocks.of(volume, slopes=transfer.reads_gradient, side=march.block_side)
    if march.block_side != BLOCK:
        raise ValueError(f"march: distances of several volumes are those of blocks of {BLOCK}³ cells.")
    return SeveralBlocks.of(volume, slopes=transfer.reads_gradient)


def _kept_occupancy(
    volume: Volume, transfer: Transfer, march: March, compositing: Compositing[Any]
) -> Occupancy | None:
    """The occupancy and its distances, where they would take longer than the image."""
    if march.block_side == BLOCK or isinstance(volume.field, Several) or volume.first is not None:
        return None
    seams = march.overriding("locate") + march.overriding("clip")
    located = tuple(each for each in march.transforms if any(each is one for one in seams))
    given = volume, transfer, located, compositing
    leaves = jax.tree.leaves(given)
    if not all(isinstance(leaf, jax.Array) and not is_traced(leaf) for leaf in leaves):
        return None
    return memoized_of(given, _measured(march.block_side, march.may_shift))


@cache
def _measured(side: int, may_shift: bool) -> Callable[..., Occupancy]:
    @jax.jit
    def measured(given: tuple[Volume, Transfer, tuple[Transform, ...], Compositing[Any]]) -> Occupancy:
        volume, transfer, located, compositing = constant(given)
        march = March(1.0, located)
        if compositing.resolves:  # as the march is told, which looks for what the mode resolves
            transfer, march = compositing.marched(transfer, march, volume)
        # the ranges of so many blocks are not kept: they take eight bytes for each voxel
        blocks = Blocks.of(volume, slopes=transfer.reads_gradient, side=side)
        occupancy = _occupancy(volume, transfer, march, compositing, blocks, may_shift)
        return replace(occupancy, known=occupancy.distance())

    return measured


def _occupancy(
    volume: Volume,
    transfer: Transfer,
    march: March,
    compositing: Compositing[Any],
    blocks: Any,
    may_shift: bool,
) -> Occupancy:
    """The cells in which anything may be visible. `blocks`: as in `VolumeAcceleration`."""
    visible = compositing.occupied(transfer, blocks)
    check_answer(compositing, "occupied", visible, blocks.unordered)
    visible |= blocks.unordered
    if may_shift:  # a leap applies the shift, so that it must not cross what `opacity` sees
        visible |= transfer.visible(blocks)
    return march.locate(volume).occupancy(visible, volume.first, blocks.side)


def visible_in_numpy(
    compositing: Compositing[Any], transfer: Transfer, blocks: Any
) -> Bool[np.ndarray, "bx by bz"] | None:
    """Blocks in which anything may be visible, by NumPy, which compiles nothing; None where JAX has to."""
    if type(transfer) is not TransferFunction or type(compositing).occupied is not Compositing.occupied:
        return None
    if not isinstance(blocks, Blocks) or blocks.low.ndim != 3 or platform() != "cpu":
        return None
    low, high = np.asarray(blocks.low), np.asarray(blocks.high)
    values, extinction = np.asarray(transfer.values), np.asarray(transfer.extinction)
    return positive_between(values, extinction, low, high) | ~(low <= high)


NO_ACCELERATION = VolumeAcceleration([], [], None)


def empty_space_of(scene: Scene, acceleration: VolumeAcceleration, tiling: Tiling) -> EmptySpaceIndex | None:
    """Where the scene is empty; None where the march does not leap. It carries no gradient."""
    if acceleration.blocks is None and acceleration.occupancy is None:
        return None
    scene = constant(scene)
    volume, transfer, march, compositing = scene.volume, scene.transfer, scene.march, scene.compositing
    space, occupancy = march.locate(volume), acceleration.occupancy
    if occupancy is None:
        blocks = acceleration.blocks
        occupancy = _occupancy(volume, transfer, march, compositing, blocks, march.may_shift)
    # ends leave more empty, but would hide from the corners of a cell what the rays between them see
    source = without_ends(scene.source)
    if isinstance(source, GivenRays):
        return march.empty_space(occupancy, None)

    def first_hit(index: EmptySpaceIndex, columns: Int[Array, "*rays"], rows: Int[Array, "*rays"]) -> Array:
        if compositing.resolves and not isinstance(compositing, FirstVisible):
            name = type(compositing).__name__
            raise ValueError(
                f'SpaceLeaping("min_distance") starts rays at what is visible first; {name} may show what '
                "lies before. Use another method."
            )
        plain = March(march.step, (), march.quadrature, max_samples=march.max_samples)
        seen_by = lines(source, columns.reshape(1, -1), rows.reshape(1, -1), no_fault)
        begins = seen_by.origin if seen_by.beside is None else plus(seen_by.origin, seen_by.beside)
        own = GivenRays(jnp.stack(begins, axis=-1), jnp.stack(seen_by.direction, axis=-1))
        one_tile = tiling._replace(tile=columns.size)
        tiles, only = RayTiles.of(own, one_tile), jnp.zeros((), jnp.int32)
        seen = by_rules(Scene(volume, transfer, own, plain, FirstVisible()).prepared())
        rays = tiles.rays(own, space, only, no_fault)
        start = begin_rays(plain, seen, rays, tiling, "depth")
        skips = tiles.skips(index, rays, march.step)
        found = march_rays(seen, rays, blinded(skips, start), tiling, skips)
        rendering = vmap_rays(partial(end, seen))(rays, found.at)
        return tiles.assemble(rendering.depth[None]).reshape(columns.shape)

    ray = partial(source.ray_from, space.anchor)
    no_fault = jnp.zeros((), bool)
    return march.empty_space(occupancy, View(ray, source.size, source.first_pixel, first_hit))


def words_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The packed copy of a volume's voxels: of integers of 8 or 16 bits in a JAX array that is not traced.
    None for others, where a field replaces them, and where the copy would take too much memory."""
    data = cast(Array | np.ndarray | None, volume.data)
    small = data is not None and data.dtype.kind in "ui" and data.dtype.itemsize in (1, 2)
    if (
        data is None
        or not small
        or data.ndim > 3
        or volume.field is not None
        or is_traced(data)
        or not isinstance(data, jax.Array)
        or 4 * data.size > LIMIT
    ):
        return None
    return _words(data)[0]


def _words(data: Array) -> tuple[Array, Array]:
    return memoized(data, _packed, _packed_in_numpy)


def _slopes(data: Array) -> tuple[Array, Array]:
    return memoized(data, _packed_slopes, _packed_slopes_in_numpy)


def unshaped(volume: Volume) -> Volume:
    """A volume of one grid, so that kernels need not know its shape: of voxels that are `Packed`, or of
    floats, in a copy; the same where it has neither."""
    fetch, data = volume.fetch, volume.data
    if isinstance(fetch, Packed):
        nodes = None if fetch.nodes is None else _slopes(data)[1]
        fetch = replace(fetch, words=_words(data)[1], nodes=nodes)
    elif volume.field is None and fetch.window is None and data.ndim == 3 and data.dtype.kind == "f":
        if platform() != "cpu" or data.nbytes > LIMIT:
            return volume
        fetch = Packed(memoized(data, _in_a_row, _in_a_row_in_numpy))
    else:
        return volume
    sizes = np.asarray(data.shape, np.int32)
    return unchecked(volume, fetch=replace(fetch, sizes=sizes, kind=str(data.dtype)), data=None)


def slopes_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The slopes of a volume's nodes, exact, for the gradient; None where `words_of` is, and for voxels of
    more than 8 bits."""
    small = words_of(volume) is not None and volume.data.dtype.itemsize == 1
    return _slopes(volume.data)[0] if small else None


def with_words(
    volume: Volume, words: Sequence[Array | None], slopes: Sequence[Array | None] | None = None
) -> Volume:
    """The volume, with packed copies of its `grids` where there are any, and with their slopes."""
    if not words:
        return volume
    both = zip(words, [None] * len(words) if slopes is None else slopes, strict=True)
    return read_as(volume, *(None if word is None else Packed(word, slope) for word, slope in both))


def shared_length(voxels: int) -> int:
    """The length of packed copies of so many voxels: one of a few, so that kernels need not know the volume.
    Large ones are at most a quarter longer than they need be."""
    length = 1 << max(voxels - 1, 1).bit_length()
    return length if length <= LARGE else -(-voxels // (length // 8)) * (length // 8)


@jax.jit
def _packed(data: Shaped[Array, "nx ny nz"]) -> tuple[Array, Array]:
    bits = 8 * data.dtype.itemsize

    def plane(voxels: Shaped[Array, "ny nz"]) -> UInt32[Array, "ny nz"]:
        unsigned = voxels.view(f"uint{bits}").astype(jnp.uint32)
        # the neighbour of the last voxel is never used
        words = unsigned | jnp.roll(unsigned, -1, 1) << bits
        return words | jnp.roll(words, -1, 0) << 16 if bits == 8 else words

    # plane by plane: the neighbours of all voxels would take several times the memory of the words
    return _in_one_length(jax.lax.map(plane, data))


def _in_one_length(found: UInt32[Array, "nx ny nz"]) -> tuple[Array, Array]:
    words = _in_a_row(found)
    return words, words


@jax.jit
def _in_a_row(data: Shaped[Array, "nx ny nz"]) -> Shaped[Array, " words"]:
    return jnp.pad(data.reshape(-1), (0, shared_length(data.size) - data.size))


def _in_a_row_in_numpy(data: Shaped[np.ndarray, "nx ny nz"]) -> Shaped[np.ndarray, " words"]:
    _, reserve, planes = _reserved(data.shape, data.dtype)
    planes[:] = data
    return reserve


def _packed_in_numpy(data: Shaped[np.ndarray, "nx ny nz"]) -> tuple[np.ndarray, np.ndarray]:
    bits, (words, reserve, planes) = 8 * data.dtype.itemsize, _reserved(data.shape)
    for plane, voxels in zip(planes, data.view(f"uint{bits}"), strict=True):
        plane[:] = voxels
        plane[:, :-1] |= plane[:, 1:] << bits
        if bits == 8:
            plane[:-1] |= plane[1:] << 16
    return words, reserve


def _reserved(shape: tuple[int, ...], dtype: Any = np.uint32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same words in a length that goes with their number, in one that goes with any, and by voxels."""
    count = math.prod(shape)
    try:
        reserve = zeros_in_reserve(next(each for each in RESERVES if each >= count), dtype)
    except MemoryError:  # where addresses are limited
        reserve = zeros_in_reserve(shared_length(count), dtype)
    return reserve[: shared_length(count)], reserve, reserve[:count].reshape(shape)


@jax.jit
def _packed_slopes(data: Shaped[Array, "nx ny nz"]) -> tuple[Array, Array]:
    last = data.shape[0] - 1

    def plane(i: Int[Array, ""]) -> UInt32[Array, "ny nz"]:
        before, here, after = (data[jnp.clip(i + step, 0, last)].astype(jnp.int32) for step in (-1, 0, 1))
        across = (after - before) * jnp.where((i == 0) | (i == last), 2, 1)
        return _slopes_of_plane(across, here, jnp)

    # plane by plane, as `_packed`
    return _in_one_length(jax.lax.map(plane, jnp.arange(last + 1)))


def _packed_slopes_in_numpy(data: Shaped[np.ndarray, "nx ny nz"]) -> tuple[np.ndarray, np.ndarray]:
    words, reserve, planes = _reserved(data.shape)
    last = data.shape[0] - 1
    for i, plane in enumerate(planes):
        before, here, after = (data[min(max(i + step, 0), last)].astype(np.int32) for step in (-1, 0, 1))
        across = (after - before) * (2 if i in (0, last) else 1)
        plane[:] = _slopes_of_plane(across, here, np)
    return words, reserve


def _slopes_of_plane(across: Any, voxels: Any, xp: Any) -> Any:
    """The words of a plane, whose slopes along x are `across`; in `xp`, which is NumPy or JAX's."""

    def doubled(axis: int) -> Any:
        n, rise = voxels.shape[axis], xp.diff(voxels, axis=axis)
        before, after, first, last = (
            rise[(slice(None),) * axis + (slice(*part),)] for part in ((0, n - 2), (1, n), (0, 1), (n - 2, n))
        )
        return xp.concatenate([2 * first, before + after, 2 * last], axis)

    x, y, z = ((slope & (2**SLOPE_BITS - 1)).astype(np.uint32) for slope in (across, doubled(0), doubled(1)))
    return x << (32 - SLOPE_BITS) | y << 12 | z
