"""What scatters light at a point of the world, and how often? The medium of `path_trace`, with soft edges."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from .._util.vec3 import Scalar, Vec3
from .materials import Material, shares
from .shading import Surroundings


FADE = 0.02
"""Materials fade over this part of the narrowest value range, so that their edges have derivatives."""


class Scattering(NamedTuple):
    """How light is scattered at a point.

    Attributes:
        extinction: 1/length; 0 where nothing is visible.
        albedo: of single scattering, (r, g, b).
    """

    extinction: Scalar
    albedo: Vec3


def scattering_at(around: Surroundings, materials: tuple[Material, ...], point: Vec3) -> Scattering:
    """How light is scattered at a world point: in a material of mean free path λ and opacity α, the
    extinction is 1/λ and the albedo the colour times 1 - α; elsewhere, they are the transfer function's
    extinction and colour. Where the transfer function shows nothing, there is nothing."""
    measured = around.measured(point)
    there = around.classified(point, measured)
    color, own = around.classification.classify(measured)
    fractions = shares(materials, around.volume, there.coordinate, there.value, edge=FADE)
    rate, rest, kept = jnp.zeros_like(own), jnp.ones_like(own), jnp.ones_like(own)
    for fraction, material in zip(fractions, materials, strict=True):
        rate = rate + fraction / material.mean_free_path
        rest = rest - fraction
        kept = kept - fraction * material.opacity
    rate = rate + rest * own
    visible = there.extinction > 0
    r, g, b = (clipped(c) * kept for c in color)
    return Scattering(jnp.where(visible, rate * there.inside, 0), (r, g, b))


@jax.custom_jvp
def clipped(albedo: Scalar) -> Scalar:
    """Clipped to [0, 1]; the derivative at 0 and 1 is that of the inside."""
    return jnp.clip(albedo, 0, 1)


@clipped.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[Scalar, Scalar]:
    ((albedo,), (tangent,)) = primals, tangents
    return clipped(albedo), jnp.where((albedo >= 0) & (albedo <= 1), tangent, 0)
