"""Scattering medium at a point of the world: that of `path_trace`, with soft edges of materials."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from .._util.vec3 import Scalar, Vec3
from .materials import Material, shares
from .shading import Surroundings


FADE = 0.02
"""Materials fade over this fraction of the narrowest value range, so that their edges have derivatives."""


class Scattering(NamedTuple):
    """Scattering properties at a point.

    Attributes:
        extinction: 1/length; 0 where nothing is visible.
        albedo: single-scattering albedo, (r, g, b).
    """

    extinction: Scalar
    albedo: Vec3


def scattering_at(around: Surroundings, materials: tuple[Material, ...], point: Vec3) -> Scattering:
    """Scattering properties at a world point. In a material of mean free path λ and opacity α, the extinction
    is 1/λ and the albedo is the colour times 1 - α; elsewhere, they are the transfer function's extinction
    and colour. Where the transfer function shows nothing, the extinction is 0."""
    measured = around.measured(point)
    classified = around.classified(point, measured)
    color, extinction = around.classification.classify(measured)
    fractions = shares(materials, around.volume, classified.coordinate, classified.value, edge=FADE)
    rate, remaining, kept = jnp.zeros_like(extinction), jnp.ones_like(extinction), jnp.ones_like(extinction)
    for fraction, material in zip(fractions, materials, strict=True):
        rate = rate + fraction / material.mean_free_path
        remaining = remaining - fraction
        kept = kept - fraction * material.opacity
    rate = rate + remaining * extinction
    r, g, b = (clipped(c) * kept for c in color)
    return Scattering(jnp.where(classified.extinction > 0, rate * classified.inside, 0), (r, g, b))


@jax.custom_jvp
def clipped(albedo: Scalar) -> Scalar:
    """Clip to [0, 1]; the derivative at 0 and 1 is that inside the range."""
    return jnp.clip(albedo, 0, 1)


@clipped.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[Scalar, Scalar]:
    ((albedo,), (tangent,)) = primals, tangents
    return clipped(albedo), jnp.where((albedo >= 0) & (albedo <= 1), tangent, 0)
