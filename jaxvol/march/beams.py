"""Where is nothing visible? What marches ask, and which stretches of a beam of neighbouring rays are empty.

A beam is a group of rays that share one query: at each distance from their origins, they lie in a bounding
box whose faces move linearly with the distance.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar, Vec3, along
from ..scene.occupancy import Index, Occupancy, Sums
from ..scene.space import Ray
from ..xla.memory import gather
from ..xla.platform import on_gpu
from ..xla.sharding import varying


STRETCHES = 128
"""Most stretches of a beam, each of one or several segments."""

ROUNDING = 64 * float(jnp.finfo(jnp.float32).eps)


class Skips(eqx.Module):
    """Where nothing is visible along the rays of some beams."""

    @abstractmethod
    def any_visible(self) -> Bool[Array, "*beams"]:
        """Whether anything may be visible along each beam."""

    @abstractmethod
    def skip_to(self, beam: Int[Array, " rays"], rays: Ray, depth: Scalar) -> Scalar:
        """For rays of these beams, a depth of at least `depth` before which nothing is visible."""


class EmptySpaceIndex(eqx.Module):
    """Where nothing is visible, for beams of rays."""

    @abstractmethod
    def skips(self, box: Callable[[Occupancy], "Box"], stretch: Scalar) -> Skips:
        """That along beams, from the boxes around them. `stretch`: the shortest useful leap."""

    @property
    def unshaped(self) -> "EmptySpaceIndex":
        """The same index, so that its kernel knows no numbers of cells, if that is possible."""
        return self

    def within_ranges(self) -> "EmptySpaceIndex":
        """What is of use where each ray's first and last visible cell are known."""
        return self


class View(NamedTuple):
    """The camera's rays, as `Transform.empty_space` may ask for them."""

    ray: Callable[[Scalar, Scalar], tuple[Vec3, Vec3]]
    """Origin, counted from the anchor, and unit direction of the ray through a column and a row."""
    size: tuple[int, int]
    """(width, height)."""
    corner: tuple[Int[Array, ""], Int[Array, ""]]
    """(column, row) of the image's first pixel, as `Ray.pixel` counts them."""
    first_hit: Callable[[EmptySpaceIndex, Int[Array, "*rays"], Int[Array, "*rays"]], Float[Array, "*rays"]]
    """From an index to leap by, and columns and rows, to the distances of the first visible samples."""


class Box(eqx.Module):
    """Bounding box of a beam's rays at the distance `near + u` from their origins: from `low + u low_rate` to
    `high + u high_rate`, in cells of the occupancy."""

    near: Float[Array, "*beams"]
    far: Float[Array, "*beams"]
    low: Vec3
    high: Vec3
    low_rate: Vec3
    high_rate: Vec3

    @classmethod
    def around(cls, occupancy: Occupancy, rays: Ray) -> "Box":
        """The box of rays, by beam and ray. Rays that miss the volume are ignored."""
        rays = jax.lax.stop_gradient(rays)
        hit = rays.length > 0
        near = jnp.min(jnp.where(hit, rays.t_in, jnp.inf), axis=-1)
        near = jnp.where(jnp.isfinite(near), near, 0)
        far = jnp.max(jnp.where(hit, rays.t_in + rays.length, -jnp.inf), axis=-1)
        entry = occupancy.frame.components(rays.entry)
        direction = occupancy.frame.components(rays.direction)
        start = along(entry, direction, near[..., None] - rays.t_in)
        return cls._of(occupancy, start, direction, near, far, hit, jnp.zeros_like(near))

    @classmethod
    def within(cls, occupancy: Occupancy, origin: Vec3, direction: Vec3) -> "Box":
        """The box of all camera rays between a beam's corner rays, by beam and corner; origins count from the
        anchor."""
        origin, direction = jax.lax.stop_gradient((origin, direction))
        frame, shape = occupancy.frame, occupancy.shape
        x, y, z = (size * jnp.asarray(n, size.dtype) for size, n in zip(occupancy.size, shape, strict=True))
        spans = x, y, z
        x, y, z = (low + span / 2 for low, span in zip(occupancy.origin, spans, strict=True))
        center = frame.vector((x, y, z))
        x, y, z = (c - o for o, c in zip(origin, center, strict=True))
        middle = jnp.sqrt(x * x + y * y + z * z)
        radius = frame.diagonal(spans) / 2
        # A direction between the corners is their normalized average: normalizing lengthens it by at most 1
        # minus the cosine of the widest angle to the mean direction.
        axis = [jnp.mean(d, axis=-1, keepdims=True) for d in direction]
        cosine = sum(a * d for a, d in zip(axis, direction, strict=True))
        bulge = 1 - jnp.min(cosine, axis=-1) / jnp.sqrt(sum(a[..., 0] ** 2 for a in axis)) + 1e-6
        # parallel rays have different origins, hence the nearest and the farthest corner
        nearest, farthest = jnp.min(middle, axis=-1), jnp.max(middle, axis=-1)
        spread = farthest - nearest + sum(jnp.max(o, axis=-1) - jnp.min(o, axis=-1) for o in origin)
        near, far = jnp.maximum(nearest - radius - spread, 0), farthest + radius + spread
        start = frame.components(along(origin, direction, near[..., None]))
        direction, counts = frame.components(direction), jnp.ones(start[0].shape, bool)
        return cls._of(occupancy, start, direction, near, far, counts, bulge * frame.stretch)

    @classmethod
    def _of(
        cls, occupancy: Occupancy, start: Vec3, direction: Vec3, near: Any, far: Any, counts: Any, bulge: Any
    ) -> "Box":
        """`start`, `direction`: along the axes of the occupancy."""

        def least(values: Array, sign: int) -> Array:
            return sign * jnp.min(jnp.where(counts, sign * values, jnp.inf), axis=-1)

        sides = []
        for s, d, size, corner in zip(start, direction, occupancy.size, occupancy.origin, strict=True):
            # allows for rounding a ray's start to float32 when the camera is far away
            far_off = near * occupancy.frame.stretch + abs(corner) + size
            slack = 1e-3 + (ROUNDING * far_off + bulge * near) / size
            s, d, bulges = (s - corner) / size, d / size, bulge / size
            ends = least(s, 1) - slack, least(s, -1) + slack
            sides.append((*ends, least(d, 1) - bulges, least(d, -1) + bulges))
        low, high, low_rate, high_rate = (tuple(side) for side in zip(*sides, strict=True))
        return cls(near, far, low, high, low_rate, high_rate)

    def between(self, first: Scalar, last: Scalar) -> tuple[Vec3, Vec3]:
        """Bounding box of all rays from `near + first` to `near + last`, both ≥ 0."""
        low = jax.tree.map(lambda s, r: s + jnp.minimum(first * r, last * r), self.low, self.low_rate)
        high = jax.tree.map(lambda s, r: s + jnp.maximum(first * r, last * r), self.high, self.high_rate)
        return low, high


class Stretches(Skips):
    """The stretches of beams, each of this `length`, from the distance `near` of the ray origins on."""

    near: Float[Array, " beams"]
    length: Scalar
    following: Int[Array, "stretches beams"]
    """For each stretch, the first one from there on that is not empty, or their number."""

    @classmethod
    def nowhere(cls, beams: int, like: Array) -> "Stretches":
        """Those of beams in which nothing is known to be empty. `like`: an array of the type of depths."""
        none = jnp.zeros((STRETCHES, beams), jnp.int32)
        return cls(jnp.zeros(beams, like.dtype), jnp.full((), jnp.inf, like.dtype), none)

    def any_visible(self) -> Bool[Array, " beams"]:
        return self.following[0] < self.following.shape[0]

    def skip_to(self, beam: Int[Array, " rays"], rays: Ray, depth: Scalar) -> Scalar:
        count, beams = self.following.shape
        near = gather(self.near, beam)
        position = (rays.t_in + depth - near) / self.length
        stretch = jnp.clip(position.astype(jnp.int32), 0, count - 1)
        following = gather(self.following.reshape(-1), stretch * beams + beam)
        begin = near + following.astype(depth.dtype) * self.length - rays.t_in
        return jnp.where(following > stretch, jnp.where(following >= count, jnp.inf, begin), depth)


def stretches(occupancy: Occupancy, sums: Sums, box: Box, stretch: Scalar) -> Stretches:
    """The stretches of beams in these boxes. `stretch`: the shortest that is of use."""
    across = jnp.maximum(box.far - box.near, 0)
    # a whole multiple of `stretch`, the same for all beams, so that no segment is cut in two
    multiple = jnp.ceil(jnp.max(across) / (stretch * STRETCHES))
    length = jnp.maximum(multiple, 1) * stretch
    number = jnp.minimum(jnp.ceil(jnp.max(across) / length).astype(jnp.int32), STRETCHES)

    def occupied(at: Int[Array, ""]) -> Bool[Array, " beams"]:
        first = at.astype(length.dtype) * length
        low, high = box.between(first - 1e-2 * length, first + 1.01 * length)
        shape = [jnp.asarray(n, first.dtype) for n in occupancy.shape]
        inside = first < across
        for a, b, n in zip(low, high, shape, strict=True):
            inside &= (b >= 0) & (a <= n)

        def cells(corner: Vec3) -> Index:
            """Cell indices of a corner, arbitrary for boxes outside the grid."""
            at = [jnp.floor(jnp.where(inside, c, 0)) for c in corner]
            x, y, z = (jnp.clip(i, 0, n - 1).astype(jnp.int32) for i, n in zip(at, shape, strict=True))
            return x, y, z

        return inside & sums.any_between(cells(low), cells(high))

    if on_gpu():  # all at once: a loop would take longer to launch than to run
        at = jnp.arange(STRETCHES, dtype=jnp.int32)
        own = jnp.where(jax.vmap(occupied)(at), at[:, None], STRETCHES)
        return Stretches(box.near, length, jax.lax.cummin(own, axis=0, reverse=True))

    def visit(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        at, next_one, table = state
        at = at - 1
        next_one = jnp.where(occupied(at), at, next_one)
        return at, next_one, jax.lax.dynamic_update_slice_in_dim(table, next_one[None], at, 0)

    none = jnp.full(box.near.shape, STRETCHES, jnp.int32)
    table = jnp.full((STRETCHES, *none.shape), STRETCHES, jnp.int32)
    _, _, table = jax.lax.while_loop(lambda state: state[0] > 0, visit, varying((number, none, table)))
    return Stretches(box.near, length, table)
