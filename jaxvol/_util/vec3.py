"""Points and directions as tuples of three scalars.

Batched over rays, three arrays of length n run 3 to 5 times faster in a loop than one of shape
(n, 3), whose components XLA must extract and recombine at every step. Functions of a single point
or direction on the march's path therefore take and return triples; what a user holds (a camera's
position, an image) is stacked.
"""

from typing import TypeAlias

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
