"""VJP of shading the visible samples of a segment: `replay` calls it for scenes with lighting."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._util.vec3 import Scalar, Vec3
from ..lighting.shading import Sample, Shader, Shading, Surroundings, needed_terms, terms_needed
from ..ray import Scene
from ..scene.space import Ray
from ..scene.voxel_fetch import Fetched
from ..xla.compaction import Chosen
from ..xla.sharding import varying
from ..xla.trees import PyTree, added
from .segment import Samples
from .shading import Weights, samples_of
from .voxel_gradient import Sums, recorded, with_cotangents, zero_perturbations


class ShadingTotal(NamedTuple):
    """Cotangents summed over all samples; None for parts that are not perturbed."""

    shader: PyTree
    transfer: PyTree | None
    voxels: Sums


class ShadingVjp(NamedTuple):
    """Shaded colours of samples, arrays (cells, rays), and cotangents; 0 for invisible samples."""

    color: Vec3
    of_color: Vec3
    of_extinction: Scalar
    of_value: Scalar
    of_place: tuple[Vec3, Vec3, Vec3]


def shading_vjp(
    shader: Shader,
    scene: Scene,
    ray: Ray,
    samples: Samples,
    weights: Weights,
    cotangents: list[Vec3],
    chunk: int,
    total: ShadingTotal,
) -> tuple[list[ShadingVjp], ShadingTotal]:
    """Pulls back `cotangents` of the shaded colours of a segment's samples; adds to `total`."""
    chosen = Chosen.of([weight > 0 for weight in weights.weight], chunk)
    size = sum(weight.size for weight in weights.weight)
    depths = map(scene.march.sample, samples.cells)
    parts = list(zip(depths, samples.measured, weights.before, strict=True))

    def one(
        indices: Int[Array, " chunk"], carry: tuple[ShadingVjp, ShadingTotal]
    ) -> tuple[ShadingVjp, ShadingTotal]:
        vjps, total = carry
        chunk_samples, real = samples_of(chosen, indices, scene, ray, parts), indices < size
        red, green, blue = (jnp.where(real, channel, 0) for channel in chosen.take(cotangents, indices))
        color, of_sample, total = _chunk_vjp(shader, chunk_samples, (red, green, blue), total)
        place = of_sample.point, of_sample.place, of_sample.direction
        vjp = ShadingVjp(color, of_sample.color, of_sample.extinction, of_sample.measured[0], place)
        return chosen.put(vjps, indices, vjp), total

    zero = jnp.zeros(size, weights.weight[0].dtype)
    zeros = zero, zero, zero
    vjps, total = chosen.fold(one, (ShadingVjp(zeros, zeros, zero, zero, (zeros, zeros, zeros)), total))
    return chosen.split(vjps, len(weights.weight)), total


def _chunk_vjp(
    shader: Shader, samples: Sample, cotangent: Vec3, total: ShadingTotal
) -> tuple[Vec3, PyTree, ShadingTotal]:
    """The shaded colours of samples, the samples' cotangents, and the new total. Each term has the cotangent
    of the terms' sum: terms are pulled back one by one, and none is stored."""
    inputs = (shader.leaves, shader.around.transfer), samples
    moving, fixed = eqx.partition(inputs, eqx.is_inexact_array)

    def rebuilt(moving: PyTree) -> tuple[Shading, Surroundings, Sample]:
        (leaves, transfer), samples = eqx.combine(moving, fixed)
        shading, around = shader.with_leaves(leaves, transfer)
        return shading, around, samples

    def begin(moving: PyTree) -> tuple[PyTree, PyTree]:
        shading, around, samples = rebuilt(moving)
        return eqx.partition(jax.vmap(partial(shading.begin, around))(samples), eqx.is_inexact_array)

    shared, pull_begin, fixed_shared = jax.vjp(begin, moving, has_aux=True)

    def color(moving: PyTree, shared: PyTree, sums: PyTree) -> Vec3:
        shading, around, samples = rebuilt(moving)
        return jax.vmap(Shader(shading, around).color)(samples, eqx.combine(shared, fixed_shared), sums)

    shading, around = shader
    sums = needed_terms(shading, around, samples, eqx.combine(shared, fixed_shared))
    colors, pull_color = jax.vjp(color, moving, shared, sums)
    *of_inputs, of_sums = pull_color(cotangent)

    def term(
        moving: PyTree, shared: PyTree, perturbations: list[Any] | None, number: Int[Array, ""]
    ) -> tuple[PyTree, list[list[Fetched]]]:
        shading, around, samples = rebuilt(moving)

        def one(sample: Sample, shared: PyTree, perturbations: list[Any] | None) -> tuple[PyTree, Any]:
            if perturbations is None:
                return shading.term(around.in_memory_by(number >= 0, sample), sample, shared, number), []
            volume, fetched = recorded(around.volume, perturbations)
            surroundings = Surroundings(volume, around.transfer, around.space)
            return shading.term(surroundings, sample, shared, number), fetched

        return jax.vmap(one)(samples, eqx.combine(shared, fixed_shared), perturbations)

    def add(number: Int[Array, ""], carry: tuple[list[PyTree], PyTree]) -> tuple[list[PyTree], PyTree]:
        of_inputs, voxels = carry
        _, pull, fetched = jax.vjp(partial(term, number=number), moving, shared, perturbations, has_aux=True)
        *of_term, of_fetched = pull(of_sums)
        if perturbations is not None:
            voxels = with_cotangents(voxels, around.volume, fetched, of_fetched)
        return added(of_inputs, of_term), voxels

    perturbations, voxels = None, total.voxels
    if shading.terms > 0:
        if any(sums is not None for sums in voxels):
            _, fetched = jax.eval_shape(term, moving, shared, [], jnp.zeros((), jnp.int32))
            perturbations = zero_perturbations(around.volume, fetched, voxels, cotangent[0].dtype)
        start = varying((of_inputs, voxels), samples)
        needed = terms_needed(shading, samples.transmittance)
        of_inputs, voxels = jax.lax.fori_loop(0, needed, add, start)
    of_moving, of_shared = of_inputs
    (of_shader, of_transfer), of_samples = added(of_moving, *pull_begin(of_shared))
    total = ShadingTotal(added(total.shader, of_shader), added(total.transfer, of_transfer), voxels)
    return colors, of_samples, total
