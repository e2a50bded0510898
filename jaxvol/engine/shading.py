"""Shades the samples of a segment: only those of positive weight, gathered in chunks, since they are few and
shading is expensive; or all samples inline, if the shader has one cheap term."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.vec3 import Scalar, Vec3, along
from ..compositing.blending import Composite, Weighting
from ..compositing.selection import Selection
from ..lighting.shading import Sample, Shader, no_terms
from ..march.march import Cell
from ..ray import Progress, Scene, reweigh, stop
from ..scene.space import Ray
from ..scene.transfer import Measured
from ..scene.volume import fetches_of, with_fetches
from ..xla.compaction import Chosen
from ..xla.memory import in_memory
from ..xla.trees import PyTree, with_fields
from .rays import vmap_cells


# ---------------------------------------------------------------- inline


def inline_shader(scene: Scene) -> Shader | None:
    """The shader of all samples of a march, if it is inline."""
    light = scene.classification.light
    if not isinstance(light, Shader) or isinstance(scene.compositing, Selection):
        return None
    return light if light.inline else None


def light_terms(
    shader: Shader, scene: Scene, live: Bool[Array, ""], ray: Ray, cells: Callable[[], tuple[Cell, ...]]
) -> list[PyTree]:
    """The terms of all samples of cells, arrays (cells, rays), in memory."""
    shading, around = shader
    volume = around.volume

    def begin(ray: Ray, cell: Cell) -> Int[Array, ""]:
        coordinate = around.space.local.coordinate(along(ray.entry, ray.direction, scene.march.sample(cell)))
        return volume.fetch.place(volume.data, coordinate)[0]

    def term(ray: Ray, cell: Cell, begin: Int[Array, ""]) -> PyTree:
        sample = _inline_sample(scene, ray, cell)
        first, *inner = fetches_of(volume)
        near = replace(around, volume=with_fetches(volume, [first.of_slopes_at(begin), *inner]))
        return shading.term(near, sample, shading.begin(near, sample), jnp.zeros((), jnp.int32))

    def all_(f: Callable[..., PyTree], *extra: list[PyTree]) -> list[PyTree]:
        mapped = vmap_cells(f, (False, True, *(True for _ in extra)))
        return [mapped(ray, *piece) for piece in zip(cells(), *extra, strict=True)]

    begins = in_memory(live, partial(all_, begin))
    return in_memory(live, partial(all_, term), begins)


def lit_colors(
    shader: Shader, scene: Scene, ray: Ray, cells: list[Cell], colors: list[Vec3], terms: list[PyTree]
) -> list[Vec3]:
    """The shaded colours of all samples of cells, from their colours and terms."""
    shading, around = shader

    def one(ray: Ray, cell: Cell, color: Vec3, term: PyTree) -> Vec3:
        sample = _inline_sample(scene, ray, cell)._replace(color=color)
        return shader.color(sample, shading.begin(around, sample), term)

    shade = vmap_cells(one, (False, True, True, True))
    return [shade(ray, *piece) for piece in zip(cells, colors, terms, strict=True)]


def _inline_sample(scene: Scene, ray: Ray, cell: Cell) -> Sample:
    """The place of a sample. Its value, colour and extinction would take time: NaN."""
    depth, unknown = scene.march.sample(cell), jnp.full_like(cell.front, jnp.nan)
    place, color = along(ray.entry, ray.direction, depth), (unknown, unknown, unknown)
    point, one = scene.space.world(place), jnp.ones_like(unknown)
    return Sample(point, ray.direction, (), color, unknown, one, ray.pixel, place)


# ---------------------------------------------------------------- visible samples


class Weights(NamedTuple):
    """Weights of samples, opacity before and after them, whether the ray was finished before, and the factor
    in the weight by `roulette`, if any: one array (cells, rays) per piece of a cell."""

    weight: list[Scalar]
    before: list[Scalar]
    after: list[Scalar]
    finished: list[Bool[Array, "cells rays"]]
    factor: list[Scalar | None]


def weights_of(scene: Scene, ray: Ray, at: Progress, alphas: list[Scalar]) -> Weights:
    compositing = scene.compositing
    assert isinstance(compositing, Weighting)
    at = with_fields(at, composite=Composite(at.composite.opacity, factor=at.composite.factor))
    steps: list[list[PyTree]] = [[] for _ in alphas]
    for k in range(alphas[0].shape[0]):
        for i, alpha in enumerate(alphas):
            composite, finished = at.composite, at.finished
            before, factor = composite.opacity, composite.factor
            weight = jnp.where(finished, 0, compositing.weight(alpha[k], before))
            at = with_fields(at, composite=composite.add(weight))
            weight = weight if factor is None else weight * factor
            steps[i].append((weight, before, at.composite.opacity, finished, factor))
        opacities = [alpha[k] for alpha in alphas]
        at = jax.vmap(partial(reweigh, scene, ahead=k))(ray, at, opacities)
        at = jax.vmap(partial(stop, scene))(at)
    stacked = [jax.tree.map(lambda *leaves: jnp.stack(leaves), *pieces) for pieces in steps]
    return Weights(*(list(values) for values in zip(*stacked, strict=True)))


Parts: TypeAlias = list[tuple[Scalar, Measured, Scalar]]
"""Depth, measured values, and the opacity before, of each piece of a cell; arrays (cells, rays)."""


def _sample(scene: Scene, ray: PyTree, depth: Scalar, measured: Measured, opacity: Scalar) -> Sample:
    """The sample at `depth` along a ray (entry, direction, pixel), behind `opacity`."""
    entry, direction, pixel = ray
    color, extinction = scene.classification.of_cells(measured)
    transmittance = scene.compositing.transmittance(Composite(opacity))
    place = along(entry, direction, depth)
    point = scene.space.world(place)
    shown = cast(Vec3, color)  # light needs three
    return Sample(point, direction, measured, shown, extinction, transmittance, pixel, place)


def samples_of(chosen: Chosen, indices: Int[Array, " chunk"], scene: Scene, ray: Ray, parts: Parts) -> Sample:
    """The samples at these flat indices of a segment."""
    column, of_rays = indices % chosen.columns, (ray.entry, ray.direction, ray.pixel)
    of_rays = jax.tree.map(lambda leaf: leaf.at[column].get(mode="clip"), of_rays)
    return jax.vmap(partial(_sample, scene))(of_rays, *chosen.take(parts, indices))


def shaded_colors(
    scene: Scene,
    chunk: int,
    ray: Ray,
    at: Progress,
    cells: list[Cell],
    measured: list[Measured],
    alphas: list[Scalar],
) -> list[Vec3]:
    """Shaded colours of a segment's samples; arbitrary finite ones for invisible samples."""
    weights, light = weights_of(scene, ray, at, alphas), scene.classification.light
    assert isinstance(light, Shader)
    (shading, around), thresholds = light, light.shading.thresholds()
    none = jnp.zeros_like(alphas[0])
    start, shown = [(none, none, none)] * len(alphas), [weight > 0 for weight in weights.weight]
    parts: Parts = list(zip(map(scene.march.sample, cells), measured, weights.before, strict=True))

    if shading.skips_hidden and thresholds is not None:

        def without_terms(ray: Ray, *part: Any) -> tuple[Vec3, Bool[Array, ""]]:
            """The colour of a sample without any term of light, and whether it needs one."""
            sample = _sample(scene, (ray.entry, ray.direction, ray.pixel), *part)
            shared = shading.begin(around, sample)
            color = light.color(sample, shared, no_terms(shading, around, sample, shared))
            return color, ~(sample.transmittance < thresholds[0])

        shade = vmap_cells(without_terms, (False, True, True, True))
        unlit = [shade(ray, *part) for part in parts]
        start = [color for color, _ in unlit]
        shown = [weight & lit for weight, (_, lit) in zip(shown, unlit, strict=True)]
    chosen = Chosen.of(shown, chunk)

    def one(indices: Int[Array, " chunk"], colors: Vec3) -> Vec3:
        return chosen.put(colors, indices, light(samples_of(chosen, indices, scene, ray, parts)))

    flat = jax.tree.map(lambda *leaves: jnp.concatenate(leaves).reshape(-1), *start)
    return chosen.split(chosen.fold(one, flat), len(alphas))
