"""Division of an image into tiles, beams and groups of rays, and generation of the rays of a tile.

An image is divided into tiles (of 4096 beams by default), a tile into beams (8 x 8 pixels: four groups), and
a beam into groups (4 x 4 pixels: 16 rays). Besides finished pixels, only the rays of one tile are in memory,
as arrays (groups, rays in a group), for images of any size.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.checks import all_finite
from .._util.vec3 import Scalar
from ..march.beams import Box, EmptySpaceIndex, Skips
from ..ray import Scene
from ..scene.camera import Camera, Ending, GivenRays, RaySubset
from ..scene.occupancy import Occupancy
from ..scene.rendering import Rendering
from ..scene.space import Line, Ray, Space, enter
from ..xla.differentiation import nan_derivatives
from ..xla.memory import in_memory
from ..xla.trees import PyTree, unchecked
from .tiling import GROUPS_OF_BEAM, Tiling


Lanes = Int[Array, "groups rays"]

Source: TypeAlias = Camera | GivenRays | Ending | RaySubset


class RayTiles(eqx.Module):
    """The order of an image's rays.

    Attributes:
        number: number of tiles.
        beam_count: number of beams in each tile.
    """

    number: int = eqx.field(static=True)
    beam_count: int = eqx.field(static=True)
    tiling: Tiling = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        source: Source,
        tiling: Tiling,
        *,
        direct: bool = False,
        tiles: tuple[int, int] | None = None,
    ) -> "RayTiles":
        """The tiles of a camera's pixels, or of given rays.

        Args:
            direct: whether tiles are small, for `adjoint="direct"`.
            tiles: number of tiles, and of beams in each; None: as the tiling says.
        """
        source = source.rays if isinstance(source, Ending) else source
        limit = tiling.direct_tile if direct else tiling.tile

        def divided(beams: int) -> tuple[int, int]:
            if tiles is not None:
                return tiles
            count = max(min(limit, beams), 1)
            return -(-beams // count), count

        if isinstance(source, Camera):
            width, height = source.size
            across, down = -(-width // tiling.beam), -(-height // tiling.beam)
            return _PixelTiles(*divided(across * down), tiling, source.size, across, down)
        return _GivenRayTiles(*divided(_beams_of(source, tiling)), tiling, _shape_of(source))

    @staticmethod
    def shared(source: Camera | GivenRays, tiling: Tiling) -> tuple[int, int]:
        """Number of beams in a tile, one of three, so that images share programs; and number of tiles."""
        beams = max(_beams_of(source, tiling), tiling.least)
        for size in (tiling.tile // 16, tiling.tile // 4):
            if beams <= 2 * size:
                return size, max(-(-beams // size), 1)
        return tiling.tile, -(-beams // tiling.tile)

    @property
    def groups(self) -> int:
        """Number of groups in each tile."""
        return self.beam_count * GROUPS_OF_BEAM

    def scan(
        self, f: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], sums: PyTree, *trees: PyTree
    ) -> tuple[PyTree, PyTree]:
        """Folds `f(sums, (tile, *trees))` over the tiles, and stacks its second result."""
        return jax.lax.scan(f, sums, (jnp.arange(self.number), *trees))

    def map(self, f: Callable[[PyTree], PyTree], *trees: PyTree) -> PyTree:
        """Stacked results of `f((tile, *trees))` for all tiles."""
        return jax.lax.map(f, (jnp.arange(self.number), *trees))

    def beams(self, tile: Int[Array, ""]) -> Int[Array, " beams"]:
        """The numbers of a tile's beams."""
        return tile * self.beam_count + jnp.arange(self.beam_count)

    def of_beams(self, leaf: Array) -> Array:
        """Reshapes (tiles, groups, rays in a group, ...) to (beams, rays of a beam, ...)."""
        return leaf.reshape(self.number * self.beam_count, self.tiling.rays_per_beam, *leaf.shape[3:])

    def of_tiles(self, beams: Array) -> Array:
        """Inverse of `of_beams`; 0 for missing beams."""
        trailing, missing = beams.shape[2:], self.number * self.beam_count - beams.shape[0]
        beams = jnp.pad(beams, [(0, missing)] + [(0, 0)] * (beams.ndim - 1))
        groups = self.beam_count * self.tiling.rays_per_beam // self.tiling.group
        return beams.reshape(self.number, groups, self.tiling.group, *trailing)

    def rays(self, source: Source, space: Space, tile: Int[Array, ""], fault: Bool[Array, ""]) -> Ray:
        """The rays of a tile, cut to the volume. Rays that only fill up groups miss it. All are NaN, and so
        invalid, if the scene has a `fault`."""
        return enter_rays(space, *self.ending_lines(source, tile, fault), self.tiling.searched)

    def ending_lines(
        self, source: Source, tile: Int[Array, ""], fault: Bool[Array, ""]
    ) -> tuple[Line, Bool[Array, "groups rays"]]:
        """The rays of a tile, up to their `until`, and whether each belongs to the image."""
        line, wanted = self.lines_of(source.rays if isinstance(source, Ending) else source, tile, fault)
        if isinstance(source, Ending):
            line = line._replace(until=self.disassemble(source.until)[tile])
        return line, wanted

    @abstractmethod
    def lines_of(
        self, source: PyTree, tile: Int[Array, ""], fault: Bool[Array, ""]
    ) -> tuple[Line, Bool[Array, "groups rays"]]:
        """The rays of a tile, and whether each belongs to the image."""

    @abstractmethod
    def box(self, occupancy: Occupancy, rays: Ray) -> Box:
        """The boxes around the beams of a tile."""

    def skips(self, index: EmptySpaceIndex | None, rays: Ray, step: Scalar) -> Skips | None:
        """Empty stretches along the beams of a tile; None without an index."""
        if index is None:
            return None
        return index.skips(partial(self.box, rays=rays), self.tiling.cells * step)

    @abstractmethod
    def assemble(self, leaf: Array) -> Array:
        """Reshapes (tiles, groups, rays in a group, ...) to the image's shape."""

    @abstractmethod
    def disassemble(self, leaf: Array) -> Array:
        """Inverse of `assemble`; 0 for rays that only fill up groups."""


def _shape_of(source: GivenRays | RaySubset) -> tuple[int, ...]:
    return source.indices.shape if isinstance(source, RaySubset) else source.origins.shape[:-1]


def _beams_of(source: Camera | GivenRays | RaySubset, tiling: Tiling) -> int:
    """Number of beams that hold all rays."""
    if isinstance(source, Camera):
        width, height = source.size
        return -(-width // tiling.beam) * -(-height // tiling.beam)
    return -(-math.prod(_shape_of(source)) // tiling.rays_per_beam)


class _PixelTiles(RayTiles):
    """A camera's pixels: beams row by row, and each beam group by group."""

    size: tuple[int, int] = eqx.field(static=True)
    across: int = eqx.field(static=True)
    down: int = eqx.field(static=True)

    def lines_of(
        self, source: Camera, tile: Int[Array, ""], fault: Bool[Array, ""]
    ) -> tuple[Line, Bool[Array, "groups rays"]]:
        side, group = self.tiling.side, self.tiling.group
        order = jnp.arange(self.tiling.rays_per_beam)
        group_y, group_x, y, x = jnp.unravel_index(order, (2, 2, side, side))
        column, row = self._pixels(tile, group_y * side + y, group_x * side + x)
        column, row = column.reshape(-1, group), row.reshape(-1, group)
        width, height = self.size
        return lines(source, column, row, fault), (column < width) & (row < height)

    def box(self, occupancy: Occupancy, rays: Ray) -> Box:
        return box_of_corners(self.tiling, rays, occupancy)

    def _pixels(self, tile: Int[Array, ""], y: Array, x: Array) -> tuple[Lanes, Lanes]:
        """Columns and rows of the pixels (x, y) of each of a tile's beams."""
        beam, side = self.beams(tile)[:, None], self.tiling.beam
        return (beam % self.across) * side + x[None], (beam // self.across) * side + y[None]

    def assemble(self, leaf: Array) -> Array:
        trailing, (width, height) = leaf.shape[3:], self.size
        side, beam = self.tiling.side, self.tiling.beam
        beams = self.of_beams(leaf)[: self.across * self.down]
        image = beams.reshape(self.down, self.across, 2, 2, side, side, *trailing)
        image = jnp.moveaxis(image, (0, 2, 4), (0, 1, 2))
        return image.reshape(self.down * beam, self.across * beam, *trailing)[:height, :width]

    def disassemble(self, leaf: Array) -> Array:
        trailing, (width, height) = leaf.shape[2:], self.size
        side, beam = self.tiling.side, self.tiling.beam
        padding = (self.down * beam - height, self.across * beam - width)
        image = jnp.pad(leaf, [(0, n) for n in padding] + [(0, 0)] * len(trailing))
        image = image.reshape(self.down, 2, side, self.across, 2, side, *trailing)
        beams = jnp.moveaxis(image, (0, 1, 2), (0, 2, 4)).reshape(-1, self.tiling.rays_per_beam, *trailing)
        return self.of_tiles(beams)


class _GivenRayTiles(RayTiles):
    """`GivenRays`, or a subset of an image's rays, in order."""

    shape: tuple[int, ...] = eqx.field(static=True)

    def lines_of(
        self, source: GivenRays | RaySubset, tile: Int[Array, ""], fault: Bool[Array, ""]
    ) -> tuple[Line, Bool[Array, "groups rays"]]:
        count = math.prod(self.shape)
        numbers, wanted = self._numbers(tile, count)
        if isinstance(source, RaySubset):
            line = lines_at(source.rays, source.indices[numbers.reshape(-1)])
            line = jax.tree.map(lambda leaf: leaf.reshape(numbers.shape), line)
            x, y, z = line.origin
            return line._replace(origin=(jnp.where(fault, jnp.nan, x), y, z)), wanted
        if count == 0:  # the look-ups below need a row
            source = GivenRays(
                *(jnp.ones((1, 3), leaf.dtype) for leaf in (source.origins, source.directions))
            )
        x, y, z = (source.origins.reshape(-1, 3)[numbers, i] for i in range(3))
        dx, dy, dz = (source.directions.reshape(-1, 3)[numbers, i] for i in range(3))
        return Line((jnp.where(fault, jnp.nan, x), y, z), (dx, dy, dz), source.pixel(numbers)), wanted

    def _numbers(self, tile: Int[Array, ""], count: int) -> tuple[Lanes, Bool[Array, "groups rays"]]:
        """Numbers of a tile's rays, clipped to the last one, and whether each exists."""
        size = self.tiling.rays_per_beam
        number = (self.beams(tile)[:, None] * size + jnp.arange(size)[None]).reshape(-1, self.tiling.group)
        return jnp.minimum(number, max(count - 1, 0)), number < count

    def box(self, occupancy: Occupancy, rays: Ray) -> Box:
        return box_of_rays(self.tiling, rays, occupancy)

    def assemble(self, leaf: Array) -> Array:
        trailing, size = leaf.shape[3:], self.tiling.rays_per_beam
        beams = self.of_beams(leaf)
        rays = beams.reshape(beams.shape[0] * size, *trailing)
        return rays[: math.prod(self.shape)].reshape(*self.shape, *trailing)

    def disassemble(self, leaf: Array) -> Array:
        trailing, count, size = (
            leaf.shape[len(self.shape) :],
            math.prod(self.shape),
            self.tiling.rays_per_beam,
        )
        padded = jnp.pad(leaf.reshape(count, *trailing), [(0, -count % size)] + [(0, 0)] * len(trailing))
        return self.of_tiles(padded.reshape(-(-count // size), size, *trailing))


def lines_at(source: Source, indices: Int[Array, " rays"]) -> Line:
    """The rays at these indices of the flattened image, rounded as in the march."""
    if isinstance(source, RaySubset):
        return lines_at(source.rays, source.indices[indices])
    if isinstance(source, Ending):
        return lines_at(source.rays, indices)._replace(until=source.until.reshape(-1)[indices])
    if not isinstance(source, Camera):
        return jax.vmap(source.line)(indices)
    rows, columns = jnp.divmod(indices, source.size[0])
    fault = jnp.zeros((), bool)
    return jax.tree.map(lambda leaf: leaf[0], lines(source, columns[None], rows[None], fault))


def lines(camera: Camera, columns: Lanes, rows: Lanes, fault: Bool[Array, ""]) -> Line:
    """The rays of pixels. All are NaN if the camera is not finite and valid, or if there is a `fault`."""
    first_column, first_row = (first.astype(columns.dtype) for first in camera.first_pixel)
    # on a GPU, `in_memory` also computes the rays of an invalid camera
    camera = eqx.tree_at(lambda c: c.position, camera, jnp.where(fault, jnp.nan, camera.position))
    offset, direction = _rounded(camera, columns, rows)
    # the position need not be stored for each ray
    x, y, z = (jnp.broadcast_to(c, columns.shape) for c in camera.position)
    return Line((x, y, z), direction, (columns + first_column, rows + first_row), beside=offset)


def _through(camera: Camera, columns: Lanes, rows: Lanes) -> PyTree:
    """Origin offsets (in parallel projection) and directions of the rays of pixels."""
    return vmap_rays(camera.beside)(columns, rows)


@jax.custom_jvp
def _rounded(camera: Camera, columns: Lanes, rows: Lanes) -> PyTree:
    """Computes `_through` in a branch without derivatives, so that every program rounds it alike. A program
    that differentiates it would differ by 1e-4 of a voxel, and slopes jump at voxels' faces."""
    return in_memory(all_finite(camera), partial(_through, camera), columns, rows)


@_rounded.defjvp
def _(primals: tuple[Camera, Lanes, Lanes], tangents: tuple[Camera, PyTree, PyTree]) -> tuple[PyTree, PyTree]:
    camera, columns, rows = primals
    _, change = jax.jvp(lambda camera: _through(camera, columns, rows), (camera,), tangents[:1])
    return _rounded(*primals), change


def box_of_corners(tiling: Tiling, rays: Ray, occupancy: Occupancy) -> Box:
    """The boxes around beams of pixels."""
    side, last = tiling.side, tiling.group - 1
    lanes = 0, side - 1, last - side + 1, last  # of the beam's corners, in its four groups

    def corners(leaf: Array) -> Array:
        groups = leaf.reshape(-1, GROUPS_OF_BEAM, leaf.shape[1])
        return jnp.stack([groups[:, group, lane] for group, lane in enumerate(lanes)], axis=-1)

    def box(rays: Ray) -> Box:
        return Box.within(occupancy, jax.tree.map(corners, rays))

    chosen = unchecked(rays, path=None, pixel=None, gaps=(), spans=(), length=None)
    # in a branch, whose operands lie in memory: XLA would make the rays again for each corner
    return in_memory(occupancy.size[0] + 1 != 0, box, jax.lax.stop_gradient(chosen))


def box_of_rays(tiling: Tiling, rays: Ray, occupancy: Occupancy) -> Box:
    """The boxes around beams of arbitrary rays."""
    return Box.around(occupancy, jax.tree.map(lambda leaf: leaf.reshape(-1, tiling.rays_per_beam), rays))


def vmap_rays(f: Callable[..., Any]) -> Callable[..., Any]:
    """Maps a function of one ray over arrays (groups, rays in a group)."""

    def run(*trees: PyTree) -> PyTree:
        groups, group = jax.tree.leaves(trees)[0].shape[:2]
        # flattened to one axis: XLA unrolls a short last axis, to ten times the code and twice the time
        flat = jax.tree.map(lambda leaf: leaf.reshape(groups * group, *leaf.shape[2:]), trees)
        return jax.tree.map(lambda leaf: leaf.reshape(groups, group, *leaf.shape[1:]), jax.vmap(f)(*flat))

    return run


def vmap_cells(f: Callable[..., Any], of_cells: tuple[bool, ...] = (True,)) -> Callable[..., Any]:
    """Maps a function over rays, and over cells for arguments (cells, rays), whose `of_cells` is true."""
    return jax.vmap(jax.vmap(f), in_axes=tuple(0 if mapped else None for mapped in of_cells))


def enter_rays(space: Space, lines: Line, wanted: Bool[Array, "groups rays"], searched: int) -> Ray:
    """Rays, cut to the volume; those that are not wanted miss it. `searched`: number of groups at a time if
    the space searches for the ends of rays."""

    def one(line: Line) -> Ray:
        return enter(space, *line)

    mapped = partial(jax.lax.map, jax.vmap(one), batch_size=searched) if space.searches else vmap_rays(one)
    ray = mapped(lines)
    return eqx.tree_at(lambda ray: ray.length, ray, jnp.where(wanted, ray.length, 0))


def over_tiles(
    scene: Scene, space: Space, tiles: RayTiles, one: Callable[[Int[Array, ""], Ray], tuple[Rendering, Any]]
) -> tuple[Rendering, Any]:
    """Calls `one(tile, rays)` for all tiles in sequence. Returns the image, and stacked second results."""
    fault = scene.has_fault

    def render_tile(inputs: tuple[Int[Array, ""]]) -> tuple[Rendering, Any]:
        return one(inputs[0], tiles.rays(scene.source, space, inputs[0], fault))

    renderings, extra = tiles.map(render_tile)
    return nan_derivatives(jax.tree.map(tiles.assemble, renderings), fault), extra
