"""Gradients to voxels: the cotangent of each fetch is added in place to the voxels that it read.

JAX would allocate an array like the voxels for each segment, and sum these. Here each fetch is recorded, with
a perturbation of 0, whose cotangent is added in place. A volume has several arrays of voxels if its field
holds other volumes (`scene.volume.grids`): lists have one entry per array, None without a requested gradient.
"""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..scene.volume import Volume, grids, voxels_of, with_fetches, with_voxels
from ..scene.voxel_fetch import Extent, Fetch, Fetched, Recording, Zeros, perturbations_of, scatter_add
from ..xla.sharding import varying
from ..xla.trees import PyTree


Sums: TypeAlias = list[Array | None]
"""Summed cotangents of each array of voxels, flattened."""


def asked_of(volume: Volume, perturbed: Volume) -> list[bool]:
    """True for each array of voxels whose gradient is requested, and exists."""
    pairs = zip(voxels_of(volume), voxels_of(perturbed), strict=True)
    return [eqx.is_inexact_array(data) and bool(asked) for data, asked in pairs]


def zero_sums(volume: Volume, asked: list[bool]) -> Sums:
    """Sums of 0, of 32 bits or more: 16 bits would lose small terms."""

    def zeros(array: Array) -> Array:
        return jnp.zeros(array.size, array.dtype if jnp.finfo(array.dtype).bits >= 32 else jnp.float32)

    return [zeros(data) if wanted else None for data, wanted in zip(voxels_of(volume), asked, strict=True)]


def recorded(volume: Volume, perturbations: list[Any]) -> tuple[Volume, list[list[Fetched]]]:
    """The volume with recorded, perturbed fetches; and the lists of fetches, filled while it is traced."""
    parts = grids(volume)
    records = [Recording(changes, []) for changes in perturbations or [[]] * len(parts)]
    pairs = zip(parts, records, strict=True)
    fetches: list[Fetch] = [g.fetch if isinstance(g.fetch, Extent) else record for g, record in pairs]
    return with_fetches(volume, fetches), [record.fetched for record in records]


def check_fetched(volume: Volume, sums: Sums) -> None:
    """Raises `ValueError` if a gradient to voxels is requested that a field reads without interpolation: that
    gradient would be lost."""
    if volume.field is None:
        return
    like = [None if a is None else jax.ShapeDtypeStruct(a.shape, a.dtype) for a in voxels_of(volume)]
    fetches: list[Fetch] = [g.fetch if isinstance(g.fetch, Extent) else Zeros() for g in grids(volume)]

    def value(data: list[Any], at: PyTree) -> PyTree:
        return with_fetches(with_voxels(volume, data), fetches).value(at)

    place = (jax.ShapeDtypeStruct((), volume.spacing.dtype),) * 3
    program = jax.make_jaxpr(value)(like, place).jaxpr
    uses = {id(variable) for step in program.eqns for variable in step.invars}
    uses |= set(map(id, program.outvars))
    asked = [sum_ is not None for sum_, data in zip(sums, like, strict=True) if data is not None]
    if any(wanted and id(of) in uses for wanted, of in zip(asked, program.invars, strict=False)):
        raise ValueError(
            f"volume.field: {type(volume.field).__name__} reads voxels without interpolation; got"
            ' adjoint="replay", which has no gradient to such voxels. Pass adjoint="direct", or do not'
            " differentiate with respect to volume.data."
        )


def zero_perturbations(
    volume: Volume, fetched: list[list[Fetched]], sums: Sums, dtype: jnp.dtype[Any]
) -> list[Any]:
    """Perturbations of 0 for all fetches with a requested gradient. They vary over shards as the sums do:
    `jax.shard_map` would sum cotangents of values that do not vary."""
    parts = zip(voxels_of(volume), fetched, sums, strict=True)
    zeros = [[] if sum_ is None else perturbations_of(data, reads, dtype) for data, reads, sum_ in parts]
    return varying(zeros, sums)


def with_cotangents(sums: Sums, volume: Volume, fetched: list[list[Fetched]], cotangents: list[Any]) -> Sums:
    """The sums plus the cotangents of all fetches."""
    parts = zip(sums, voxels_of(volume), fetched, cotangents, strict=True)
    return [None if s is None else scatter_add(s, data.shape, reads, bars) for s, data, reads, bars in parts]


def cotangents_of(volume: Volume, sums: Sums) -> list[Array | None]:
    """The sums, in shape and type of the arrays of voxels."""
    pairs = zip(sums, voxels_of(volume), strict=True)
    return [None if sum_ is None else sum_.reshape(data.shape).astype(data.dtype) for sum_, data in pairs]
