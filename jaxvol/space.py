"""Which grid coordinate is this world point, and where does a ray meet the grid?

This is the seam `locate`. A `Space` answers both questions for one volume; the default is `Affine`
(spacing and origin), under which a ray stays straight in the grid. A space whose rays are curved
in the grid gives another `Path`, and the rest of the march does not notice.
"""

from abc import abstractmethod
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ._util.vec3 import Scalar, Vec3, along, apart
from .occupancy import BLOCK, Occupancy
from .volume import Volume


class Path(eqx.Module):
    """A ray as seen in the grid."""

    gaps: ClassVar[bool] = False
    """Whether a ray may leave the grid between its entry and its exit."""

    @abstractmethod
    def __call__(self, s: Scalar) -> Vec3:
        """The grid coordinate at depth `s`, the world length past the entry."""

    def contains(self, coordinate: Vec3) -> Bool[Array, ""]:
        """Whether there is anything at a coordinate of this path. False in gaps alone."""
        return jnp.ones((), bool)


class Space(eqx.Module):
    """Where a volume's grid lies in the world."""

    @property
    @abstractmethod
    def diagonal(self) -> Scalar:
        """Length that no ray through the grid exceeds."""

    @property
    @abstractmethod
    def middle(self) -> Vec3:
        """The world point from which no point of the grid is farther than half of `diagonal`."""

    @abstractmethod
    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        """Distances at which the line enters and leaves the grid; the first exceeds the second on a miss."""

    @abstractmethod
    def coordinate(self, point: Vec3) -> Vec3:
        """The grid coordinate of a world point."""

    @abstractmethod
    def point(self, coordinate: Vec3) -> Vec3:
        """The world point of a grid coordinate."""

    @abstractmethod
    def occupancy(self, visible: Bool[Array, "bx by bz"]) -> Occupancy:
        """The blocks of the grid in which anything may be seen, as cells of the world."""

    @abstractmethod
    def path(self, entry: Vec3, direction: Vec3) -> Path:
        """The straight world ray from `entry`, as seen in the grid."""


class Ray(eqx.Module):
    """One ray, cut to the part inside the volume.

    - `entry`, `direction`: world point where the part begins, and the unit direction.
    - `t_in`: distance from the ray's origin to the entry. `length`: from entry to exit; 0 on a miss.
      Both carry gradients. All depths `s` along a march count from the entry: near 0 float32 resolves
      them as finely as the volume needs, however far away the camera stands.
    - `path`: the ray as seen in the grid.
    - `pixel`: (column, row), the key of everything random along this ray.
    """

    entry: Vec3
    direction: Vec3
    t_in: Scalar
    length: Scalar
    path: Path
    pixel: tuple[Int[Array, ""], Int[Array, ""]]


def enter(space: Space, origin: Vec3, direction: Vec3, pixel: tuple[Int[Array, ""], Int[Array, ""]]) -> Ray:
    """The part of a ray inside the volume and not behind its origin, which may lie inside. Where NaN or
    infinity are among the numbers of ray or space, the ray is `invalid`."""
    # Float32 rounds the distance of a far camera by more than the volume can stand. So the ray begins
    # anew near the volume, from where distances are short.
    toward = sum((m - o) * d for m, o, d in zip(space.middle, origin, direction, strict=True))
    base = jax.lax.stop_gradient(jnp.maximum(toward - space.diagonal / 2, 0))
    close = along(origin, direction, base)
    near, far = space.interval(close, direction)
    start = jnp.maximum(near, -base)
    hit = far > start
    start = jnp.where(hit, start, 0)  # a miss has infinite distances, whose products are NaN
    entry = along(close, direction, start)
    length = jnp.where(hit, far - start, 0)
    ray = Ray(entry, direction, base + start, length, space.path(entry, direction), pixel)
    return invalid(ray, ~jnp.isfinite(toward))


def invalid(ray: Ray, fault: Bool[Array, "..."]) -> Ray:
    """The ray; where there is a fault, one that is never marched, and of which nothing but NaN is seen.

    Comparisons with NaN are false, so that a march would take it for a miss, or never end."""
    t_in, length = jnp.where(fault, jnp.nan, ray.t_in), jnp.where(fault, 0, ray.length)
    return eqx.tree_at(lambda ray: (ray.t_in, ray.length), ray, (t_in, length))


class Straight(Path):
    """A path straight in the grid: `start + s rate`."""

    start: Vec3
    rate: Vec3

    def __call__(self, s: Scalar) -> Vec3:
        return along(self.start, self.rate, s)


class Affine(Space):
    """A grid whose axes are those of the world: spacing and origin."""

    low: Vec3
    high: Vec3
    spacing: Vec3

    def __init__(self, volume: Volume):
        low, high = volume.corners
        self.low, self.high = apart(low), apart(high)
        self.spacing = apart(volume.spacing)

    @property
    def diagonal(self) -> Scalar:
        return jnp.sqrt(sum((high - low) ** 2 for low, high in zip(self.low, self.high, strict=True)))

    @property
    def middle(self) -> Vec3:
        x, y, z = ((low + high) / 2 for low, high in zip(self.low, self.high, strict=True))
        return x, y, z

    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        return slab_interval(origin, direction, self.low, self.high)

    def coordinate(self, point: Vec3) -> Vec3:
        x, y, z = ((p - low) / step for p, low, step in zip(point, self.low, self.spacing, strict=True))
        return x, y, z

    def point(self, coordinate: Vec3) -> Vec3:
        x, y, z = (low + c * step for c, low, step in zip(coordinate, self.low, self.spacing, strict=True))
        return x, y, z

    def occupancy(self, visible: Bool[Array, "bx by bz"]) -> Occupancy:
        x, y, z = (BLOCK * step for step in self.spacing)
        return Occupancy(visible, self.low, (x, y, z))

    def path(self, entry: Vec3, direction: Vec3) -> Straight:
        dx, dy, dz = (d / step for d, step in zip(direction, self.spacing, strict=True))
        return Straight(self.coordinate(entry), (dx, dy, dz))


def slab_interval(origin: Vec3, direction: Vec3, low: Vec3, high: Vec3) -> tuple[Scalar, Scalar]:
    """Distances at which a line enters and leaves a box; the first exceeds the second on a miss."""
    (near_x, far_x), (near_y, far_y), (near_z, far_z) = (
        _slab(*ends) for ends in zip(origin, direction, low, high, strict=True)
    )
    near = jnp.maximum(jnp.maximum(near_x, near_y), near_z)
    far = jnp.minimum(jnp.minimum(far_x, far_y), far_z)
    return near, far


def world_gradient(
    volume: Volume, space: Space, point: Vec3, method: Literal["trilinear", "central"] = "central"
) -> Vec3:
    """Gradient of the value at a world point, value units per world length, wherever the grid lies.

    As `Volume.gradient`, turned and scaled by the transposed derivative of `space.coordinate`.
    """
    coordinate, transpose = jax.vjp(space.coordinate, point)
    slopes = volume.gradient(coordinate, method)
    per_node = tuple(slope * volume.spacing[i] for i, slope in enumerate(slopes))
    return transpose(per_node)[0]


def _slab(origin: Scalar, direction: Scalar, low: Scalar, high: Scalar) -> tuple[Scalar, Scalar]:
    """Distances to the nearer and the farther of two parallel planes."""
    # Below this a direction runs along the planes. Not 0: the derivative of 1/d is 1/d², and must be finite.
    parallel = jnp.abs(direction) < float(jnp.finfo(direction.dtype).tiny) ** 0.25
    slope = jnp.where(parallel, 1, direction)
    a, b = (low - origin) / slope, (high - origin) / slope
    between = (low <= origin) & (origin <= high)
    near = jnp.where(parallel, jnp.where(between, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    far = jnp.where(parallel, jnp.where(between, jnp.inf, -jnp.inf), jnp.maximum(a, b))
    return near, far
