"""How far ahead is nothing visible? Space leaping (Chae and Shin; KISTI report 2005).

All methods query the same grid of occupied cells (`Occupancy`), which follows the transfer function. They
differ in the query, and in the rays that share its answer:

- beams of 8 x 8 pixels, stretch by stretch, whether the box around it is empty (`"hierarchy"`);
- rays one by one, how far away the nearest occupied cell is (`"distance"`);
- the latter, from a distance on that cells of R x R pixels share (`"min_distance"`, `"beam"`).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from .._util.checks import integer
from .._util.vec3 import Scalar, Vec3
from ..beams import Box, Stretches, stretches
from ..march import EmptySpaceIndex, Transform, View
from ..occupancy import FARTHEST, Occupancy, Sums
from ..space import Ray


Method: TypeAlias = Literal["hierarchy", "distance", "min_distance", "beam"]

LEAPS = 4
"""Leaps from cell to cell before the next samples: rays that have arrived wait for those that have not."""


class SpaceLeaping(Transform):
    """Leap over regions in which the transfer function shows nothing.

    Leaps are whole steps, so every sample that is taken is one of the march without leaping: the image stays
    the same, except under `"min_distance"`. `EmptySpaceJitter` takes what is leapt over for transparent.

    **Arguments:**

    - `method`:
        - `"hierarchy"`: the rays of 8 x 8 pixels leap together, over each stretch of the beam in whose
          box no block of 4³ voxels holds anything visible. Tables of sums answer for boxes of any size
          at once, where an octree would be walked from coarse to fine.
        - `"distance"`: each ray leaps as far as a map of (chessboard) distances to the nearest visible
          block proves. Short leaps where it runs along a surface.
        - `"min_distance"`: as `"distance"`, from a start that the corners of cells of `cell` x `cell`
          pixels share: the nearest of their four first hits. **It is not a bound**: what is thinner than
          a cell, and nearer than what its corners hit, is leapt over. The image is wrong there, more
          so the larger the cells.
        - `"beam"`: as `"min_distance"`, but the start is proven from everything in the cell's beam.
    - `cell`: pixels along a cell of the last two methods; at least 2.

    Which blocks are visible is found again for every image, from the transfer function as it is then.
    What is leapt over has extinction 0, so the image loses nothing. An extinction of 0 has a gradient
    nevertheless. `adjoint="direct"`, which marches without leaps, sees it; `"forward"` takes it as 0 wherever
    rays leap, and `"replay"` also in front of and behind all that a ray sees. A fit that is to make visible
    what is not begins above 0, or leaps not.

    **Raises:** `ValueError` for another method or a smaller cell, and, with the last two methods, when
    rendering rays of one's own.

    Source: `"min_distance"` is the grid of Chae and Shin, over the distance map that they start from
    (`"distance"`). Theirs holds a distance for each voxel, ours the chessboard distance
    for each block of 4³ voxels; theirs does not march the rays at the corners of cells again, ours does.
    `"hierarchy"` stands for the octree of the KISTI report 2005, which designs one and does not get it to
    work. `"beam"` is not published: it is the bound that `"min_distance"` is not.
    """

    method: Method = eqx.field(static=True)
    cell: int = eqx.field(static=True)

    def __init__(self, method: Method | Any = "hierarchy", cell: int | Any = 8):
        if method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}; got {method!r}.")
        self.method = method
        self.cell = integer("cell", cell, 2)

    def empty_space(self, occupancy: Occupancy, view: View | None) -> EmptySpaceIndex:
        occupancy = jax.lax.stop_gradient(occupancy)
        if self.method == "hierarchy":
            return _Beams(occupancy, occupancy.sums())
        distances = _Distances(occupancy, occupancy.distance(), None, None, self.cell)
        if self.method == "distance":
            return distances
        if view is None:
            raise ValueError(
                f'SpaceLeaping("{self.method}") needs the neighbouring pixels of a camera; for rays of your '
                'own use "hierarchy" or "distance".'
            )
        published = self.method == "min_distance"
        starts = self._published(distances, view) if published else self._proven(occupancy, view)
        return replace(distances, starts=jax.lax.stop_gradient(starts), corner=view.corner)

    def _corners(self, view: View) -> tuple[Int[Array, "cols"], Int[Array, "rows"]]:
        width, height = view.size
        columns, rows = (jnp.arange(-(-n // self.cell) + 1) * self.cell for n in (width, height))
        return columns, rows

    def _published(self, distances: EmptySpaceIndex, view: View) -> Float[Array, "rows cols"]:
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
        column, row = (
            jnp.moveaxis(i.reshape(4, *i.shape[2:]), 0, -1) for i in jnp.broadcast_arrays(column, row)
        )
        cast = jnp.vectorize(lambda x, y: tuple(part for end in view.ray(x, y) for part in end))
        x, y, z, *direction = cast(column, row)
        box = Box.within(occupancy, (x, y, z), tuple(direction))
        box = jax.tree.map(jnp.ravel, box)
        found = stretches(occupancy, occupancy.sums(), box, jnp.min(jnp.stack(occupancy.size)))
        first = found.following[0].astype(found.near.dtype)
        start = jnp.where(first < found.following.shape[0], found.near + first * found.length, jnp.inf)
        return start.reshape(column.shape[:-1])


class FirstHit(Transform):
    """End a ray at its first sample that is seen."""

    def stop(self, stopped: Bool[Array, ""], transmittance: Scalar) -> Bool[Array, ""]:
        return stopped | (transmittance < 1)


class _Beams(EmptySpaceIndex):
    """Whether a stretch of a beam is empty, from the box around it."""

    occupancy: Occupancy
    sums: Sums

    def prepare(self, box: Callable[[Occupancy], Box], stretch: Scalar) -> Stretches:
        return stretches(self.occupancy, self.sums, box(self.occupancy), stretch)

    def any_visible(self, prepared: Stretches) -> Bool[Array, " beams"]:
        return prepared.following[0] < prepared.following.shape[0]

    def skip_to(
        self, prepared: Stretches, beam: Int[Array, " rays"], rays: Ray, depth: Float[Array, " rays"]
    ) -> Float[Array, " rays"]:
        count, beams = prepared.following.shape
        near = prepared.near.at[beam].get(mode="promise_in_bounds")
        place = (rays.t_in + depth - near) / prepared.length
        stretch = jnp.clip(place.astype(jnp.int32), 0, count - 1)
        entry = stretch * beams + beam
        following = (
            prepared.following.reshape(-1)
            .at[entry]
            .get(mode="promise_in_bounds", wrap_negative_indices=False)
        )
        begin = near + following.astype(depth.dtype) * prepared.length - rays.t_in
        return jnp.where(following > stretch, jnp.where(following >= count, jnp.inf, begin), depth)


class _Distances(EmptySpaceIndex):
    """How far each ray may go, from the distance of its cell to the nearest occupied one."""

    occupancy: Occupancy
    distance: UInt8[Array, " cells"]
    starts: Float[Array, "rows cols"] | None
    """Distance from the origin before which nothing is to be seen, for each cell of pixels."""
    corner: tuple[Int[Array, ""], Int[Array, ""]] | None
    """Pixel in the corner of the first cell."""
    cell: int = eqx.field(static=True)

    def prepare(self, box: Callable[[Occupancy], Box], stretch: Scalar) -> None:
        return None

    def any_visible(self, prepared: None) -> Bool[Array, ""]:
        return jnp.ones((), bool)

    def within_ranges(self) -> EmptySpaceIndex:
        # A ray's own range says more than a start that it shares with its neighbours.
        return replace(self, starts=None, corner=None)

    def skip_to(
        self, prepared: None, beam: Int[Array, " rays"], rays: Ray, depth: Float[Array, " rays"]
    ) -> Float[Array, " rays"]:
        start = self.occupancy.cell(rays.entry)
        rate = [r / size for r, size in zip(rays.direction, self.occupancy.size, strict=True)]
        if self.starts is not None:
            assert self.corner is not None
            last = (n - 1 for n in reversed(self.starts.shape))
            # those that only fill up groups lie past the image
            x, y = (
                jnp.minimum((pixel - first.astype(pixel.dtype)) // self.cell, n)
                for pixel, first, n in zip(rays.pixel, self.corner, last, strict=True)
            )
            depth = jnp.maximum(depth, self.starts[y, x] - rays.t_in)
        for _ in range(LEAPS):
            depth = self._leap(start, rate, rays.length, depth)
        return depth

    def _leap(self, start: Vec3, rate: Any, length: Scalar, depth: Scalar) -> Scalar:
        _, ny, nz = shape = self.occupancy.occupied.shape
        point = [s + depth * r for s, r in zip(start, rate, strict=True)]
        x, y, z = (jnp.clip(jnp.floor(p), 0, n - 1) for p, n in zip(point, shape, strict=True))
        i, j, k = (corner.astype(jnp.int32) for corner in (x, y, z))
        flat = (i * ny + j) * nz + k
        away = (
            self.distance.at[flat]
            .get(mode="promise_in_bounds", wrap_negative_indices=False)
            .astype(depth.dtype)
        )
        # all cells nearer than that are empty: on to where the ray leaves their cube
        ahead = jnp.inf
        for p, r, corner in zip(point, rate, (x, y, z), strict=True):
            face = jnp.where(r > 0, corner + away, corner + 1 - away)
            ahead = jnp.minimum(ahead, jnp.where(r == 0, jnp.inf, (face - p) / jnp.where(r == 0, 1, r)))
        ahead = jnp.where(away >= FARTHEST, jnp.inf, ahead)
        return jnp.where((away > 0) & (depth < length), depth + jnp.maximum(ahead, 0), depth)
