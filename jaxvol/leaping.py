"""How far ahead is nothing to be seen? Space leaping (Chae and Shin; KISTI report 2005).

All methods ask the same grid of occupied cells (`Occupancy`), which follows the transfer function. They
differ in what they ask, and for whom:

- beams of 8 x 8 pixels, stretch by stretch, whether the box around it is empty (`"hierarchy"`);
- rays one by one, how far away the nearest occupied cell is (`"distance"`);
- the latter, from a distance on that cells of R x R pixels share (`"min_distance"`, `"beam"`).
"""

from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from .checks import integer
from .locate import Ray
from .march import Survey, Transform, View
from .occupancy import FARTHEST, Index, Occupancy, Sums
from .triple import Scalar, Triple, along


Method: TypeAlias = Literal["hierarchy", "distance", "min_distance", "beam"]

STRETCHES = 128
"""Pieces, at most, into which a beam is divided. In a volume that it crosses with more samples than these
hold, each stands for a multiple of the samples that are taken at once."""

LEAPS = 4
"""Leaps from cell to cell before the next samples: rays that have arrived wait for those that have not."""

ROUNDING = 64 * float(jnp.finfo(jnp.float32).eps)


class SpaceLeaping(Transform):
    """Leap over regions in which the transfer function shows nothing.

    Leaps are whole steps, so every sample that is taken is one of the march without leaping: the image stays
    the same, except under `"min_distance"`. `EmptySpaceJitter` takes what is leapt over for transparent.

    **Arguments:**

    - `method`:
        - `"hierarchy"`: the rays of 8 x 8 pixels leap together, over each stretch of the beam in whose
          box no block of 4³ voxels holds anything visible. Tables of sums answer for boxes of any size
          at once, where an octree would be walked from coarse to fine. The fastest.
        - `"distance"`: each ray leaps as far as a map of (chessboard) distances to the nearest visible
          block proves. Short leaps where it runs along a surface.
        - `"min_distance"`: as `"distance"`, from a start that the corners of cells of `cell` x `cell`
          pixels share: the nearest of their four first hits. **It is not a bound**: what is thinner than
          a cell, and nearer than what its corners hit, is leapt over. The image is wrong there, more
          so the larger the cells.
        - `"beam"`: as `"min_distance"`, but the start is proven from everything in the cell's beam.
    - `cell`: pixels along a cell of the last two methods; at least 2.

    Which blocks are visible is found again for every image, from the transfer function as it is then.
    Gradients do not see the leaps, and lose nothing by it: what is leapt over has extinction 0. (An
    extinction of 0 has a gradient nevertheless. In leapt-over regions it is taken as 0.)

    **Raises:** `ValueError` for another method or a smaller cell, and, with the last two methods, when
    rendering rays of one's own.

    Source: `"distance"`, `"min_distance"`: Chae and Shin, as in METHODS 001; the octree is the KISTI
    report's, section "octree skipping", which could not finish it.
    """

    method: Method = eqx.field(static=True)
    cell: int = eqx.field(static=True)

    def __init__(self, method: Method | Any = "hierarchy", cell: int | Any = 8):
        if method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}; got {method!r}.")
        self.method = method
        self.cell = integer("cell", cell, 2)

    def survey(self, occupancy: Occupancy, view: View | None) -> Survey:
        occupancy = jax.lax.stop_gradient(occupancy)
        if self.method == "hierarchy":
            return _Beams(occupancy, occupancy.sums())
        distances = _Distances(occupancy, occupancy.distance(), None, self.cell)
        if self.method == "distance":
            return distances
        if view is None:
            raise ValueError(
                f'SpaceLeaping("{self.method}") needs the neighbouring pixels of a camera; for rays of your own '
                'use "hierarchy" or "distance".'
            )
        published = self.method == "min_distance"
        starts = self._published(distances, view) if published else self._proven(occupancy, view)
        return replace(distances, starts=jax.lax.stop_gradient(starts))

    def _corners(self, view: View) -> tuple[Int[Array, "cols"], Int[Array, "rows"]]:
        width, height = view.size
        return tuple(jnp.arange(-(-n // self.cell) + 1) * self.cell for n in (width, height))

    def _published(self, distances: Survey, view: View) -> Float[Array, "rows cols"]:
        """The nearest first hit of each cell's four corner rays."""
        columns, rows = self._corners(view)
        hits = view.first_hit(distances, *jnp.meshgrid(columns, rows))
        across = jnp.minimum(hits[:, 1:], hits[:, :-1])
        return jnp.minimum(across[1:], across[:-1])

    def _proven(self, occupancy: Occupancy, view: View) -> Float[Array, "rows cols"]:
        """The distance up to which no cell of the grid that each beam meets is occupied."""
        columns, rows = self._corners(view)
        last = self.cell - 1
        column = jnp.stack([columns[:-1], columns[:-1] + last])[None, :, None, :]
        row = jnp.stack([rows[:-1], rows[:-1] + last])[:, None, :, None]
        # (rows, cols, 4): the rays in the corners of each cell
        column, row = (jnp.moveaxis(i.reshape(4, *i.shape[2:]), 0, -1) for i in jnp.broadcast_arrays(column, row))
        cast = jnp.vectorize(lambda x, y: tuple(part for end in view.ray(x, y) for part in end))
        x, y, z, *direction = cast(column, row)
        box = _Box.within(occupancy, (x, y, z), tuple(direction))
        box = jax.tree.map(jnp.ravel, box)
        found = _stretches(occupancy, occupancy.sums(), box, jnp.min(jnp.stack(occupancy.size)))
        first = found.following[:, 0].astype(found.near.dtype)
        start = jnp.where(first < found.following.shape[1], found.near + first * found.length, jnp.inf)
        return start.reshape(column.shape[:-1])


class FirstHit(Transform):
    """End a ray at its first sample that is seen."""

    def stop(self, stopped: Bool[Array, ""], transmittance: Scalar) -> Bool[Array, ""]:
        return stopped | (transmittance < 1)


class _Beams(Survey):
    """Whether a stretch of a beam is empty, from the box around it."""

    occupancy: Occupancy
    sums: Sums

    def notes(self, rays: Ray, stretch: Scalar) -> "_Stretches":
        return _stretches(self.occupancy, self.sums, _Box.around(self.occupancy, rays), stretch)

    def clear(
        self, notes: "_Stretches", rays: Ray, depth: Float[Array, "beams rays"]
    ) -> Float[Array, "beams rays"]:
        beams, count = notes.following.shape
        place = (rays.t_in + depth - notes.near[:, None]) / notes.length[:, None]
        stretch = jnp.clip(place.astype(jnp.int32), 0, count - 1)
        entry = jnp.arange(beams, dtype=jnp.int32)[:, None] * count + stretch
        following = notes.following.reshape(-1).at[entry].get(mode="promise_in_bounds", wrap_negative_indices=False)
        begin = notes.near[:, None] + following.astype(depth.dtype) * notes.length[:, None] - rays.t_in
        return jnp.where(following > stretch, jnp.where(following >= count, jnp.inf, begin), depth)


class _Stretches(eqx.Module):
    """Which stretches of beams are empty.

    - `near`: distance from the origins at which the first stretch begins; `length`: of each.
    - `following`: for each stretch the first one, itself or behind it, that is not empty.
    """

    near: Float[Array, " beams"]
    length: Float[Array, " beams"]
    following: Int[Array, "beams stretches"]


class _Box(eqx.Module):
    """The box in which the rays of a beam are, at each distance from their origins: counted in cells of the
    occupancy, from `low + u low_rate` to `high + u high_rate` at the distance `near + u`."""

    near: Float[Array, " beams"]
    far: Float[Array, " beams"]
    low: Triple
    high: Triple
    low_rate: Triple
    high_rate: Triple

    @classmethod
    def around(cls, occupancy: Occupancy, rays: Ray) -> "_Box":
        """The box of rays whose last axis is that of a beam's rays; those that miss the volume do not count."""
        rays = jax.lax.stop_gradient(rays)
        hit = rays.length > 0
        near = jnp.min(jnp.where(hit, rays.t_in, jnp.inf), axis=-1)
        near = jnp.where(jnp.isfinite(near), near, 0)
        far = jnp.max(jnp.where(hit, rays.t_in + rays.length, -jnp.inf), axis=-1)
        start = along(rays.entry, rays.direction, near[..., None] - rays.t_in)
        return cls._of(occupancy, start, rays.direction, near, far, hit, jnp.zeros_like(near))

    @classmethod
    def within(cls, occupancy: Occupancy, origin: Triple, direction: Triple) -> "_Box":
        """The box of all rays of a camera between those given, whose last axis is that of a cell's corners."""
        origin, direction = jax.lax.stop_gradient((origin, direction))
        x, y, z = (
            low + size * n / 2 - jnp.mean(o, axis=-1)
            for o, low, size, n in zip(
                origin, occupancy.origin, occupancy.size, occupancy.occupied.shape, strict=True
            )
        )
        middle = jnp.sqrt(x * x + y * y + z * z)
        around = jnp.sqrt(
            sum((size * n) ** 2 for size, n in zip(occupancy.size, occupancy.occupied.shape, strict=True))
        )
        # Directions between those of the corners are their averages, made unit vectors: longer by 1 minus the
        # cosine at most of the widest angle to the middle one.
        axis = [jnp.mean(d, axis=-1, keepdims=True) for d in direction]
        cosine = sum(a * d for a, d in zip(axis, direction, strict=True))
        bulge = 1 - jnp.min(cosine, axis=-1) / jnp.sqrt(sum(a[..., 0] ** 2 for a in axis)) + 1e-6
        near, far = jnp.maximum(middle - around, 0), middle + around
        start = along(origin, direction, near[..., None])
        return cls._of(occupancy, start, direction, near, far, jnp.ones(start[0].shape, bool), bulge)

    @classmethod
    def _of(
        cls,
        occupancy: Occupancy,
        start: Triple,
        direction: Triple,
        near: Scalar,
        far: Scalar,
        counts: Bool[Array, "*beams rays"],
        bulge: Scalar,
    ) -> "_Box":
        def least(values: Array, sign: int) -> Array:
            return sign * jnp.min(jnp.where(counts, sign * values, jnp.inf), axis=-1)

        sides = []
        for s, d, size, corner in zip(
            start, direction, occupancy.size, occupancy.origin, strict=True
        ):
            # what float32 makes of the start of a ray whose camera is far away
            slack = 1e-3 + (ROUNDING * (near + abs(corner) + size) + bulge * near) / size
            s, d = (s - corner) / size, d / size
            sides.append(
                (least(s, 1) - slack, least(s, -1) + slack, least(d, 1) - bulge / size, least(d, -1) + bulge / size)
            )
        low, high, low_rate, high_rate = (tuple(side) for side in zip(*sides, strict=True))
        return cls(near, far, low, high, low_rate, high_rate)

    def between(self, first: Scalar, last: Scalar) -> tuple[Triple, Triple]:
        """The box of everything from `near + first` to `near + last`, both ≥ 0."""
        low = tuple(
            start + jnp.minimum(first * rate, last * rate)
            for start, rate in zip(self.low, self.low_rate, strict=True)
        )
        high = tuple(
            start + jnp.maximum(first * rate, last * rate)
            for start, rate in zip(self.high, self.high_rate, strict=True)
        )
        return low, high


def _stretches(occupancy: Occupancy, sums: Sums, box: _Box, stretch: Scalar) -> _Stretches:
    """Ask for each stretch of each beam, from the last one to the first, which one is the next occupied."""
    across = jnp.maximum(box.far - box.near, 0)
    # whole multiples of what is sampled at once, the same for all beams, so that none is cut in two
    multiple = jnp.ceil(jnp.max(across) / (stretch * STRETCHES))
    length = jnp.maximum(multiple, 1) * stretch
    number = jnp.minimum(jnp.ceil(jnp.max(across) / length).astype(jnp.int32), STRETCHES)

    def ask(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        at, next_one, table = state
        at = at - 1
        first = at.astype(length.dtype) * length
        low, high = box.between(first - 1e-2 * length, first + 1.01 * length)
        shape, inside = occupancy.occupied.shape, first < across
        for a, b, n in zip(low, high, shape, strict=True):
            inside &= (b >= 0) & (a <= n)

        def cells(corner: Triple) -> Index:
            """The cells of a corner, in the grid; some cell for boxes that are not."""
            x, y, z = (
                jnp.clip(jnp.floor(jnp.where(inside, c, 0)), 0, n - 1).astype(jnp.int32)
                for c, n in zip(corner, shape, strict=True)
            )
            return x, y, z

        occupied = inside & sums.any_between(cells(low), cells(high))
        next_one = jnp.where(occupied, at, next_one)
        return at, next_one, jax.lax.dynamic_update_slice_in_dim(table, next_one[None].astype(table.dtype), at, 0)

    none = jnp.full(box.near.shape, STRETCHES, jnp.int32)
    table = jnp.full((STRETCHES, *none.shape), STRETCHES, jnp.int16)
    _, _, table = jax.lax.while_loop(lambda state: state[0] > 0, ask, (number, none, table))
    return _Stretches(box.near, jnp.full(box.near.shape, 1.0) * length, table.T)


class _Distances(Survey):
    """How far each ray may go, from the distance of its cell to the nearest occupied one."""

    occupancy: Occupancy
    distance: UInt8[Array, " cells"]
    starts: Float[Array, "rows cols"] | None
    """Distance from the origin before which nothing is to be seen, for each cell of pixels."""
    cell: int = eqx.field(static=True)

    def notes(self, rays: Ray, stretch: Scalar) -> Float[Array, "beams rays"] | None:
        if self.starts is None:
            return None
        column, row = rays.pixel
        rows, columns = self.starts.shape
        x, y = jnp.minimum(column // self.cell, columns - 1), jnp.minimum(row // self.cell, rows - 1)
        return self.starts[y, x] - rays.t_in

    def clear(
        self, notes: Float[Array, "beams rays"] | None, rays: Ray, depth: Float[Array, "beams rays"]
    ) -> Float[Array, "beams rays"]:
        start = self.occupancy.cell(rays.entry)
        rate = [r / size for r, size in zip(rays.direction, self.occupancy.size, strict=True)]
        if notes is not None:
            depth = jnp.maximum(depth, notes)
        for _ in range(LEAPS):
            depth = self._leap(start, rate, rays.length, depth)
        return depth

    def _leap(self, start: Triple, rate: Any, length: Scalar, depth: Scalar) -> Scalar:
        _, ny, nz = shape = self.occupancy.occupied.shape
        point = [s + depth * r for s, r in zip(start, rate, strict=True)]
        x, y, z = (jnp.clip(jnp.floor(p), 0, n - 1) for p, n in zip(point, shape, strict=True))
        flat = ((x * ny + y) * nz + z).astype(jnp.int32)
        away = self.distance.at[flat].get(mode="promise_in_bounds", wrap_negative_indices=False).astype(depth.dtype)
        # all cells nearer than that are empty: on to where the ray leaves their cube
        ahead = jnp.inf
        for p, r, corner in zip(point, rate, (x, y, z), strict=True):
            face = jnp.where(r > 0, corner + away, corner + 1 - away)
            ahead = jnp.minimum(ahead, jnp.where(r == 0, jnp.inf, (face - p) / jnp.where(r == 0, 1, r)))
        ahead = jnp.where(away >= FARTHEST, jnp.inf, ahead)
        return jnp.where((away > 0) & (depth < length), depth + jnp.maximum(ahead, 0), depth)
