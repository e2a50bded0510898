"""Entry, exit and gaps of a line through a swept sector. Its faces are two tori, cones and planes, of known
distance, approached by safe steps (sphere tracing), which become Newton's."""

import math
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..._util.vec3 import Scalar, Vec3, along, root
from ...scene.space import Gap, slab_interval
from ...xla.platform import while_loop


STEPS = 256
"""Most steps towards a face. Rays that need more graze a cone or a torus."""

GAPS = 2
"""Gaps that are found of a ray, from the front. Of 600 000 rays through random probes, none had three."""

BACK = 0.01
"""How far behind an origin, which rounding may take past its entry, that is searched for, in probe sizes."""


class ToFace(NamedTuple):
    """Distance of a point of a line from a face, negative inside, and its derivative along the line."""

    distance: Scalar
    slope: Scalar


class SectorFaces(eqx.Module):
    """The faces of the sector of a `ToroidalMap`, whose parameters these are, and the box around it."""

    a: Scalar
    b: Scalar
    beta_range: Float[Array, "2"]
    sigma_range: Float[Array, "2"]
    gamma_range: Float[Array, "2"]
    low: Vec3
    high: Vec3

    @property
    def size(self) -> Scalar:
        """Length scale of rounding errors."""
        return jax.lax.stop_gradient(jnp.abs(self.a) + self.b + self.gamma_range[1])

    @property
    def _tolerance(self) -> Scalar:
        return 8 * float(jnp.finfo(self.a.dtype).eps) * self.size

    def interval(self, origin: Vec3, direction: Vec3) -> tuple[Scalar, Scalar]:
        """Distances of the first entry and the last exit; on a miss, the first exceeds the second."""
        near, far = slab_interval(origin, direction, self.low, self.high)
        near = jnp.maximum(near, -BACK * self.size)
        hit = far > jnp.maximum(near, 0)
        near, far = jnp.where(hit, near, 0), jnp.where(hit, far, 0)
        first, _ = self._crossing(origin, direction, near, far - near, 1, inside=False)
        last, _ = self._crossing(origin, direction, far, far - near, -1, inside=False)
        first, last = (self._exact(origin, direction, end) for end in (first, last))
        hit &= last > first
        return jnp.where(hit, first, jnp.inf), jnp.where(hit, last, -jnp.inf)

    def gaps(self, entry: Vec3, direction: Vec3, length: Scalar) -> tuple[Gap, ...]:
        faces, start, rate, length = jax.lax.stop_gradient((self, entry, direction, length))

        def next_gap(depth: Scalar, _: None) -> tuple[Scalar, Gap]:
            begin, leaves = faces._crossing(start, rate, depth, length - depth, 1, inside=True)
            end = faces._crossing(start, rate, begin, length - begin, 1, inside=False)[0]
            end = jnp.minimum(end, length)  # also where no entry was found
            exists = leaves & (end > begin)
            gap = jnp.where(exists, begin, jnp.inf), jnp.where(exists, end, jnp.inf)
            return jnp.where(exists, end, length), gap

        _, ends = jax.lax.scan(next_gap, 0 * length, None, GAPS)

        def exact(depth: Scalar) -> Scalar:
            exists = jnp.isfinite(depth)
            crossing = self._exact(entry, direction, jnp.where(exists, depth, 0))
            return jnp.where(exists, crossing, jnp.inf)

        return tuple((exact(begin), exact(end)) for begin, end in zip(*ends, strict=True))

    def _crossing(
        self, origin: Vec3, direction: Vec3, begin: Scalar, reach: Scalar, sign: int, *, inside: bool
    ) -> tuple[Scalar, Bool[Array, ""]]:
        """Find where a line stops being `inside`, or outside, along `sign` × direction, and if it does."""
        faces, origin, direction = jax.lax.stop_gradient((self, origin, direction))
        begin, reach, tolerance = jax.lax.stop_gradient((begin, reach, self._tolerance))

        def goes_on(to_faces: list[ToFace]) -> Bool[Array, ""]:
            outside = _farthest(to_faces).distance
            return outside <= tolerance if inside else outside > tolerance

        def cond(state: Any) -> Bool[Array, ""]:
            gone, to_faces, steps = state
            return goes_on(to_faces) & (gone <= reach) & (steps < STEPS)

        def body(state: Any) -> Any:
            gone, to_faces, steps = state
            point = along(origin, direction, begin + sign * gone)
            ahead = [ToFace(distance, sign * slope) for distance, slope in to_faces]
            gone = gone + faces._clear(point, ahead, inside=inside)
            return gone, faces._at(origin, direction, begin + sign * gone), steps + 1

        to_faces = faces._at(origin, direction, begin)
        none = 0 * to_faces[0].distance
        gone, to_faces, _ = while_loop(cond, body, (none, to_faces, none))
        return begin + sign * gone, ~goes_on(to_faces) & (gone <= reach)

    def _clear(self, point: Vec3, to_faces: list[ToFace], *, inside: bool) -> Scalar:
        """A step along a line that cannot pass a place where it is outside, or inside, by the tolerance.

        The distance f to a face has |f'| ≤ 1, so that a step of |f| is safe, and |f''| ≤ k / 2 with
        k = 4 / min(ρ, D), ρ the distance to the motor axis and D that to the circle of apexes, of which it at
        most doubles within half. So a step to the root of |f| = |f'| s + ½ k s², near a face Newton's step,
        is safe, too.
        """
        x, y, z = point
        rho = hypot(y, z)
        tori, cones = jnp.minimum(rho, hypot(x, rho - self.a)), rho

        def clear(face: ToFace, near: Scalar | None) -> Scalar:
            # past the tolerance, which a step to the face itself might not pass
            distance = jnp.maximum(2 * self._tolerance - face.distance if inside else face.distance, 0)
            fall = face.slope if inside else -face.slope
            falls = fall > 0
            if near is None:
                far = 4 * self.size
                safe = jnp.where(falls, jnp.minimum(distance / jnp.where(falls, fall, 1), far), far)
            else:
                bend = 8 * distance / jnp.maximum(near, jnp.maximum(distance, self._tolerance))
                root = jnp.sqrt(fall * fall + bend)
                quotient = 2 * distance / jnp.where(falls, root + fall, 1)  # without differences
                newton = jnp.where(falls, quotient, (root - fall) * near / 4)
                safe = jnp.maximum(distance, jnp.minimum(newton, near / 2))
            return safe if inside else jnp.where(face.distance > 0, safe, 0)

        # it leaves at the first face that it passes, and has entered when it has passed all
        near = tori, tori, cones, cones, None, None
        return reduce(jnp.minimum if inside else jnp.maximum, map(clear, to_faces, near))

    def _exact(self, origin: Vec3, direction: Vec3, t: Scalar) -> Scalar:
        """A crossing after one step of Newton's method, which also carries its gradient."""
        value, slope = _farthest(self._at(origin, direction, t))
        slope = jax.lax.stop_gradient(slope)
        at_face = (jnp.abs(value) <= 4 * self._tolerance) & (jnp.abs(slope) > 1e-3)
        return jnp.where(at_face, t - value / jnp.where(at_face, slope, 1), t)

    def _at(self, origin: Vec3, direction: Vec3, t: Scalar) -> list[ToFace]:
        outside = partial(jax.jvp, lambda t: self._outside(along(origin, direction, t)))
        return list(map(ToFace, *outside((t,), (jnp.ones_like(t),))))

    def _outside(self, point: Vec3) -> list[Scalar]:
        """Lower bounds on the distances of a point from the inside of two tori, two cones, two planes."""
        x, y, z = point
        half = math.pi / 2
        off = hypot(y, z) - self.a
        depth = hypot(x, off) - self.b
        outside = [self.gamma_range[0] - depth, depth - self.gamma_range[1]]
        angles = (self.sigma_range - half, x, off), (self.beta_range - half, y, z)
        for (first, last), across, ahead in angles:
            outside.append(ahead * jnp.sin(first) - across * jnp.cos(first))
            outside.append(across * jnp.cos(last) - ahead * jnp.sin(last))
        return outside


def _farthest(to_faces: list[ToFace]) -> ToFace:
    """The distance of the face that a point is farthest outside of."""

    def farther(a: ToFace, b: ToFace) -> ToFace:
        keep = a.distance >= b.distance
        return ToFace(jnp.where(keep, a.distance, b.distance), jnp.where(keep, a.slope, b.slope))

    return reduce(farther, to_faces)


def hypot(a: Scalar, b: Scalar) -> Scalar:
    """sqrt(a² + b²), with gradient 0 at the origin."""
    return root(a * a + b * b)
