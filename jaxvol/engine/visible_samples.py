"""Gathers the samples of positive weight, and shades them in chunks.

Shading a sample costs many times as much as fetching it, and few samples are visible.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.compaction import Chosen
from .._util.vec3 import Scalar, Vec3, along
from ..compositing import Composite, Weighting
from ..lighting.shading import Sample
from ..march import Cell
from ..reference import Pipeline, Progress, stopped
from ..space import Ray
from ..transfer import Measured


class Weights(NamedTuple):
    """Of samples, arrays (cells, rays), one for each piece of a cell: the weight of each, the opacity
    composited before it and with it, and whether the ray was finished before."""

    weight: list[Scalar]
    before: list[Scalar]
    after: list[Scalar]
    finished: list[Bool[Array, "cells rays"]]


def weights_of(pipeline: Pipeline, at: Progress, alphas: list[Scalar]) -> Weights:
    """The weights of consecutive cells, from the opacities of their pieces."""
    compositing = pipeline.compositing
    assert isinstance(compositing, Weighting)
    composite, finished = Composite(at.composite.opacity), at.finished
    found: list[list[tuple[Array, ...]]] = [[] for _ in alphas]
    for k in range(alphas[0].shape[0]):
        for i, alpha in enumerate(alphas):
            before = composite.opacity
            weight = jnp.where(finished, 0, compositing.weight(alpha[k], before))
            composite = composite.add(weight)
            found[i].append((weight, before, composite.opacity, finished))
        finished |= jax.vmap(partial(stopped, pipeline))(composite)
    each = [[jnp.stack(parts) for parts in zip(*pieces, strict=True)] for pieces in found]
    return Weights(*(list(parts) for parts in zip(*each, strict=True)))


def visible(weights: Weights, chunk: int) -> Chosen:
    """The samples of positive weight."""
    return Chosen.of([weight > 0 for weight in weights.weight], chunk)


def samples_of(
    chosen: Chosen,
    indices: Int[Array, " chunk"],
    pipeline: Pipeline,
    ray: Ray,
    cells: list[Cell],
    measured: list[Measured],
    weights: Weights,
) -> Sample:
    """The samples at these flat indices of a segment."""
    entry, direction, pixel = jax.tree.map(
        lambda leaf: leaf.at[indices % chosen.columns].get(mode="clip"), (ray.entry, ray.direction, ray.pixel)
    )
    depths = [pipeline.march.sample(cell) for cell in cells]
    depth, read, before = chosen.take(list(zip(depths, measured, weights.before, strict=True)), indices)
    color, extinction = jax.vmap(pipeline.classification.of_cells)(read)
    transmittance = pipeline.compositing.transmittance(Composite(before))
    return Sample(along(entry, direction, depth), direction, read, color, extinction, transmittance, pixel)


def shaded_colors(
    pipeline: Pipeline,
    chunk: int,
    ray: Ray,
    at: Progress,
    cells: list[Cell],
    measured: list[Measured],
    alphas: list[Scalar],
) -> list[Vec3]:
    """Shaded colours of a segment's samples; 0 for invisible ones."""
    weights, light = weights_of(pipeline, at, alphas), pipeline.classification.light
    chosen = visible(weights, chunk)
    assert light is not None

    def one(indices: Int[Array, " chunk"], colors: Vec3) -> Vec3:
        samples = samples_of(chosen, indices, pipeline, ray, cells, measured, weights)
        return chosen.put(colors, indices, light(samples))

    none = jnp.zeros(sum(alpha.size for alpha in alphas), alphas[0].dtype)
    return chosen.split(chosen.fold(one, (none, none, none)), len(alphas))
