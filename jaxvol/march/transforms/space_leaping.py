"""Space leaping: passes over regions that show nothing (Chae and Shin; KISTI report 2005)."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, SupportsIndex, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from ..._util.checks import integer
from ..._util.texts import warn_caller
from ..._util.vec3 import Scalar, Vec3
from ...scene.occupancy import BLOCK, FARTHEST, Occupancy, Sums
from ...scene.space import Ray
from ...scene.volume import Volume
from ...xla.memory import gather
from ...xla.trees import unchecked
from ..beams import Box, EmptySpaceIndex, Skips, Stretches, View, stretches
from ..march import Transform


Method: TypeAlias = Literal["blocks", "distance", "min_distance", "beam"]

LEAPS = 4
"""Leaps from block to block between two segments."""


class SpaceLeaping(Transform):
    """Leap over regions in which the transfer function shows nothing.

    Leaps are whole steps: the image stays the same, except under `"min_distance"`, to 1e-6. Under
    `quadrature="preintegrated"`, cells that are not leapt over share the value between them; its rounding
    shows by up to 3e-5 in float32, at a hard edge of the transfer function.

    Args:
        method: how what is empty is found.
            `"blocks"`: the rays of 8 x 8 pixels leap together, over each stretch of their beam whose
            bounding box holds no visible block of 4³ voxels. Blocks have one level; a table of their sums
            tells of a box of any size whether it is empty, as coarser levels would.
            `"distance"`: each ray leaps as far as a map of chessboard distances to the nearest visible block
            proves empty. Leaps are short where a ray runs along a surface. In a cavity, with blocks of 1, it
            is the fastest that misses nothing; elsewhere `"blocks"` is.
            `"min_distance"`: as `"distance"`, from a start that `cell` x `cell` pixels share: the nearest of
            the first hits of their four corner rays. **It is not a bound**: what is thinner than these
            pixels, and nearer than what their corners hit, is missing in the image.
            `"beam"`: as `"min_distance"`, but with a start that is proven for all of the pixels.
        cell: side of the square of pixels of the last two methods; at least 2.
        block: cells of the voxel grid along the side of a block of the map of distances (of `"distance"` and
            `"min_distance"`): 1, as published, 2 or 4. The map of single cells leaps farther along
            surfaces, but takes a tenth of a second for 256³ voxels (two cores; blocks of 2: a hundredth),
            and some ten bytes for each while it is made, two from then on. It is made once for a volume, a
            transfer function and cuts that are held, and in each image where one of them is traced
            (`jax.jit`, `jax.grad`) or made anew.

    What is leapt over has extinction 0, but the derivative of the image with respect to it is not 0. Only
    `adjoint="direct"`, which does not leap, includes it; `"forward"` takes it as 0 where rays leap,
    `"replay"` also in front of and behind everything that a ray sees. A fit that should make invisible
    regions visible must start above 0, or not leap.

    Where it fails: `experiments/stability.py`, "sheets thinner than a cell of rays",
    "distance maps along a wall", "occupancy under steep transfer functions",
    "gradients of what is leapt over".

    Raises:
        ValueError: for another method, a smaller cell, another block or one with another method. When
            rendering several volumes with another block than 4, and, with the last two methods, rays of
            one's own (`render_rays`).

    Source: Chae and Shin for `"min_distance"`, and, after Zuiderveld et al. 1992, `"distance"`, with blocks
    of 1; `"blocks"` stands for the octree of the KISTI report 2005; `"beam"` is unpublished.
    """

    method: Method = eqx.field(static=True)
    cell: int = eqx.field(static=True)
    block: int = eqx.field(static=True)

    def __init__(
        self,
        method: Method | Literal["hierarchy"] = "blocks",
        cell: SupportsIndex = 8,
        *,
        block: SupportsIndex = BLOCK,
    ):
        if method == "hierarchy":
            warn_caller('SpaceLeaping("hierarchy") is called SpaceLeaping("blocks") now.')
            method = "blocks"
        if method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}; got {method!r}.")
        self.method = method
        self.cell = integer("cell", cell, 2)
        self.block = integer("block", block, 1)
        if block not in (1, 2, BLOCK):
            raise ValueError(f"block must be 1, 2 or {BLOCK}; got {block}.")
        if block != BLOCK and method not in ("distance", "min_distance"):
            raise ValueError(
                f'block={block} needs method="distance" or "min_distance"; got method="{method}".'
            )

    @property
    def block_side(self) -> int:
        return self.block

    def empty_space(self, occupancy: Occupancy, view: View | None) -> EmptySpaceIndex:
        occupancy = jax.lax.stop_gradient(occupancy)
        if self.method == "blocks":
            return self.index_of(occupancy, Sums.of(occupancy.occupied))
        distances = _Distances(occupancy, occupancy.distance(), None, None, self.cell)
        if self.method == "distance":
            return distances
        if view is None:
            name = f'SpaceLeaping("{self.method}")'
            raise ValueError(f'{name} needs neighbouring pixels; for rays use "blocks" or "distance".')
        columns, rows = (jnp.arange(-(-n // self.cell) + 1) * self.cell for n in view.size)
        if self.method == "beam":
            starts = self._beam_starts(occupancy, view, *jnp.meshgrid(columns[:-1], rows[:-1]))
        else:
            hits = view.first_hit(distances, *jnp.meshgrid(columns, rows))
            across = jnp.minimum(hits[:, 1:], hits[:, :-1])
            starts = jnp.minimum(across[1:], across[:-1])
        return replace(distances, starts=jax.lax.stop_gradient(starts), corner=view.corner)

    def index_of(self, occupancy: Occupancy, sums: Sums) -> EmptySpaceIndex:
        """The index of `"blocks"`, from sums of occupied cells."""
        return _Beams(occupancy, sums)

    def _beam_starts(self, occupancy: Occupancy, view: View, column: Array, row: Array) -> Array:
        """Distances up to which the rays of each square of pixels meet nothing visible."""
        last = self.cell - 1
        column = jnp.stack([column, column + last, column, column + last], axis=-1)
        row = jnp.stack([row, row, row + last, row + last], axis=-1)
        cast = jnp.vectorize(lambda x, y: tuple(part for end in view.ray(x, y) for part in end))
        x, y, z, dx, dy, dz = (part.reshape(-1, 4) for part in cast(column, row))
        rays = {"entry": (x, y, z), "direction": (dx, dy, dz), "t_in": jnp.zeros_like(x)}
        none = {"length": None, "path": None, "pixel": None, "gaps": (), "spans": (), "reach": None}
        box = Box.within(occupancy, unchecked(Ray, **rays, **none))
        beams = stretches(occupancy, Sums.of(occupancy.occupied), box, jnp.min(jnp.stack(occupancy.size)))
        first = beams.following[0].astype(beams.near.dtype)
        start = jnp.where(first < beams.following.shape[0], beams.near + first * beams.length, jnp.inf)
        return start.reshape(column.shape[:-1])


class _Beams(EmptySpaceIndex):
    """Skips the stretches of a beam whose bounding boxes are empty."""

    occupancy: Occupancy
    sums: Sums

    @property
    def unshaped(self) -> "_Beams":
        return _Beams(self.occupancy.unshaped, self.sums)

    def on_axes_of(self, volume: Volume) -> "_Beams":
        frame: Any = self.occupancy.frame
        if frame is not None:
            return self
        return _Beams(unchecked(self.occupancy, frame=volume.frame), self.sums)

    def skips(self, box: Callable[[Occupancy], Box], stretch: Scalar) -> Stretches:
        return stretches(self.occupancy, self.sums, box(self.occupancy), stretch)


class _Distances(EmptySpaceIndex, Skips):
    """Skips, ray by ray, as far as the nearest occupied cell allows."""

    occupancy: Occupancy
    distance: UInt8[Array, " cells"]
    starts: Float[Array, "rows cols"] | None
    """For each cell of pixels, the distance from the ray origins before which nothing is visible."""
    corner: tuple[Int[Array, ""], Int[Array, ""]] | None
    """Pixel at the corner of the first cell."""
    cell: int = eqx.field(static=True)

    def skips(self, box: Callable[[Occupancy], Box], stretch: Scalar) -> Skips:
        return self

    def any_visible(self) -> Bool[Array, ""]:
        return jnp.ones((), bool)

    def within_ranges(self) -> EmptySpaceIndex:
        return replace(self, starts=None, corner=None)

    def skip_to(self, beam: Int[Array, " rays"], rays: Ray, depth: Scalar) -> Scalar:
        start = self.occupancy.cell(rays.entry)
        direction = self.occupancy.frame.components(rays.direction)
        rate = [r / size for r, size in zip(direction, self.occupancy.size, strict=True)]
        if self.starts is not None:
            assert self.corner is not None
            last = (n - 1 for n in reversed(self.starts.shape))
            # rays that only pad groups lie outside the image
            x, y = (
                jnp.minimum((pixel - first.astype(pixel.dtype)) // self.cell, n)
                for pixel, first, n in zip(rays.pixel, self.corner, last, strict=True)
            )
            depth = jnp.maximum(depth, self.starts[y, x] - rays.t_in)
        for _ in range(LEAPS):
            depth = self._leap(start, rate, rays.length, depth)
        return depth

    def _leap(self, start: Vec3, rate: Any, length: Scalar, depth: Scalar) -> Scalar:
        _, ny, nz = shape = self.occupancy.shape
        point = [s + depth * r for s, r in zip(start, rate, strict=True)]
        x, y, z = (jnp.clip(jnp.floor(p), 0, n - 1) for p, n in zip(point, shape, strict=True))
        i, j, k = (corner.astype(jnp.int32) for corner in (x, y, z))
        flat = (i * ny + j) * nz + k
        distance = gather(self.distance, flat).astype(depth.dtype)
        # all cells nearer than `distance` are empty: advance to where the ray leaves their cube
        ahead = jnp.inf
        for p, r, corner in zip(point, rate, (x, y, z), strict=True):
            face = jnp.where(r > 0, corner + distance, corner + 1 - distance)
            ahead = jnp.minimum(ahead, jnp.where(r == 0, jnp.inf, (face - p) / jnp.where(r == 0, 1, r)))
        ahead = jnp.where(distance >= FARTHEST, jnp.inf, ahead)
        return jnp.where((distance > 0) & (depth < length), depth + jnp.maximum(ahead, 0), depth)
