"""Data computed before an image is marched: a packed copy of the voxels, and the empty space.

A fetch costs the same for one byte as for four. In the packed copy, each 32-bit word holds a voxel and its
neighbour along z, and for 8-bit voxels also their neighbours along y, which saves three of four fetches for
8-bit, and one of two for 16-bit voxels. It takes four or two times the memory of the voxels, and is made once
per array. The slopes of 8-bit voxels take as much again.
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
from ..scene.voxel_fetch import SLOPE_BITS, Packed, direction_bit
from ..xla.memo import memoized, memoized_of
from ..xla.memory import zeros_in_reserve
from ..xla.platform import is_traced, platform
from ..xla.trees import constant, unchecked, with_fields
from .rays import RayTiles, lines, vmap_rays
from .shifts import begin_rays
from .tiling import Tiling
from .wavefront import finish_blind, march_rays


LARGE = 2**24
"""Maximum length of packed copies that are padded to a power of two."""

RESERVES = LARGE, 2**28
"""Lengths of packed copies in reserve (`zeros_in_reserve`)."""

LIMIT = 2**30
"""Maximum size in bytes of a copy of the voxels, and of their slopes."""


class VolumeAcceleration(eqx.Module):
    """Packed copy of the voxels for fetching, slopes of nodes, and ranges of blocks; None if the image does
    not use them. Computed once per array of voxels."""

    words: list[UInt32[Array, " _"] | None]
    """Packed copy of each of the volume's `grids`."""
    slopes: list[UInt32[Array, " _"] | None]
    blocks: Any
    """`Blocks`, or `SeveralBlocks` for several volumes."""
    occupancy: Occupancy | None = None
    """Occupancy with distances, in place of `blocks`, for distances of finer blocks without traced arrays:
    computed once per volume and transfer function."""
    changes: UInt32[Array, " nodes"] | None = None
    """`changes_of` the volume's labels, where cells are cut at their faces."""

    @classmethod
    def of(
        cls,
        volume: Volume,
        transfer: Transfer,
        march: March,
        lighting: Lighting | None = None,
        compositing: Compositing[Any] | None = None,
    ) -> "VolumeAcceleration":
        """The data that an image uses; `occupancy` only if `compositing` is not None."""
        lit_by_gradient = lighting is not None and lighting.reads_gradient
        slopes = transfer.reads_gradient or lit_by_gradient
        # a brick of a volume is rendered once: packing it takes longer than fetching single voxels, unless
        # gradients fetch six cubes of them per sample
        packs = slopes or volume.first is None
        occupancy = None if compositing is None else _kept_occupancy(volume, transfer, march, compositing)
        return cls(
            [words_of(grid) if packs else None for grid in grids(volume)],
            [slopes_of(grid) if slopes else None for grid in grids(volume)],
            _blocks_of(volume, transfer, march) if march.leaps and occupancy is None else None,
            occupancy,
            changes_of(volume) if march.reads_labels else None,
        )

    @property
    def of_space(self) -> "VolumeAcceleration":
        """The data from which the empty space is computed."""
        return VolumeAcceleration([], [], self.blocks, self.occupancy)

    def packed(self, scene: Scene) -> Scene:
        """The scene, fetching voxels from their packed copy."""
        volume = with_words(scene.volume, self.words, self.slopes)
        if self.changes is not None:
            fetch = with_fields(volume.fetch, changes=self.changes)
            volume = with_fields(volume, fetch=fetch)
        return scene._replace(volume=volume)

    def prepared(self, scene: Scene) -> Scene:
        """The packed scene, prepared for an image."""
        return self.packed(scene).prepared()


def _blocks_of(volume: Volume, transfer: Transfer, march: March) -> Blocks | SeveralBlocks:
    if not isinstance(volume.field, Several):
        return Blocks.of(volume, slopes=transfer.reads_gradient, side=march.block_side)
    if march.block_side != BLOCK:
        raise ValueError(
            f"march: distances of several volumes need blocks of {BLOCK}³ cells; got {march.block_side}³. "
            f"Pass SpaceLeaping(block={BLOCK}), the default."
        )
    return SeveralBlocks.of(volume, slopes=transfer.reads_gradient)


def _kept_occupancy(
    volume: Volume, transfer: Transfer, march: March, compositing: Compositing[Any]
) -> Occupancy | None:
    """The occupancy and its distances, kept where they take longer than the image."""
    if march.block_side == BLOCK or isinstance(volume.field, Several) or volume.first is not None:
        return None
    seams = march.overriding("locate") + march.overriding("clip")
    located = tuple(transform for transform in march.transforms if any(transform is seam for seam in seams))
    parts = volume, transfer, located, compositing
    leaves = jax.tree.leaves(parts)
    if not all(isinstance(leaf, jax.Array) and not is_traced(leaf) for leaf in leaves):
        return None
    return memoized_of(parts, _measured(march.block_side, march.may_shift))


@cache
def _measured(side: int, may_shift: bool) -> Callable[..., Occupancy]:
    @jax.jit
    def measured(parts: tuple[Volume, Transfer, tuple[Transform, ...], Compositing[Any]]) -> Occupancy:
        volume, transfer, located, compositing = constant(parts)
        march = March(1.0, located)
        if compositing.resolves:  # the march of such a mode uses another transfer function
            transfer, march = compositing.marched(transfer, march, volume)
        # the ranges of such fine blocks are not kept: they take eight bytes per voxel
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
    """The cells that may be visible. `blocks`: as in `VolumeAcceleration`."""
    visible = compositing.occupied(transfer, blocks)
    check_answer(compositing, "occupied", visible, blocks.unordered)
    visible |= blocks.unordered
    if may_shift:  # a leap applies the shift, so it must not cross cells that are visible to `opacity`
        visible |= transfer.visible(blocks)
    return march.locate(volume).occupancy(visible, volume.first, blocks.side)


def visible_in_numpy(
    compositing: Compositing[Any], transfer: Transfer, blocks: Blocks | SeveralBlocks
) -> Bool[np.ndarray, "bx by bz"] | None:
    """Blocks that may be visible, by NumPy, which compiles nothing; None if only JAX can compute them."""
    if type(transfer) is not TransferFunction or type(compositing).occupied is not Compositing.occupied:
        return None
    if not isinstance(blocks, Blocks) or blocks.low.ndim != 3 or platform() != "cpu":
        return None
    low, high = np.asarray(blocks.low), np.asarray(blocks.high)
    values, extinction = np.asarray(transfer.values), np.asarray(transfer.extinction)
    return positive_between(values, extinction, low, high) | ~(low <= high)


NO_ACCELERATION = VolumeAcceleration([], [], None)


def empty_space_of(scene: Scene, acceleration: VolumeAcceleration, tiling: Tiling) -> EmptySpaceIndex | None:
    """The empty-space index of a scene, without gradient; None if the march does not leap."""
    if acceleration.blocks is None and acceleration.occupancy is None:
        return None
    scene = constant(scene)
    volume, transfer, march, compositing = scene.volume, scene.transfer, scene.march, scene.compositing
    space, occupancy = march.locate(volume), acceleration.occupancy
    if occupancy is None:
        blocks = acceleration.blocks
        occupancy = _occupancy(volume, transfer, march, compositing, blocks, march.may_shift)
    # `until` is ignored: corner rays that end early say nothing about the rays between them
    source = without_ends(scene.source)
    if isinstance(source, GivenRays):
        return march.empty_space(occupancy, None)

    def first_hit(index: EmptySpaceIndex, columns: Int[Array, "*rays"], rows: Int[Array, "*rays"]) -> Array:
        if compositing.resolves and not isinstance(compositing, FirstVisible):
            name = type(compositing).__name__
            raise ValueError(
                'SpaceLeaping("min_distance") starts rays at the first visible sample; got compositing '
                f"{name}, which may show samples before it. Use another method."
            )
        plain = March(march.step, (), march.quadrature, max_samples=march.max_samples)
        line = lines(source, columns.reshape(1, -1), rows.reshape(1, -1), no_fault)
        origins = line.origin if line.beside is None else plus(line.origin, line.beside)
        pixel_rays = GivenRays(jnp.stack(origins, axis=-1), jnp.stack(line.direction, axis=-1))
        tiles = RayTiles.of(pixel_rays, tiling._replace(tile=columns.size))  # a single one
        prepared = by_rules(Scene(volume, transfer, pixel_rays, plain, FirstVisible()).prepared())
        rays = tiles.rays(pixel_rays, space, jnp.zeros((), jnp.int32), no_fault)
        start = begin_rays(plain, prepared, rays, tiling, "depth")
        skips = tiles.skips(index, rays, march.step)
        marched = march_rays(prepared, rays, finish_blind(skips, start), tiling, skips)
        rendering = vmap_rays(partial(end, prepared))(rays, marched.at)
        return tiles.assemble(rendering.depth[None]).reshape(columns.shape)

    ray = partial(source.ray_from, space.anchor)
    no_fault = jnp.zeros((), bool)
    return march.empty_space(occupancy, View(ray, source.size, source.first_pixel, first_hit))


def words_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The packed copy of 8- or 16-bit integer voxels in a JAX array that is not traced. None for other
    voxels, if a field replaces them, or if the copy would take too much memory."""
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
    """A volume of one grid without a static shape, from its `Packed` voxels or a copy of its floats; the same
    volume if it has neither."""
    fetch, data = volume.fetch, volume.data
    if isinstance(fetch, Packed):
        nodes = None if fetch.nodes is None else _slopes(data)[1]
        fetch = replace(fetch, words=_words(data)[1], nodes=nodes)
    elif volume.field is None and fetch.window is None and data.ndim == 3 and data.dtype.kind == "f":
        if platform() != "cpu" or data.nbytes > LIMIT:
            return volume
        fetch = Packed(memoized(data, _in_a_row, _in_a_row_in_numpy), changes=fetch.changes)
    else:
        return volume
    sizes = np.asarray(data.shape, np.int32)
    return unchecked(volume, fetch=replace(fetch, sizes=sizes, kind=str(data.dtype)), data=None)


def slopes_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The exact slopes of a volume's nodes, for the gradient; None if `words_of` is, or for 16-bit voxels."""
    small = words_of(volume) is not None and volume.data.dtype.itemsize == 1
    return _slopes(volume.data)[0] if small else None


def with_words(
    volume: Volume, words: Sequence[Array | None], slopes: Sequence[Array | None] | None = None
) -> Volume:
    """The volume with these packed copies of its `grids`, and their slopes, where they are not None."""
    if not words:
        return volume
    pairs = zip(words, [None] * len(words) if slopes is None else slopes, strict=True)
    return read_as(volume, *(None if word is None else Packed(word, slope) for word, slope in pairs))


def changes_of(volume: Volume) -> UInt32[Array, " nodes"] | None:
    """Words of `_label_changes`, on a CPU. None for labels that are traced, if there are none, or if the
    words would take too much memory."""
    labels = volume.labels
    if not isinstance(labels, jax.Array) or is_traced(labels) or platform() != "cpu":
        return None
    if 4 * labels.size > LIMIT or volume.first is not None:
        return None
    return memoized(labels, _changes_by_jax, _changes_in_numpy)


def _label_changes(labels: Any, xp: Any) -> Any:
    """Words of 27 bits, one for each direction from a node to a neighbour (`direction_bit`): whether the
    nodes of the box between the two, of 2, 4 or 8 nodes, have several labels. The bits of directions that
    leave the grid are arbitrary. `xp`: `numpy` or `jax.numpy`."""
    words, known = xp.zeros(labels.shape, np.uint32), 1 << direction_bit((0, 0, 0))
    for axis, step in enumerate((9, 3, 1)):
        parts = [words]
        for side in (-1, 1):
            differs = (xp.roll(labels, -side, axis) != labels).astype(np.uint32) * np.uint32(known)
            box = words | xp.roll(words, -side, axis) | differs
            parts.append(box << np.uint32(step) if side > 0 else box >> np.uint32(step))
        words, known = parts[0] | parts[1] | parts[2], known | known << step | known >> step
    return words.reshape(-1)


_changes_by_jax, _changes_in_numpy = (
    jax.jit(partial(_label_changes, xp=jnp)),
    partial(_label_changes, xp=np),
)


def shared_length(voxels: int) -> int:
    """The padded length of packed copies of `voxels` voxels: one of few, so that volumes share kernels. Large
    copies are padded by at most a quarter."""
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

    # plane by plane: the neighbours of all voxels take several times the memory of the words
    return _in_one_length(jax.lax.map(plane, data))


def _in_one_length(plane_words: UInt32[Array, "nx ny nz"]) -> tuple[Array, Array]:
    words = _in_a_row(plane_words)
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
    """One buffer as three views: of shared length, of reserved length, and of the shape of the voxels."""
    count = math.prod(shape)
    try:
        reserve = zeros_in_reserve(next(length for length in RESERVES if length >= count), dtype)
    except MemoryError:  # where addresses are limited
        reserve = zeros_in_reserve(shared_length(count), dtype)
    return reserve[: shared_length(count)], reserve, reserve[:count].reshape(shape)


@jax.jit
def _packed_slopes(data: Shaped[Array, "nx ny nz"]) -> tuple[Array, Array]:
    last = data.shape[0] - 1

    def plane(i: Int[Array, ""]) -> UInt32[Array, "ny nz"]:
        low, voxels, high = (data[jnp.clip(i + step, 0, last)].astype(jnp.int32) for step in (-1, 0, 1))
        across = (high - low) * jnp.where((i == 0) | (i == last), 2, 1)
        return _slopes_of_plane(across, voxels, jnp)

    # plane by plane, as `_packed`
    return _in_one_length(jax.lax.map(plane, jnp.arange(last + 1)))


def _packed_slopes_in_numpy(data: Shaped[np.ndarray, "nx ny nz"]) -> tuple[np.ndarray, np.ndarray]:
    words, reserve, planes = _reserved(data.shape)
    last = data.shape[0] - 1
    for i, plane in enumerate(planes):
        low, voxels, high = (data[min(max(i + step, 0), last)].astype(np.int32) for step in (-1, 0, 1))
        across = (high - low) * (2 if i in (0, last) else 1)
        plane[:] = _slopes_of_plane(across, voxels, np)
    return words, reserve


def _slopes_of_plane(across: Any, voxels: Any, xp: Any) -> Any:
    """The words of a plane with slopes `across` along x. `xp`: `numpy` or `jax.numpy`."""

    def doubled(axis: int) -> Any:
        n, rise = voxels.shape[axis], xp.diff(voxels, axis=axis)
        lower, upper, first, last = (
            rise[(slice(None),) * axis + (slice(*part),)] for part in ((0, n - 2), (1, n), (0, 1), (n - 2, n))
        )
        return xp.concatenate([2 * first, lower + upper, 2 * last], axis)

    x, y, z = ((slope & (2**SLOPE_BITS - 1)).astype(np.uint32) for slope in (across, doubled(0), doubled(1)))
    return x << (32 - SLOPE_BITS) | y << 12 | z
