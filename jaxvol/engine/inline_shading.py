"""Shades samples where they are, for shading that costs less than to gather the visible ones.

Its one term is computed for all samples of a segment in a branch of its own, from where they are; its colours
are then elementwise.
"""

import jax.numpy as jnp

from .._util.trees import PyTree
from .._util.vec3 import Vec3, along
from ..lighting.shading import Sample, Shader
from ..march import Cell
from ..reference import Pipeline
from ..selection import Selection
from ..space import Ray


def inline_shader(pipeline: Pipeline) -> Shader | None:
    """What shades all samples of a march where they are, if anything does."""
    light = pipeline.classification.light
    inline = isinstance(light, Shader) and light.shading.inline
    return light if inline and not isinstance(pipeline.compositing, Selection) else None


def light_term(shader: Shader, pipeline: Pipeline, ray: Ray, cell: Cell) -> PyTree:
    """The term of a sample."""
    zero, (shading, around) = jnp.zeros_like(cell.front), shader
    sample = _sample(pipeline, ray, cell, (zero, zero, zero))
    return shading.term(around, sample, shading.about(around, sample), jnp.zeros((), jnp.int32))


def lit_color(shader: Shader, pipeline: Pipeline, ray: Ray, cell: Cell, color: Vec3, term: PyTree) -> Vec3:
    """The shaded colour of a sample, from its colour and its term."""
    shading, around = shader
    sample = _sample(pipeline, ray, cell, color)
    return shading.color(sample, shading.about(around, sample), term)


def _sample(pipeline: Pipeline, ray: Ray, cell: Cell, color: Vec3) -> Sample:
    zero, depth = jnp.zeros_like(cell.front), pipeline.march.sample(cell)
    point = along(ray.entry, ray.direction, depth)
    return Sample(point, ray.direction, (), color, zero, zero + 1, ray.pixel)
