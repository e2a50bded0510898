"""Radiance by direction, as real spherical harmonics up to order 2."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._util.vec3 import Scalar, Vec3


def harmonics(direction: Vec3, order: int) -> list[Scalar]:
    """The real spherical harmonics of a unit direction, of order 0, or of all up to 2, orthonormal over the
    sphere."""
    x, y, z = direction
    constant = [jnp.full_like(x, math.sqrt(1 / (4 * math.pi)))]
    if order == 0:
        return constant
    first, second = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    return [
        *constant,
        *(first * each for each in (x, y, z)),
        *(second * each for each in (x * y, y * z, z * x)),
        second / 2 * (x * x - y * y),
        second / math.sqrt(12) * (3 * z * z - 1),
    ]


def powers(anisotropy: Scalar, order: int) -> list[Scalar]:
    """Of each of the `harmonics`, the factor by which scattering by the phase function of Henyey and
    Greenstein multiplies it: g to the power of its order."""
    one = jnp.ones_like(anisotropy)
    return [one] if order == 0 else [one, *[anisotropy] * 3, *[anisotropy * anisotropy] * 5]


def packed(coefficients: list[Vec3]) -> Float[Array, "channels"]:
    """(r, g, b) of each of the harmonics, in one array."""
    return jnp.stack([channel for each in coefficients for channel in each])


def unpacked(row: Float[Array, "channels"]) -> list[Vec3]:
    """The inverse of `packed`."""
    return [(row[i], row[i + 1], row[i + 2]) for i in range(0, row.shape[0], 3)]
