"""Points and directions of the world, as seen along axes that are turned against it."""

import equinox as eqx
from jaxtyping import Array, Float

from .._util.vec3 import Vec3, apart, dot


class Frame(eqx.Module):
    """A Cartesian frame of coordinates, in world length.

    - `origin`: the world point that has coordinates 0.
    - `axes`: world directions of its axes: unit vectors that are orthogonal to each other.
    """

    origin: Vec3
    axes: tuple[Vec3, Vec3, Vec3]

    @classmethod
    def of(cls, origin: Float[Array, "3"], direction: Float[Array, "3 3"]) -> "Frame":
        """`direction`: its columns are the axes."""
        x, y, z = (apart(direction[:, axis]) for axis in range(3))
        return cls(apart(origin), (x, y, z))

    def coordinates(self, point: Vec3) -> Vec3:
        """Coordinates of a world point."""
        (x, y, z), (ox, oy, oz) = point, self.origin
        return self.components((x - ox, y - oy, z - oz))

    def components(self, direction: Vec3) -> Vec3:
        """Components of a world direction along the axes."""
        x, y, z = (dot(axis, direction) for axis in self.axes)
        return x, y, z

    def point(self, coordinates: Vec3) -> Vec3:
        """World point of coordinates."""
        a, b, c = coordinates
        x, y, z = (o + (a * i + b * j + c * k) for o, i, j, k in zip(self.origin, *self.axes, strict=True))
        return x, y, z
