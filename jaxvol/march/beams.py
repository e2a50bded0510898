"""Finds empty space: the interface that marches use, and empty stretches of beams, neighbouring rays in a
bounding box whose faces move linearly with the distance."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar, Vec3, along
from ..scene.occupancy import Occupancy, Sums
from ..scene.space import Ray
from ..scene.volume import Volume
from ..xla.memory import gather
from ..xla.platform import on_gpu
from ..xla.sharding import varying
from ..xla.trees import unchecked


STRETCHES = 128
"""Most stretches of a beam, each of one or several segments."""

ROUNDING = 64 * float(jnp.finfo(jnp.float32).eps)


class Skips(eqx.Module):
    """Empty space along the rays of beams."""

    @abstractmethod
    def any_visible(self) -> Bool[Array, "*beams"]:
        """Tell for each beam whether anything may be visible along it."""

    @abstractmethod
    def skip_to(self, beam: Int[Array, " rays"], rays: Ray, depth: Scalar) -> Scalar:
        """Return a depth of at least `depth`, before which nothing is visible, for each ray and its beam."""


class EmptySpaceIndex(eqx.Module):
    """Empty space of a scene, which becomes that of beams."""

    @abstractmethod
    def skips(self, box: Callable[[Occupancy], "Box"], stretch: Scalar) -> Skips:
        """Find empty space along beams from the boxes around them. `stretch`: the shortest useful leap."""

    @property
    def unshaped(self) -> "EmptySpaceIndex":
        """The same index, so that its kernel knows no numbers of cells, if that is possible."""
        return self

    def on_axes_of(self, volume: Volume) -> "EmptySpaceIndex":
        """The same index along the axes of a volume, if it does not know them."""
        return self

    def within_ranges(self) -> "EmptySpaceIndex":
        """Return the part that is of use where the first and last visible cell of each ray are known."""
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
    """Bounding box of a beam's rays at the distance `near + u`: `low + u low_rate` to `high + u high_rate`,
    in cells of the occupancy, stacked for a third of the kernels."""

    near: Float[Array, "*beams"]
    far: Float[Array, "*beams"]
    low: Float[Array, "3 *beams"]
    high: Float[Array, "3 *beams"]
    low_rate: Float[Array, "3 *beams"]
    high_rate: Float[Array, "3 *beams"]

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
    def within(cls, occupancy: Occupancy, rays: Ray) -> "Box":
        """Box of all camera rays between a beam's corner rays, whether they meet the volume or not."""
        rays = jax.lax.stop_gradient(rays)
        frame, t_in = occupancy.frame, rays.t_in
        x, y, z = (
            size * jnp.asarray(n, size.dtype) for size, n in zip(occupancy.size, occupancy.shape, strict=True)
        )
        spans = x, y, z
        x, y, z = (low + span / 2 for low, span in zip(occupancy.origin, spans, strict=True))
        center, radius = jnp.stack(frame.vector((x, y, z))), frame.diagonal(spans) / 2
        entry, direction = jnp.stack(rays.entry), jnp.stack(rays.direction)
        origin = entry - direction * t_in[None]
        offset = center.reshape(3, *(1,) * t_in.ndim) - origin
        middle = jnp.sqrt(jnp.sum(offset * offset, axis=0))
        # A direction between the corners is their normalized average: normalizing lengthens it by at most 1
        # minus the cosine of the widest angle to the mean direction.
        axis = jnp.mean(direction, axis=-1)
        cosine = jnp.sum(axis[..., None] * direction, axis=0)
        bulge = 1 - jnp.min(cosine, axis=-1) / jnp.sqrt(jnp.sum(axis * axis, axis=0)) + 1e-6
        # parallel rays have different origins, hence the nearest and the farthest corner
        nearest, farthest = jnp.min(middle, axis=-1), jnp.max(middle, axis=-1)
        spread = jnp.sum(jnp.max(origin, axis=-1) - jnp.min(origin, axis=-1), axis=0) + farthest - nearest
        near, far = jnp.maximum(nearest - radius - spread, 0), farthest + radius + spread
        # from the entries, which float32 resolves where the origins are far away
        start = frame.components(along(rays.entry, rays.direction, near[..., None] - t_in))
        counts = jnp.ones(t_in.shape, bool)
        return cls._of(
            occupancy, start, frame.components(rays.direction), near, far, counts, bulge * frame.stretch
        )

    @classmethod
    def _of(
        cls, occupancy: Occupancy, start: Vec3, direction: Vec3, near: Any, far: Any, counts: Any, bulge: Any
    ) -> "Box":
        """`start`, `direction`: along the axes of the occupancy."""

        def bounds(values: Array) -> tuple[Array, Array]:
            lowest = jnp.min(jnp.where(counts, values, jnp.inf), axis=-1)
            return lowest, jnp.max(jnp.where(counts, values, -jnp.inf), axis=-1)

        size, corner = (
            jnp.stack(vector).reshape(3, *(1,) * near.ndim) for vector in (occupancy.size, occupancy.origin)
        )
        # allows for rounding a ray's start to float32 when the camera is far away
        far_off = near[None] * occupancy.frame.stretch + abs(corner) + size
        slack = 1e-3 + (ROUNDING * far_off + (bulge * near)[None]) / size
        low, high = bounds((jnp.stack(start) - corner[..., None]) / size[..., None])
        low_rate, high_rate = bounds(jnp.stack(direction) / size[..., None])
        bulges = bulge[None] / size
        return cls(near, far, low - slack, high + slack, low_rate - bulges, high_rate + bulges)

    def between(self, first: Scalar, last: Scalar) -> list[tuple[Scalar, Scalar]]:
        """Bounding box of all rays from `near + first` to `near + last`, both ≥ 0: along each axis."""
        ends = []
        for axis in range(3):
            low, high = self.low_rate[axis], self.high_rate[axis]
            low = self.low[axis] + jnp.minimum(first * low, last * low)
            ends.append((low, self.high[axis] + jnp.maximum(first * high, last * high)))
        return ends


class Stretches(Skips):
    """The stretches of beams, each of this `length`, from the distance `near` of the ray origins on."""

    near: Float[Array, " beams"]
    length: Scalar
    following: Int[Array, "stretches beams"]
    """For each stretch, the first one from there on that is not empty, or their number."""

    @classmethod
    def unknown(cls, beams: int, dtype: DTypeLike) -> Any:
        """NumPy stretches of beams of which nothing is known to be empty. `dtype`: that of depths."""
        near, length = np.zeros(beams, dtype), np.full((), np.inf, dtype)
        return unchecked(cls, near=near, length=length, following=np.zeros((STRETCHES, beams), np.int32))

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
        inside, corners = first < across, []
        sides = box.between(first - 1e-2 * length, first + 1.01 * length)
        counts = [jnp.asarray(n, first.dtype) for n in occupancy.shape]
        for (low, high), count in zip(sides, counts, strict=True):
            inside &= (high >= 0) & (low <= count)
        for ends, count in zip(sides, counts, strict=True):
            # arbitrary for boxes outside the grid
            cells = (jnp.clip(jnp.floor(jnp.where(inside, end, 0)), 0, count - 1) for end in ends)
            corners.append([cell.astype(jnp.int32) for cell in cells])
        (x, right), (y, back), (z, top) = corners
        return inside & sums.any_between((x, y, z), (right, back, top))

    if on_gpu():  # all at once: a loop would take longer to launch than to run
        at = jnp.arange(STRETCHES, dtype=jnp.int32)
        filled = jnp.where(jax.vmap(occupied)(at), at[:, None], STRETCHES)
        return Stretches(box.near, length, jax.lax.cummin(filled, axis=0, reverse=True))

    def visit(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        at, next_one, table = state
        at = at - 1
        next_one = jnp.where(occupied(at), at, next_one)
        return at, next_one, jax.lax.dynamic_update_slice_in_dim(table, next_one[None], at, 0)

    none = jnp.full(box.near.shape, STRETCHES, jnp.int32)
    table = jnp.full((STRETCHES, *none.shape), STRETCHES, jnp.int32)
    _, _, table = jax.lax.while_loop(lambda state: state[0] > 0, visit, varying((number, none, table)))
    return Stretches(box.near, length, table)
