"""Shades samples where they are, for shading that costs less than to gather the visible ones.

Its one term is computed for all samples of a segment in a branch of its own, from where they are; its colours
are then elementwise.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.vec3 import Vec3, along
from ..compositing.selection import Selection
from ..lighting.shading import Sample, Shader
from ..march.march import Cell
from ..ray import Scene
from ..scene.space import Ray
from ..scene.volume import with_fetch
from ..xla.memory import in_memory
from ..xla.trees import PyTree


def inline_shader(scene: Scene) -> Shader | None:
    """What shades all samples of a march where they are, if anything does."""
    light = scene.classification.light
    if not isinstance(light, Shader) or isinstance(scene.compositing, Selection):
        return None
    return light if light.shading.inline else None


def light_terms(
    shader: Shader, scene: Scene, live: Bool[Array, ""], ray: Ray, cells: Callable[[], tuple[Cell, ...]]
) -> list[PyTree]:
    """The terms of all samples of cells, arrays (cells, rays), in memory. `live`: see `in_memory`."""
    shading, around = shader
    volume = around.volume

    def begin(ray: Ray, cell: Cell) -> Int[Array, ""]:
        coordinate = around.space.coordinate(_sample(scene, ray, cell).point)
        return volume.fetch.base(volume.data, coordinate)

    def term(ray: Ray, cell: Cell, begin: Int[Array, ""]) -> PyTree:
        sample = _sample(scene, ray, cell)
        here = replace(around, volume=with_fetch(volume, volume.fetch.of_slopes_at(begin)))
        return shading.term(here, sample, shading.about(here, sample), jnp.zeros((), jnp.int32))

    def all_(f: Callable[..., PyTree], *more: list[PyTree]) -> list[PyTree]:
        over_rays = jax.vmap(f, in_axes=(0,) * (2 + len(more)))
        mapped = jax.vmap(over_rays, in_axes=(None, *(0,) * (1 + len(more))))
        return [mapped(ray, *piece) for piece in zip(cells(), *more, strict=True)]

    begins = in_memory(live, partial(all_, begin))
    return in_memory(live, partial(all_, term), begins)


def lit_colors(
    shader: Shader, scene: Scene, ray: Ray, cells: list[Cell], colors: list[Vec3], terms: list[PyTree]
) -> list[Vec3]:
    """The shaded colours of all samples of cells, arrays (cells, rays), from their colours and terms."""
    shading, around = shader

    def one(ray: Ray, cell: Cell, color: Vec3, term: PyTree) -> Vec3:
        sample = _sample(scene, ray, cell)._replace(color=color)
        return shading.color(sample, shading.about(around, sample), term)

    each = jax.vmap(jax.vmap(one), in_axes=(None, 0, 0, 0))
    return [each(ray, *piece) for piece in zip(cells, colors, terms, strict=True)]


def _sample(scene: Scene, ray: Ray, cell: Cell) -> Sample:
    zero, depth = jnp.zeros_like(cell.front), scene.march.sample(cell)
    point = along(ray.entry, ray.direction, depth)
    return Sample(point, ray.direction, (), (zero, zero, zero), zero, zero + 1, ray.pixel)
