"""How does a gradient reach the voxels? Each sample's cotangent is added to the voxels that it was read from.

JAX would make an array like the voxels for each segment, to add them up. Here each fetch is recorded, with a
perturbation of 0, whose cotangent is added in place. A volume has several arrays of voxels if its field holds
others (`scene.volume.grids`): lists here have one entry for each, None where no gradient is asked for.
"""

from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..scene.volume import Volume, grids, voxels_of, with_fetches, with_voxels
from ..scene.voxel_fetch import Extent, Fetch, Fetched, Recording, Zeros, perturbations_of, scatter_add
from ..xla.sharding import varying


Sums: TypeAlias = list[Array | None]
"""Of the numbers of each array, flattened."""


def asked_of(volume: Volume, perturbed: Volume) -> list[bool]:
    """Of which arrays of voxels the gradient is asked for, and exists."""
    each = zip(voxels_of(volume), voxels_of(perturbed), strict=True)
    return [eqx.is_inexact_array(data) and bool(asked) for data, asked in each]


def zero_sums(volume: Volume, asked: list[bool]) -> Sums:
    """Sums of 0. Many small parts are summed, which 16 bits would lose."""

    def zeros(data: Any) -> Array:
        return jnp.zeros(data.size, data.dtype if jnp.finfo(data.dtype).bits >= 32 else jnp.float32)

    return [zeros(data) if a else None for data, a in zip(voxels_of(volume), asked, strict=True)]


def recorded(volume: Volume, perturbations: list[Any]) -> tuple[Volume, list[list[Fetched]]]:
    """The volume, whose fetches are recorded and perturbed; and the lists that this fills while tracing."""
    own = grids(volume)
    records = [Recording(each, []) for each in perturbations or [[]] * len(own)]
    each = zip(own, records, strict=True)
    fetches: list[Fetch] = [g.fetch if isinstance(g.fetch, Extent) else record for g, record in each]
    return with_fetches(volume, fetches), [record.fetched for record in records]


def check_fetched(volume: Volume, sums: Sums) -> None:
    """Raises `ValueError` where a field reads voxels otherwise than by interpolation, and the gradient to
    these, which would be lost, is asked for."""
    if volume.field is None:
        return
    own, kind = grids(volume), type(volume.field).__name__
    data = voxels_of(volume)
    like = [None if each is None else jax.ShapeDtypeStruct(each.shape, each.dtype) for each in data]
    fetches: list[Fetch] = [g.fetch if isinstance(g.fetch, Extent) else Zeros() for g in own]

    def value(data: list[Any], at: Any) -> Any:
        return with_fetches(with_voxels(volume, data), fetches).value(at)

    place = (jax.ShapeDtypeStruct((), volume.spacing.dtype),) * 3
    program = jax.make_jaxpr(value)(like, place).jaxpr
    read = [*program.outvars, *(variable for step in program.eqns for variable in step.invars)]
    asked = [sum_ is not None for sum_, data in zip(sums, like, strict=True) if data is not None]
    if any(a and any(each is of for each in read) for a, of in zip(asked, program.invars, strict=False)):
        raise ValueError(
            f"the gradient to the voxels of a volume with the field {kind}, which reads them otherwise than"
            ' by interpolation, is not known to adjoint="replay": pass adjoint="direct", or leave these'
            " voxels (volume.data) out of what is differentiated."
        )


def zero_perturbations(volume: Volume, fetched: list[list[Fetched]], sums: Sums, dtype: Any) -> list[Any]:
    """Perturbations of 0 of what was fetched, where its gradient is asked for: varying as the sums do, since
    inside `jax.shard_map` the cotangents of what does not vary are summed over the shards."""
    each = zip(voxels_of(volume), fetched, sums, strict=True)
    zeros = [[] if sum_ is None else perturbations_of(data, found, dtype) for data, found, sum_ in each]
    return varying(zeros, sums)


def with_cotangents(sums: Sums, volume: Volume, fetched: list[list[Fetched]], cotangents: list[Any]) -> Sums:
    """The sums with the cotangents of what was fetched."""
    each = zip(sums, voxels_of(volume), fetched, cotangents, strict=True)
    return [
        None if sum_ is None else scatter_add(sum_, data.shape, found, of) for sum_, data, found, of in each
    ]


def cotangents_of(volume: Volume, sums: Sums) -> list[Array | None]:
    """The sums, like the arrays of voxels."""
    each = zip(sums, voxels_of(volume), strict=True)
    return [None if sum_ is None else sum_.reshape(data.shape).astype(data.dtype) for sum_, data in each]
