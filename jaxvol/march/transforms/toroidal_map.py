"""Toroidal coordinates, which place a swept ultrasound fan in the world (Kim, Kwon and Shin 2008).

A mechanical probe turns a fan of beams about a motor axis. Its samples form a box in (β, σ, γ): the motor
angle, the angle of the beam in the fan, and the depth along the beam. In the world, whose x axis is the motor
axis and whose z axis points along the middle beam at β = σ = π/2, the box is a sector of a torus:

    ρ = sqrt(y² + z²)    R = ρ - a    β = π/2 + atan2(y, z)    σ = π/2 + atan2(x, R)    γ = sqrt(x² + R²) - b

with `a` from the motor axis to the fan's apex and `b` from the apex to the first sample. The volume is
rendered as acquired, without resampling: rays that are straight in the world are curved in its grid.
"""

import math
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..._util.checks import Arrayable, finite_array, number, require
from ..._util.vec3 import Scalar, Vec3, apart
from ...scene.occupancy import BLOCK, Occupancy
from ...scene.space import Gap, Space, blocks_in_reach
from ...scene.volume import Volume
from ...xla.platform import in_numpy, stack
from ..march import Transform
from .sector_faces import SectorFaces, hypot


CUBES = 48
"""Cells per side of the box around the sector, in the occupancy grid."""


class ToroidalMap(Transform):
    """Render swept ultrasound as acquired: `data[x, y, z]` are samples at (β, σ, γ) of a fan, evenly spaced.

    The volume's own spacing and origin have no meaning under this map, and it must have no direction; world
    coordinates are the probe's, with the origin on the motor axis. Of the gaps in which a ray is outside the
    sector, as in its hollow near side, the first two are found. A ray that is nowhere farther outside than
    2e-6 of the probe's size counts as inside; one that runs along a face, outside by less than 1e-5 of that
    size, may.

    Args:
        a: distance from the motor axis to the fan's apex, world length; negative if the apex lies behind the
            axis. Samples behind it, where ρ would be negative (`nearest_to_axis`), are not shown.
        b: distance from the apex to depth γ = 0, world length.
        beta_range: (first, last) angle of the nodes along data axis 0, radians, within [0, π], increasing.
        sigma_range: the same along data axis 1.
        gamma_range: (first, last) depth of the nodes along data axis 2, increasing, with b + first > 0.

    All are differentiable, once. The gradient of an angle is taken as 0 on the motor axis (y = z = 0) and at
    the apex (x = R = 0), and so is that of an entry or exit where a ray grazes a face by less than 0.06°.

    Where it fails: `experiments/stability.py`, "gaps of rays under a toroidal map",
    "rays near the motor axis".

    Raises:
        ValueError: for ranges that do not increase or lie outside their limits.

    Source: Kim, Kwon and Shin 2008, equations (2.1) to (2.4), with `atan2` for `atan`.
    """

    a: Float[Array, ""]
    b: Float[Array, ""]
    beta_range: Float[Array, "2"]
    sigma_range: Float[Array, "2"]
    gamma_range: Float[Array, "2"]

    def __init__(self, a: Any, b: Any, beta_range: Any, sigma_range: Any, gamma_range: Any):
        self.a, self.b = number("a", a), number("b", b)
        self.beta_range = _angles("beta_range", beta_range)
        self.sigma_range = _angles("sigma_range", sigma_range)
        self.gamma_range = require(
            _range("gamma_range", gamma_range),
            lambda gamma, b: b + gamma[0] > 0,
            "gamma_range must begin beyond the apex, b + gamma_range[0] > 0; got {got}.",
            self.b,
        )

    @property
    def ranges(self) -> tuple[Float[Array, "2"], Float[Array, "2"], Float[Array, "2"]]:
        return self.beta_range, self.sigma_range, self.gamma_range

    def to_toroidal(self, points: Arrayable) -> Float[Array, "*points 3"]:
        """(β, σ, γ) of world points (*points, 3)."""
        points = jnp.stack(_components("points", points), axis=-1)
        return jnp.vectorize(lambda p: jnp.stack(self._forward(apart(p))), signature="(k)->(k)")(points)

    def to_world(self, toroidal: Arrayable) -> Float[Array, "*points 3"]:
        """World points (*points, 3) of (β, σ, γ): the inverse of `to_toroidal` where γ > -b and ρ > 0."""
        beta, sigma, gamma = _components("toroidal", toroidal)
        depth = gamma + self.b
        rho = self.a + depth * jnp.sin(sigma)  # sin σ = cos(σ - π/2)
        world = -depth * jnp.cos(sigma), -rho * jnp.cos(beta), rho * jnp.sin(beta)
        return jnp.stack(world, axis=-1)

    @property
    def corners(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Lowest and highest world coordinates of the swept sector; tight."""
        # depth and angles are separable: extremes lie at the ends of the ranges, or in the middle of angles
        xp, (probe,) = in_numpy(self)
        angles = (ends - math.pi / 2 for ends in (probe.sigma_range, probe.beta_range))
        fan, turn = (xp.append(ends, xp.clip(xp.zeros((), ends.dtype), *ends)) for ends in angles)
        depth = probe.b + probe.gamma_range
        x = xp.outer(depth, xp.sin(fan))
        rho = probe.a + xp.outer(depth, xp.cos(fan))
        rho = xp.maximum(xp.stack([rho.min(), rho.max()]), 0)
        axes = x, xp.outer(rho, xp.sin(turn)), xp.outer(rho, xp.cos(turn))
        low, high = stack([axis.min() for axis in axes]), stack([axis.max() for axis in axes])
        return low, high

    @property
    def bounds(self) -> Float[Array, "6"]:
        """World extent (x_min, x_max, y_min, y_max, z_min, z_max) of the swept sector; tight."""
        xp, ends = in_numpy(*self.corners)
        return jnp.asarray(xp.stack(ends, axis=-1).reshape(-1), self.a.dtype)

    @property
    def center(self) -> Float[Array, "3"]:
        _, (low, high) = in_numpy(*self.corners)
        return jnp.asarray((low + high) / 2, self.a.dtype)

    @property
    def nearest_to_axis(self) -> Float[Array, ""]:
        """ρ of the sample nearest to the motor axis, world length; negative if it lies behind the axis."""
        xp, (probe,) = in_numpy(self)
        depth = probe.b + probe.gamma_range[0]
        return jnp.asarray(xp.asarray(probe.a + depth * xp.min(xp.sin(probe.sigma_range))), self.a.dtype)

    def locate(self, space: Space, volume: Volume) -> Space:
        if volume.direction is not None:
            raise ValueError("volume must have no direction: ToroidalMap places its voxels by the probe.")
        return _Sector(self, volume.shape)

    def _forward(self, point: Vec3) -> Vec3:
        x, y, z = point
        off = hypot(y, z) - self.a
        half = math.pi / 2
        return half + _atan2(y, z), half + _atan2(x, off), hypot(x, off) - self.b


class _Sector(Space):
    """The space of a volume under a `ToroidalMap`."""

    probe: ToroidalMap
    shape: tuple[int, int, int] = eqx.field(static=True)

    @property
    def searches(self) -> bool:
        return True

    @property
    def diagonal(self) -> Scalar:
        low, high = self.probe.corners
        return jnp.linalg.norm(high - low)

    @property
    def middle(self) -> Vec3:
        return apart(self.probe.center)

    def coordinate(self, point: Vec3) -> Vec3:
        toroidal, ranges = self.probe._forward(point), self.probe.ranges
        fractions = [
            (value - low) / (high - low) for value, (low, high) in zip(toroidal, ranges, strict=True)
        ]
        beta, sigma, gamma = (fraction * (n - 1) for fraction, n in zip(fractions, self.shape, strict=True))
        return beta, sigma, gamma

    def point(self, coordinate: Vec3) -> Vec3:
        fractions = [c / (n - 1) for c, n in zip(coordinate, self.shape, strict=True)]
        ranges = zip(fractions, self.probe.ranges, strict=True)
        return apart(self.probe.to_world(jnp.stack([low + c * (high - low) for c, (low, high) in ranges])))

    def least_distances(self, low: Vec3, high: Vec3) -> Vec3:
        # ρ = a + (b + γ) sin σ is concave in σ and linear in γ, so that it is least in a corner
        probe = self.probe
        ranges = zip(probe.ranges, self.shape, strict=True)
        beta, sigma, gamma = ((last - first) / (n - 1) for (first, last), n in ranges)
        depth = [jnp.maximum(probe.b + probe.gamma_range[0] + end[2] * gamma, 0) for end in (low, high)]
        angle = [jnp.clip(probe.sigma_range[0] + end[1] * sigma, 0, math.pi) for end in (low, high)]
        rho = [probe.a + d * jnp.sin(s) for d in depth for s in angle]
        return jnp.maximum(reduce(jnp.minimum, rho), 0) * beta, depth[0] * sigma, gamma

    def occupancy(
        self, visible: Bool[Array, "bx by bz"], first: Vec3 | None = None, side: int = BLOCK
    ) -> Occupancy:
        """World cells around the sector, occupied where the sphere around one reaches a visible block."""
        low, high = (apart(corner) for corner in jax.lax.stop_gradient(self.probe).corners)
        x, y, z = size = tuple((b - a) / CUBES for a, b in zip(low, high, strict=True))
        middle = jnp.arange(CUBES, dtype=x.dtype) + 0.5
        point = jnp.meshgrid(*(a + middle * step for a, step in zip(low, size, strict=True)), indexing="ij")
        radius = jnp.sqrt(x * x + y * y + z * z) / 2 + 16 * float(jnp.finfo(x.dtype).eps) * self._faces.size
        rho = hypot(point[1], point[2])
        off = hypot(point[0], rho - self.probe.a)

        def angle(axis_distance: Scalar) -> Scalar:
            """Most that an angle about an axis changes within the sphere."""
            off_axis = axis_distance > radius
            ratio = radius / jnp.where(off_axis, axis_distance, radius)
            return jnp.where(off_axis, jnp.arcsin(ratio), math.tau)

        changes, ranges = (angle(rho), angle(off), radius), self.probe.ranges
        lasts = [n - 1 for n in self.shape]
        parts = zip(changes, ranges, lasts, strict=True)
        nodes = [change / (ends[1] - ends[0]) * last for change, ends, last in parts]
        center = jax.lax.stop_gradient(self).coordinate((point[0], point[1], point[2]))
        return Occupancy(blocks_in_reach(center, nodes, visible, first, side, lasts), low, (x, y, z))

    @property
    def _faces(self) -> SectorFaces:
        return SectorFaces(self.probe.a, self.probe.b, *self.probe.ranges, *map(apart, self.probe.corners))

    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        return self._faces.interval(origin, direction)

    def gaps(self, entry: Vec3, direction: Vec3, length: Scalar) -> tuple[Gap, ...]:
        return self._faces.gaps(entry, direction, length)


def _atan2(a: Scalar, b: Scalar) -> Scalar:
    """atan2, with value and gradient 0 at the origin."""
    # not merely nonzero: the derivative divides by a² + b², which must not underflow
    defined = jnp.maximum(jnp.abs(a), jnp.abs(b)) > float(jnp.finfo(a.dtype).tiny) ** 0.25
    return jnp.where(defined, jnp.arctan2(jnp.where(defined, a, 0), jnp.where(defined, b, 1)), 0)


def _range(name: str, value: Arrayable) -> Float[Array, "2"]:
    message = f"{name} must be (first, last) with first < last; got {{got}}."
    return require(finite_array(name, value, (2,)), lambda ends: ends[0] < ends[1], message)


def _angles(name: str, value: Arrayable) -> Float[Array, "2"]:
    message = f"{name} must lie in [0, π] radians; got {{got}}."
    return require(_range(name, value), lambda ends: (ends >= 0) & (ends <= math.pi + 1e-6), message)


def _components(name: str, points: Arrayable) -> tuple[Any, Any, Any]:
    points = jnp.asarray(points, dtype=float)
    if points.ndim < 1 or points.shape[-1] != 3:
        raise ValueError(f"{name} must have shape (*points, 3); got {points.shape}.")
    return points[..., 0], points[..., 1], points[..., 2]
