"""How are the eight voxels around a sample fetched at once? From words that hold neighbours side by side.

A fetch costs the same for one byte as for four, so a copy of the volume in which each word holds a voxel
and its neighbours along z, and for 8-bit voxels along y too, saves three fetches in four, or every second
one. It takes four, or two, times the memory of the voxels, and is made once for an array of them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Shaped, UInt32

from .._util.checks import is_traced
from .._util.fetching import Packed
from .._util.memo import kept
from ..volume import Volume, with_fetch


LIMIT = 2**30
"""Bytes, at most, that a copy may take."""


def words_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The packed copy of a volume's voxels; None where it is no use, or takes too much memory."""
    data = volume.data
    small = data.dtype.kind in "ui" and data.dtype.itemsize in (1, 2)
    if not small or is_traced(data) or not isinstance(data, jax.Array) or 4 * data.size > LIMIT:
        return None
    return kept(data, _packed)


def with_words(volume: Volume, words: UInt32[Array, " voxels"] | None) -> Volume:
    """The volume, with its packed copy where there is one."""
    return volume if words is None else with_fetch(volume, Packed(words))


@jax.jit
def _packed(data: Shaped[Array, "nx ny nz"]) -> UInt32[Array, " voxels"]:
    bits = 8 * data.dtype.itemsize
    unsigned = data.view(f"uint{bits}").astype(jnp.uint32)

    def beside(voxels: UInt32[Array, "nx ny nz"], axis: int) -> UInt32[Array, "nx ny nz"]:
        # what is beside the last one is never asked for
        return jnp.roll(voxels, -1, axis)

    words = unsigned | beside(unsigned, 2) << bits
    if bits == 8:
        words = words | beside(words, 1) << 16
    return words.reshape(-1)
