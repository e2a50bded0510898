"""Which voxels does a gradient go to? A volume that writes down what it is asked for.

And what else it takes to add up gradients: of trees, of whose leaves some have none.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree, Shaped

from .volume import Volume


class Tapped(Volume):
    """A volume that writes down which voxels it is asked for, and adds something to each."""

    taps: list | None
    asked: list = eqx.field(static=True)

    def __init__(self, volume: Volume, whole: Volume, taps: list | None):
        self.data, self.labels = whole.data, whole.labels
        self.spacing, self.origin = volume.spacing, volume.origin
        self.taps, self.asked = taps, []

    def tapped(self, taps: list) -> "Tapped":
        """The same volume, with a list of its own."""
        return Tapped(self, self, taps)

    def _voxel(self, flat: Int[Array, ""]) -> Shaped[Array, ""]:
        self.asked.append(flat)
        value = jax.lax.stop_gradient(super()._voxel(flat))
        return value if not self.taps else value + self.taps[len(self.asked) - 1]


def floats(tree: PyTree) -> PyTree:
    """What of it can have a gradient."""
    return eqx.filter(tree, eqx.is_inexact_array)


def without_voxels(volume: Volume) -> Volume:
    """A volume but for its voxels, of which there are too many to be handed around."""
    return eqx.tree_at(lambda v: v.data, volume, None)


def with_voxels(volume: Volume, data: Array) -> Volume:
    """The volume with these voxels."""
    return eqx.tree_at(lambda v: v.data, volume, data, is_leaf=lambda leaf: leaf is None)


def added(a: PyTree, b: PyTree) -> PyTree:
    """Leaf by leaf."""
    return jax.tree.map(jnp.add, a, b)


def scattered(
    voxels: Float[Array, " voxels"], asked: list[Int[Array, "..."]], parts: list[Shaped[Array, "..."]]
) -> Float[Array, " voxels"]:
    """Parts of a gradient added to the voxels that were asked for."""
    for place, part in zip(asked, parts, strict=True):
        voxels = voxels.at[place].add(part, mode="promise_in_bounds", wrap_negative_indices=False)
    return voxels
