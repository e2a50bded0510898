"""Which voxels does a gradient go to? A volume that writes down what it is asked for.

And what else it takes to add up gradients: of trees, of whose leaves some have none.
"""

import dataclasses
from functools import cache

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int, Shaped

from ..volume import Volume


class RecordingVolume(Volume):
    """A volume, of whatever kind, that writes down which voxels it is asked for, and adds something to each.

    `RecordingVolume.of` makes one: of a class of its own for each kind of volume, so that a kind that
    measures in its own way still does."""

    taps: list | None
    asked: list = eqx.field(static=True)

    @classmethod
    def of(cls, volume: Volume, taps: list | None) -> "RecordingVolume":
        """The volume, tapped."""
        if isinstance(volume, cls):
            kind = type(volume)
        else:
            kind = cls if type(volume) is Volume else _kind(type(volume))
        tapped = object.__new__(kind)
        values = {field.name: getattr(volume, field.name, None) for field in dataclasses.fields(kind)}
        for name, value in (values | {"taps": taps, "asked": []}).items():
            object.__setattr__(tapped, name, value)
        return tapped

    def tapped(self, taps: list) -> "RecordingVolume":
        """The same volume, with a list of its own."""
        return RecordingVolume.of(self, taps)

    def _voxel(self, flat: Int[Array, ""]) -> Shaped[Array, ""]:
        self.asked.append(flat)
        value = jax.lax.stop_gradient(super()._voxel(flat))
        return value if not self.taps else value + self.taps[len(self.asked) - 1]


@cache
def _kind(kind: type[Volume]) -> type[RecordingVolume]:
    return type(f"RecordingVolume{kind.__name__}", (RecordingVolume, kind), {})


def scatter_add(
    voxels: Float[Array, " voxels"], asked: list[Int[Array, "..."]], parts: list[Shaped[Array, "..."]]
) -> Float[Array, " voxels"]:
    """Parts of a gradient added to the voxels that were asked for."""
    for place, part in zip(asked, parts, strict=True):
        voxels = voxels.at[place].add(
            part.astype(voxels.dtype), mode="promise_in_bounds", wrap_negative_indices=False
        )
    return voxels
