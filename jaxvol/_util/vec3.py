"""Points and directions as tuples of three scalars; a basis around a direction, and even directions.

Batched over rays, three arrays of length n run 3 to 5 times faster in a loop than one of shape
(n, 3), whose components XLA must extract and recombine at every step. Functions of a single point
or direction on the march's path therefore take and return triples; what a user holds (a camera's
position, an image) is stacked.
"""

import math
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


Scalar: TypeAlias = Float[Array, "..."]
"""A number per ray, for one ray or a batch: all operations on it are elementwise."""

Vec3: TypeAlias = tuple[Scalar, Scalar, Scalar]


def apart(vector: Float[Array, "3"]) -> Vec3:
    """The components of a stacked vector."""
    return vector[0], vector[1], vector[2]


def along(start: Vec3, rate: Vec3, s: Scalar) -> Vec3:
    """The point `start + s rate`."""
    (x, y, z), (dx, dy, dz) = start, rate
    return x + s * dx, y + s * dy, z + s * dz


def orthonormal(direction: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors orthogonal to a unit direction and to each other.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
    """
    x, y, z = direction
    sign = jnp.where(z >= 0, 1, -1).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def golden_spiral(n: int) -> Float[np.ndarray, "n 3"]:
    """`n` unit directions spread evenly over the sphere: equal steps in z, golden angles around it."""
    z = 1 - (2 * np.arange(n) + 1) / n
    around, across = math.pi * (1 + math.sqrt(5)) * np.arange(n), np.sqrt(1 - z**2)
    return np.stack([across * np.cos(around), across * np.sin(around), z], axis=-1)
