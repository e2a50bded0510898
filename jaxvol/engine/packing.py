"""How are the eight voxels around a sample fetched at once? From words that hold neighbours side by side.

A fetch costs the same for one byte as for four, so a copy of the volume in which each word holds a voxel
and its neighbours along z, and for 8-bit voxels along y too, saves three fetches in four, or every second
one. It takes four, or two, times the memory of the voxels, and is made once for an array of them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Shaped, UInt32

from .._util.checks import is_traced
from .._util.memo import kept
from .._util.vec3 import Scalar, Vec3
from ..volume import Cube, Volume, split


LIMIT = 2**30
"""Bytes, at most, that a copy may take."""


class PackedVolume(Volume):
    """A volume with its packed copy: the same values, fetched faster."""

    words: UInt32[Array, " voxels"]

    def __init__(self, volume: Volume, words: UInt32[Array, " voxels"]):
        # as they are: they have been checked
        self.data, self.labels = volume.data, volume.labels
        self.spacing, self.origin = volume.spacing, volume.origin
        self.words = words

    def _cube(self, coordinate: Vec3) -> tuple[Cube, Vec3]:
        dtype = coordinate[0].dtype
        (x, y, z), fraction = split(coordinate, self.shape)
        _, ny, nz = self.shape
        base = (x * ny + y) * nz + z
        bits = 8 * self.data.dtype.itemsize
        signed = jnp.issubdtype(self.data.dtype, jnp.signedinteger)

        def voxel(word: Int[Array, ""], place: int) -> Scalar:
            if signed:  # its sign comes with it when it is shifted down from the top
                return (word << (32 - bits * (place + 1)) >> (32 - bits)).astype(dtype)
            return (word >> (bits * place) & (2**bits - 1)).astype(dtype)

        def row(flat: Int[Array, ""]) -> list[list[Scalar]]:
            if bits == 8:
                word = self._word(flat)
                return [[voxel(word, 0), voxel(word, 1)], [voxel(word, 2), voxel(word, 3)]]
            words = self._word(flat), self._word(flat + nz)
            return [[voxel(word, 0), voxel(word, 1)] for word in words]

        return [row(base), row(base + ny * nz)], fraction

    def _word(self, flat: Int[Array, ""]) -> Int[Array, ""]:
        word = self.words.at[flat].get(mode="promise_in_bounds", wrap_negative_indices=False)
        # XLA fetches anew for each of several uses, but not for those of what a fetched value is converted to
        return word.astype(jnp.int32)


def words_of(volume: Volume) -> UInt32[Array, " voxels"] | None:
    """The packed copy of a volume's voxels; None where it is no use, or takes too much memory."""
    data = volume.data
    if type(volume) is not Volume:  # it may fetch its voxels in its own way
        return None
    small = data.dtype.kind in "ui" and data.dtype.itemsize in (1, 2)
    if not small or is_traced(data) or not isinstance(data, jax.Array) or 4 * data.size > LIMIT:
        return None
    return kept(data, _packed)


def with_words(volume: Volume, words: UInt32[Array, " voxels"] | None) -> Volume:
    """The volume, with its packed copy where there is one."""
    return volume if words is None else PackedVolume(volume, words)


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
