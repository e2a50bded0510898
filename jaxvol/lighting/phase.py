"""The Henyey–Greenstein phase function: the direction of light after a scattering."""

import math

import jax.numpy as jnp

from .._util.vec3 import Scalar, Vec3, turned


def phase(cosine: Scalar, anisotropy: Scalar) -> Scalar:
    """Density, per solid angle, of the direction after a scattering, by the cosine between the directions of
    travel before and after. Source: Henyey and Greenstein 1941."""
    g = anisotropy
    # written so that it stays positive where g and the cosine are both near 1
    squared = (1 - g) * (1 - g) + 2 * g * (1 - cosine)
    return (1 - g * g) / (4 * math.pi * squared * jnp.sqrt(squared))


def sample_phase(anisotropy: Scalar, first: Scalar, second: Scalar) -> Vec3:
    """Draw a unit direction from `phase` around the z axis, from two uniform numbers in [0, 1)."""
    # the usual inverse, (1 + g² - ((1 - g²) / (1 - g + 2 g u))²) / 2 g, multiplied out, for g near 0
    g, x = anisotropy, 2 * first - 1
    numerator = x + g * ((3 + x * x) / 2 + g * (x - g * (1 - x * x) / 2))
    cosine = jnp.clip(numerator / jnp.square(1 + g * x), -1, 1)
    sine = jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0))
    angle = 2 * math.pi * second
    return sine * jnp.cos(angle), sine * jnp.sin(angle), cosine


def scattered(around_z: Vec3, direction: Vec3) -> Vec3:
    """Turn a direction by a draw of `sample_phase`. Renormalized to first order, or errors would add up."""
    x, y, z = turned(around_z, direction)
    scale = (3 - (x * x + y * y + z * z)) / 2  # 1 / sqrt(n), to first order around 1
    return x * scale, y * scale, z * scale
