"""What scatters light at a point of the world, and how often? The medium of `path_trace`, with soft edges."""

from typing import NamedTuple

import jax.numpy as jnp

from .._util.vec3 import Scalar, Vec3, scaled
from .materials import EDGE, Material, shares
from .shading import Surroundings


class Scattering(NamedTuple):
    """How light is scattered at a point.

    Attributes:
        extinction: 1/length; 0 where nothing is visible.
        albedo: of single scattering, (r, g, b).
        rate: the extinction, without its fall to 0 at the volume's faces; along a flight from here,
            collisions are proposed at this rate.
    """

    extinction: Scalar
    albedo: Vec3
    rate: Scalar


def scattering_at(around: Surroundings, materials: tuple[Material, ...], point: Vec3) -> Scattering:
    """How light is scattered at a world point: in a material of mean free path λ and opacity α, the
    extinction is 1/λ and the albedo the colour times 1 - α; elsewhere, they are the transfer function's
    extinction and colour. Where the transfer function shows nothing, there is nothing."""
    measured = around.measured(point)
    there = around.classified(point, measured)
    color, own = around.classification.classify(measured)
    fractions = shares(materials, around.volume, there.coordinate, there.value, edge=EDGE)
    rate, rest, kept = jnp.zeros_like(own), jnp.ones_like(own), jnp.ones_like(own)
    for fraction, material in zip(fractions, materials, strict=True):
        rate = rate + fraction / material.mean_free_path
        rest = rest - fraction
        kept = kept - fraction * material.opacity
    rate = rate + rest * own
    visible = there.extinction > 0
    r, g, b = scaled(color, kept)
    albedo = jnp.clip(r, 0, 1), jnp.clip(g, 0, 1), jnp.clip(b, 0, 1)
    return Scattering(jnp.where(visible, rate * there.inside, 0), albedo, jnp.where(visible, rate, 0))
