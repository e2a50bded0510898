"""A packed copy of the voxels, for fewer fetches: each word holds neighbouring voxels.

A fetch costs the same for one byte as for four. A copy in which each 32-bit word holds a voxel and its
neighbour along z, and for 8-bit voxels the two beside these along y, saves three fetches in four for 8-bit,
and one in two for 16-bit voxels. It takes four or two times the memory of the voxels, and is made once for
each array of them. The slopes of 8-bit voxels take as much again.
"""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Shaped, UInt32

from ..scene.volume import Volume, read_as
from ..scene.voxel_fetch import SLOPE_BITS, Packed
from ..xla.memo import memoized
from ..xla.platform import is_traced


LIMIT = 2**30
"""Bytes that a copy of the voxels may take at most, and one of their slopes."""


def words_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The packed copy of a volume's voxels. None for other types of voxels, traced ones, and NumPy arrays;
    where a field replaces them; and where the copy would take too much memory."""
    data = cast(Array | np.ndarray, volume.data)
    small = data.dtype.kind in "ui" and data.dtype.itemsize in (1, 2)
    if (
        not small
        or volume.field is not None
        or is_traced(data)
        or not isinstance(data, jax.Array)
        or 4 * data.size > LIMIT
    ):
        return None
    return memoized(data, _packed)


def slopes_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The slopes of a volume's nodes, exact, for the gradient. For 8-bit voxels only; otherwise None where
    `words_of` is."""
    small = words_of(volume) is not None and volume.data.dtype.itemsize == 1
    return memoized(volume.data, _packed_slopes) if small else None


def with_words(
    volume: Volume, words: UInt32[Array, " voxels"] | None, slopes: UInt32[Array, " voxels"] | None = None
) -> Volume:
    """The volume, with its packed copy where there is one, and with the slopes of its nodes."""
    return volume if words is None else read_as(volume, Packed(words, slopes))


@jax.jit
def _packed(data: Shaped[Array, "nx ny nz"]) -> UInt32[Array, " voxels"]:
    bits = 8 * data.dtype.itemsize

    def plane(voxels: Shaped[Array, "ny nz"]) -> UInt32[Array, "ny nz"]:
        unsigned = voxels.view(f"uint{bits}").astype(jnp.uint32)
        # the neighbour of the last voxel is never used
        words = unsigned | jnp.roll(unsigned, -1, 1) << bits
        return words | jnp.roll(words, -1, 0) << 16 if bits == 8 else words

    # plane by plane: the neighbours of all voxels would take several times the memory of the words
    return jax.lax.map(plane, data).reshape(-1)


@jax.jit
def _packed_slopes(data: Shaped[Array, "nx ny nz"]) -> UInt32[Array, " voxels"]:
    last = data.shape[0] - 1

    def doubled(voxels: Int[Array, "..."], axis: int) -> Int[Array, "..."]:
        n = voxels.shape[axis]
        rise = jnp.diff(voxels, axis=axis)
        before, after = (jax.lax.slice_in_dim(rise, *part, axis=axis) for part in ((0, n - 2), (1, n - 1)))
        ends = (2 * jax.lax.slice_in_dim(rise, *part, axis=axis) for part in ((0, 1), (n - 2, n - 1)))
        first, final = ends
        return jnp.concatenate([first, before + after, final], axis)

    def plane(i: Int[Array, ""]) -> UInt32[Array, "ny nz"]:
        before, here, after = (data[jnp.clip(i + step, 0, last)].astype(jnp.int32) for step in (-1, 0, 1))
        across = (after - before) * jnp.where((i == 0) | (i == last), 2, 1)
        x, y, z = (
            (slope & (2**SLOPE_BITS - 1)).astype(jnp.uint32)
            for slope in (across, doubled(here, 0), doubled(here, 1))
        )
        return x << (32 - SLOPE_BITS) | y << 12 | z

    # plane by plane, as `_packed`
    return jax.lax.map(plane, jnp.arange(last + 1)).reshape(-1)
