"""Gathers the samples of positive weight, and shades them in chunks.

Shading a sample costs many times as much as fetching it, and few samples are visible.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.vec3 import Scalar, Vec3, along
from ..compositing.blending import Composite, Weighting
from ..lighting.shading import Sample, Shader
from ..march.march import Cell
from ..ray import Progress, Scene, stopped
from ..scene.space import Ray
from ..scene.transfer import Measured
from ..xla.compaction import Chosen


class Weights(NamedTuple):
    """Of samples, arrays (cells, rays), one for each piece of a cell: the weight of each, the opacity
    composited before it and with it, and whether the ray was finished before."""

    weight: list[Scalar]
    before: list[Scalar]
    after: list[Scalar]
    finished: list[Bool[Array, "cells rays"]]


def weights_of(scene: Scene, at: Progress, alphas: list[Scalar]) -> Weights:
    """The weights of consecutive cells, from the opacities of their pieces."""
    compositing = scene.compositing
    assert isinstance(compositing, Weighting)
    composite, finished = Composite(at.composite.opacity), at.finished
    found: list[list[tuple[Array, ...]]] = [[] for _ in alphas]
    for k in range(alphas[0].shape[0]):
        for i, alpha in enumerate(alphas):
            before = composite.opacity
            weight = jnp.where(finished, 0, compositing.weight(alpha[k], before))
            composite = composite.add(weight)
            found[i].append((weight, before, composite.opacity, finished))
        finished |= jax.vmap(partial(stopped, scene))(composite)
    each = [[jnp.stack(parts) for parts in zip(*pieces, strict=True)] for pieces in found]
    return Weights(*(list(parts) for parts in zip(*each, strict=True)))


def visible(weights: Weights, chunk: int) -> Chosen:
    """The samples of positive weight."""
    return Chosen.of([weight > 0 for weight in weights.weight], chunk)


def samples_of(
    chosen: Chosen,
    indices: Int[Array, " chunk"],
    scene: Scene,
    ray: Ray,
    cells: list[Cell],
    measured: list[Measured],
    weights: Weights,
) -> Sample:
    """The samples at these flat indices of a segment."""
    entry, direction, pixel = jax.tree.map(
        lambda leaf: leaf.at[indices % chosen.columns].get(mode="clip"), (ray.entry, ray.direction, ray.pixel)
    )
    depths = [scene.march.sample(cell) for cell in cells]
    depth, read, before = chosen.take(list(zip(depths, measured, weights.before, strict=True)), indices)
    color, extinction = jax.vmap(scene.classification.of_cells)(read)
    transmittance = scene.compositing.transmittance(Composite(before))
    return Sample(along(entry, direction, depth), direction, read, color, extinction, transmittance, pixel)


def shaded_colors(
    scene: Scene,
    chunk: int,
    ray: Ray,
    at: Progress,
    cells: list[Cell],
    measured: list[Measured],
    alphas: list[Scalar],
) -> list[Vec3]:
    """Shaded colours of a segment's samples; any finite ones for invisible samples."""
    weights, light = weights_of(scene, at, alphas), scene.classification.light
    assert isinstance(light, Shader)
    none, shown = jnp.zeros_like(alphas[0]), [weight > 0 for weight in weights.weight]
    dark = [(none, none, none)] * len(alphas)
    if light.shading.has_dark_samples:
        shown, dark = _apart_from_dark(scene, light, ray, cells, measured, weights)
    chosen = Chosen.of(shown, chunk)

    def one(indices: Int[Array, " chunk"], colors: Vec3) -> Vec3:
        samples = samples_of(chosen, indices, scene, ray, cells, measured, weights)
        return chosen.put(colors, indices, light(samples))

    start = jax.tree.map(lambda *each: jnp.concatenate(each).reshape(-1), *dark)
    return chosen.split(chosen.fold(one, start), len(alphas))


def _apart_from_dark(
    scene: Scene,
    light: Shader,
    ray: Ray,
    cells: list[Cell],
    measured: list[Measured],
    weights: Weights,
) -> tuple[list[Bool[Array, "cells rays"]], list[Vec3]]:
    """Which samples of a segment are visible and need light; and the colours that all would have without.
    Behind the first few samples most are dark, and these cost much less here than gathered."""
    least = light.shading.thresholds()[0]

    def one(ray: Ray, cell: Cell, measured: Measured, before: Scalar) -> tuple[Vec3, Bool[Array, ""]]:
        point = along(ray.entry, ray.direction, scene.march.sample(cell))
        color, extinction = scene.classification.of_cells(measured)
        transmittance = scene.compositing.transmittance(Composite(before))
        sample = Sample(point, ray.direction, measured, color, extinction, transmittance, ray.pixel)
        return light.shading.dark(light.around, sample), transmittance < least

    each = jax.vmap(jax.vmap(one), in_axes=(None, 0, 0, 0))
    found = [each(ray, *piece) for piece in zip(cells, measured, weights.before, strict=True)]
    shown = [(weight > 0) & ~dark for weight, (_, dark) in zip(weights.weight, found, strict=True)]
    return shown, [color for color, _ in found]
