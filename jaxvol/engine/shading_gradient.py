"""VJP of shading the visible samples of a segment: `replay` calls it for scenes with lighting."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._util.vec3 import Scalar, Vec3
from ..lighting.shading import Sample, Shader, Surroundings, needed_terms, terms_needed
from ..ray import Scene
from ..scene.space import Ray
from ..scene.volume import read_as
from ..scene.voxel_fetch import Cube, Recording, cubes_of_zeros, scatter_add
from ..xla.compaction import Chosen
from ..xla.sharding import varying
from ..xla.trees import PyTree, added
from .segment import Samples
from .shading import Weights, samples_of


class ShadingTotal(NamedTuple):
    """Gradients summed over all samples; None for what is not asked for."""

    shader: PyTree
    transfer: PyTree | None
    voxels: Float[Array, " voxels"] | None


class ShadingVjp(NamedTuple):
    """Shaded colours of samples, arrays (cells, rays), and cotangents; 0 for invisible samples."""

    color: Vec3
    of_color: Vec3
    of_extinction: Scalar
    of_value: Scalar
    of_place: tuple[Vec3, Vec3]


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
    """Pulls back the `cotangents` of the shaded colours of a segment's samples, and adds to the total."""
    chosen = Chosen.of([weight > 0 for weight in weights.weight], chunk)
    size = sum(weight.size for weight in weights.weight)

    def one(
        indices: Int[Array, " chunk"], carry: tuple[ShadingVjp, ShadingTotal]
    ) -> tuple[ShadingVjp, ShadingTotal]:
        found, total = carry
        some = samples_of(chosen, indices, scene, ray, samples.cells, samples.measured, weights)
        real = indices < size
        red, green, blue = (jnp.where(real, each, 0) for each in chosen.take(cotangents, indices))
        color, of_sample, total = _chunk_vjp(shader, some, (red, green, blue), total)
        place = of_sample.point, of_sample.direction
        vjp = ShadingVjp(color, of_sample.color, of_sample.extinction, of_sample.measured[0], place)
        return chosen.put(found, indices, vjp), total

    zero = jnp.zeros(size, weights.weight[0].dtype)
    zeros = zero, zero, zero
    start = ShadingVjp(zeros, zeros, zero, zero, (zeros, zeros))
    found, total = chosen.fold(one, (start, total))
    return chosen.split(found, len(weights.weight)), total


class _ShadingInputs(NamedTuple):
    """What shaded colours are differentiated by (shader and transfer function; samples; what all terms of a
    sample share), or its cotangents."""

    leaves: PyTree
    samples: PyTree
    shared: PyTree = None


def _chunk_vjp(
    shader: Shader, samples: Sample, cotangent: Vec3, total: ShadingTotal
) -> tuple[Vec3, PyTree, ShadingTotal]:
    """The shaded colours of many samples, the cotangents of the samples, and the new total. Each term has the
    cotangent of the terms' sum: they are pulled back one by one, and nothing is kept of them."""
    (leaves, fixed_leaves), (moving, fixed) = (
        eqx.partition(tree, eqx.is_inexact_array)
        for tree in ((shader.leaves, shader.around.transfer), samples)
    )

    def rebuilt(inputs: _ShadingInputs) -> tuple[Shader, Sample]:
        leaves, transfer = eqx.combine(inputs.leaves, fixed_leaves)
        return shader.with_leaves(leaves, transfer), eqx.combine(inputs.samples, fixed)

    def begin(leaves: PyTree, samples: PyTree) -> tuple[PyTree, PyTree]:
        (shading, around), each = rebuilt(_ShadingInputs(leaves, samples))
        return eqx.partition(jax.vmap(partial(shading.begin, around))(each), eqx.is_inexact_array)

    shared, pull_begin, fixed_shared = jax.vjp(begin, leaves, moving, has_aux=True)
    inputs = _ShadingInputs(leaves, moving, shared)

    def color(inputs: _ShadingInputs, sums: PyTree) -> Vec3:
        (shading, _), each = rebuilt(inputs)
        return jax.vmap(shading.color)(each, eqx.combine(inputs.shared, fixed_shared), sums)

    shading, around = shader
    sums = needed_terms(shading, around, samples, eqx.combine(shared, fixed_shared))
    colors, pull_color = jax.vjp(color, inputs, sums)
    of_inputs, of_sums = pull_color(cotangent)

    def term(
        inputs: _ShadingInputs, perturbations: list[Cube] | None, number: Int[Array, ""]
    ) -> tuple[PyTree, list[Array]]:
        (shading, around), each = rebuilt(inputs)

        def one(sample: Sample, shared: PyTree, perturbations: list[Cube] | None) -> tuple[PyTree, Any]:
            if perturbations is None:
                return shading.term(around.in_memory_by(number >= 0, sample), sample, shared, number), []
            record = Recording(perturbations, [])
            here = Surroundings(read_as(around.volume, record), around.transfer, around.space)
            return shading.term(here, sample, shared, number), record.bases

        return jax.vmap(one)(each, eqx.combine(inputs.shared, fixed_shared), perturbations)

    def add(number: Int[Array, ""], carry: tuple[_ShadingInputs, PyTree]) -> tuple[_ShadingInputs, PyTree]:
        of_inputs, voxels = carry
        _, pull, bases = jax.vjp(partial(term, number=number), inputs, perturbations, has_aux=True)
        more, of_cubes = pull(of_sums)
        if voxels is not None:
            voxels = scatter_add(voxels, shader.around.volume.shape, bases, of_cubes)
        return added(of_inputs, more), voxels

    perturbations, voxels = None, total.voxels
    if shading.terms > 0:
        if voxels is not None:
            _, bases = jax.eval_shape(term, inputs, [], jnp.zeros((), jnp.int32))
            perturbations = cubes_of_zeros(bases, cotangent[0].dtype)
        needed = terms_needed(shading, samples.transmittance)
        start = varying((of_inputs, voxels), samples)
        of_inputs, voxels = jax.lax.fori_loop(0, needed, add, start)
    more_of_leaves, more_of_samples = pull_begin(of_inputs.shared)
    of_shader, of_transfer = added(of_inputs.leaves, more_of_leaves)
    total = ShadingTotal(added(total.shader, of_shader), added(total.transfer, of_transfer), voxels)
    return colors, added(of_inputs.samples, more_of_samples), total
