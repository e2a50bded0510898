"""VJP of shading the visible samples of a segment: `replay` calls it for scenes with lighting.

Shades each sample again, as `visible_samples.shaded_colors` did in the first march.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.trees import PyTree, added
from .._util.vec3 import Scalar, Vec3
from .._util.voxel_fetch import cubes_of_zeros, scatter_add
from ..lighting.shading import Shader, Surroundings, shade_sample
from ..reference import Pipeline
from ..space import Ray
from .segment import Samples
from .visible_samples import Weights, samples_of, visible


class ShadingTotal(NamedTuple):
    """Gradients summed over all samples: of what shades them, of the transfer function, and of the voxels;
    None for what is not asked for."""

    shader: PyTree
    transfer: PyTree | None
    voxels: Float[Array, " voxels"] | None


class ShadingVjp(NamedTuple):
    """Shaded colours of samples, arrays (cells, rays); and the cotangents of their unshaded colour,
    extinction, value and world points. 0 for invisible samples."""

    color: Vec3
    of_color: Vec3
    of_extinction: Scalar
    of_value: Scalar
    of_point: Vec3


def shading_vjp(
    shader: Shader,
    pipeline: Pipeline,
    ray: Ray,
    samples: Samples,
    weights: Weights,
    cotangents: list[Vec3],
    chunk: int,
    total: ShadingTotal,
) -> tuple[list[ShadingVjp], ShadingTotal]:
    """Pulls back the shading of a segment's samples, and adds to the total. `cotangents`: of each piece's
    shaded colour."""
    chosen, around = visible(weights, chunk), shader.around
    size = sum(weight.size for weight in weights.weight)
    moving, fixed = eqx.partition((shader.leaves, around.transfer), eqx.is_inexact_array)

    def one(
        indices: Int[Array, " chunk"], carry: tuple[ShadingVjp, ShadingTotal]
    ) -> tuple[ShadingVjp, ShadingTotal]:
        found, total = carry
        some = samples_of(chosen, indices, pipeline, ray, samples.cells, samples.measured, weights)
        moving_sample, fixed_sample = eqx.partition(some, eqx.is_inexact_array)

        def colors(moving: PyTree, moving_sample: PyTree, perturbations: Any) -> tuple[Vec3, Any]:
            (shading, space), transfer = eqx.combine(moving, fixed)
            here = Surroundings(around.volume, transfer, space)
            each = eqx.combine(moving_sample, fixed_sample)
            return jax.vmap(lambda sample, perturbations: shade_sample(shading, here, sample, perturbations))(
                each, perturbations
            )

        perturbations = None
        if total.voxels is not None:
            _, bases = jax.eval_shape(lambda: colors(moving, moving_sample, []))
            perturbations = cubes_of_zeros(bases, weights.weight[0].dtype)
        color, pull, bases = jax.vjp(colors, moving, moving_sample, perturbations, has_aux=True)
        real = indices < size
        cotangent = tuple(jnp.where(real, part, 0) for part in chosen.take(cotangents, indices))
        (of_shader, of_transfer), of_sample, of_cubes = pull(cotangent)
        voxels = total.voxels
        if voxels is not None:
            voxels = scatter_add(voxels, around.volume.shape, bases, of_cubes)
        total = ShadingTotal(added(total.shader, of_shader), added(total.transfer, of_transfer), voxels)
        part = ShadingVjp(
            color, of_sample.color, of_sample.extinction, of_sample.measured[0], of_sample.point
        )
        return chosen.put(found, indices, part), total

    zero = jnp.zeros(size, weights.weight[0].dtype)
    zeros = zero, zero, zero
    start = ShadingVjp(zeros, zeros, zero, zero, zeros)
    found, total = chosen.fold(one, (start, total))
    return chosen.split(found, len(weights.weight)), total
