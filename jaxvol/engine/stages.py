"""Renders an image without traced arrays, by a few programs that share as much as possible between images.

    A  start: rays of a camera are generated, cut to the volume and offset, and their empty stretches found
    B  march: one program for all cameras, image sizes, shapes of volumes, numbers of control points, and
       subsets of the library's transforms: all are arrays
    C  finish: the results of the march become an image

Large images are several tiles of rays. Within a traced program, `image.march_image` composes the same
functions.
"""

import math
from functools import cache, partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from .._util.checks import all_finite
from ..compositing.blending import Compositing, Outputs
from ..lighting.shading import Lighting, lit_classification
from ..march.beams import EmptySpaceIndex, Skips, Stretches
from ..march.march import CellRules, March, Transform
from ..march.transforms.space_leaping import SpaceLeaping
from ..ray import NEVER, Progress, Scene, Track, begin, end, track_of
from ..scene.camera import Camera, GivenRays, without_ends
from ..scene.occupancy import BLOCK, Blocks, Occupancy, Sums
from ..scene.rendering import Rendering
from ..scene.space import Line, Ray, Space, median_node_distance
from ..scene.transfer import Transfer, TransferFunction, classification_of, with_shared_points
from ..scene.volume import Volume, grids, with_fetches, without_voxels
from ..scene.voxel_fetch import Extent, Nodes
from ..xla.compiling import OPTIONS
from ..xla.kept_programs import kept
from ..xla.memo import memoized_of, when_any_dies
from ..xla.platform import platform
from ..xla.trees import unchecked, with_fields
from .acceleration import VolumeAcceleration, empty_space_of, unshaped, visible_in_numpy
from .rays import RayTiles, Source, box_of_corners, box_of_rays, enter_rays, vmap_rays
from .shifts import find_shifts, skip_first_cells
from .tiling import GROUPS_OF_BEAM, RenderOptions, Tiling
from .wavefront import Marched, Recorded, finish_blind, march_rays


program = partial(kept, compiler_options=OPTIONS)


class StartedTile(NamedTuple):
    """The rays of a tile before their march. None: a part that the scene lacks."""

    rays: Ray
    track: Track
    skips: Skips | None
    space: Space


class Kernel(NamedTuple):
    """The inputs of the march of a scene's rays."""

    volume: Volume
    transfer: Transfer
    rules: CellRules
    compositing: Compositing[Any]
    lighting: Lighting | None
    space: Space | None = None

    @property
    def scene(self) -> Scene:
        """The scene for the functions of `ray`."""
        integrated = self.rules.integrates
        if self.lighting is None or self.space is None:
            classification = classification_of(self.transfer, self.volume, integrated=integrated)
        else:
            parts = self.volume, self.transfer, self.space, self.lighting
            classification = lit_classification(*parts, integrated=integrated)
        march, space, mode = cast(Any, self.rules), cast(Any, self.space), self.compositing
        return Scene(self.volume, self.transfer, None, march, mode, self.lighting, space, classification)


class MarchedTile(NamedTuple):
    """The marched rays of a tile: entries, lengths, result of the march, and shifts."""

    t_in: Array
    length: Array
    marched: Marched
    shifted: Array


def is_staged(scene: Scene, options: RenderOptions) -> bool:
    """True if `staged_image` renders the scene, provided that it is not traced."""
    if options.adjoint == "direct":
        return False
    # a custom index may depend on the view in any way
    return all(type(leap) is SpaceLeaping for leap in scene.march.overriding("empty_space"))


def staged_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, *, record: bool = False
) -> tuple[Rendering, Recorded]:
    """The image; and, with `record`, the `Recorded` part of the march that a second march needs."""
    tiling, source = options.tiling, without_ends(scene.source)
    kernel, seams, place, index, fault = _staging_of(scene, acceleration)
    if _depends_on_view(scene):
        view = scene._replace(source=source, lighting=None)
        index = _index_of_view(view, acceleration, Tiling.of_backend())
    if isinstance(source, Camera):
        fault = _is_invalid(source, fault)
    size, number = RayTiles.shared(source, tiling)
    corners = index is not None and (isinstance(source, Camera) or tiling.squares)
    tiling = tiling._replace(least=0, squares=False)
    limit = np.asarray(scene.march.most_samples, np.int32)
    passed, kept_tile = [], None
    for tile in range(number):
        lines = _lines_of(scene.source, tiling, number, size, tile)
        started = _start(*lines, corners, seams, place, index, fault, tiling)
        none, zero, never, nowhere = _defaults(*started.rays.length.shape, started.rays.length.dtype)
        offset, shift = started.track.offset, started.track.shift
        offset, shift = (none if part is None else part for part in (offset, shift))
        track = unchecked(Track, offset=offset, shift=shift, shifted=never, until=limit)
        first = zero
        if scene.march.may_shift:
            track, first = _shift(kernel, started.rays, track, limit, tiling)
        skips = nowhere if started.skips is None else started.skips
        inputs = _march_inputs(kernel, started._replace(skips=skips))
        # without leaps, cells without extinction have a gradient, too: no ranges
        marched = _march(*inputs, track, first, skips, options.outputs, tiling, record and scene.march.leaps)
        kept_tile = started.rays, started.skips
        passed.append(MarchedTile(started.rays.t_in, started.rays.length, marched, track.shifted))
    rendering, recorded = _finish(passed, scene.compositing, source, tiling, size, record)
    if record and number == 1 and kept_tile is not None:
        recorded = recorded.with_rays(*kept_tile)
    return rendering, recorded


class Staging(NamedTuple):
    """Parts shared by all images of a scene: the kernel, the march with the seams of stage A only, the place
    of the voxels, the empty space unless it depends on the view, and the scene's `has_fault`."""

    kernel: Kernel
    seams: March
    place: Volume
    empty_space: EmptySpaceIndex | None
    fault: Bool[Array, ""] | np.ndarray


_STAGINGS: dict[tuple[int, ...], Staging] = {}


def _staging_of(scene: Scene, acceleration: VolumeAcceleration) -> Staging:
    """The staging of a scene, kept while its parts live: it takes as long as some thousand rays."""
    parts = [scene.volume, scene.transfer, scene.march, scene.compositing]
    parts += [] if scene.lighting is None else [scene.lighting]
    key = tuple(map(id, parts))
    if key not in _STAGINGS:
        seams = _with_seams(scene.march, "start", "shift", "locate", "clip")
        place, index = _without_voxels(scene.volume, seams), None
        if not _depends_on_view(scene):
            index = _index_of(scene, acceleration)
        fault = _has_fault(scene._replace(volume=without_voxels(scene.volume), source=None))
        # copies: the parts themselves would never be freed
        kernel: Any = (
            unchecked(part) if isinstance(part, eqx.Module) else part
            for part in _kernel_of(scene, acceleration)
        )
        staging = Staging(Kernel(*kernel), seams, unchecked(place), index, fault)
        if any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(parts)):  # may change in place
            return staging
        _STAGINGS[key] = staging
        when_any_dies(parts, lambda: _STAGINGS.pop(key, None))
    return _STAGINGS[key]


def _with_seams(march: March, *seams: str) -> March:
    """The march with only the transforms that override these seams, and neutral static parts."""
    chosen = [id(transform) for seam in seams for transform in march.overriding(seam)]
    transforms = tuple(transform for transform in march.transforms if id(transform) in chosen)
    return unchecked(march, transforms=transforms, quadrature="left", max_samples=None)


def _has_fault(scene: Scene) -> Bool[Array, ""] | np.ndarray:
    """`Scene.has_fault`; on a CPU by NumPy, which compiles nothing, for types that support it."""
    kinds = (*map(type, scene.march.transforms), type(scene.transfer))
    custom = [kind for kind in kinds if getattr(kind, "valid", None) not in (Transform.valid, Transfer.valid)]
    if platform() != "cpu":
        return _has_fault_by_jax(scene)
    if any(kind is not TransferFunction for kind in custom):
        return np.asarray(_has_fault_by_jax(scene))
    return np.asarray(jax.tree.map(_to_numpy, scene).has_fault)


def _is_invalid(camera: Camera, fault: Bool[Array, ""] | np.ndarray) -> Bool[Array, ""] | np.ndarray:
    """True if the camera is invalid, or the scene has a `fault`."""
    if platform() != "cpu":
        return _is_invalid_by_jax(camera, fault)
    camera = jax.tree.map(_to_numpy, camera)
    return np.asarray(fault | ~(all_finite(camera) & camera.valid))


def _to_numpy(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


@program
def _has_fault_by_jax(scene: Scene) -> Bool[Array, ""]:
    return scene.has_fault


@program
def _is_invalid_by_jax(camera: Camera, fault: Bool[Array, ""]) -> Bool[Array, ""]:
    return fault | ~(all_finite(camera) & camera.valid)


# ---- stage A ----


def _without_voxels(volume: Volume, seams: March) -> Volume:
    """The volume without voxels. The shape of a single grid is an array, unless a transform overrides
    `locate`, which needs the volume."""
    if seams.overriding("locate"):
        return volume
    extents: list[Any] = [Extent(grid.shape) for grid in grids(volume)]
    if len(extents) == 1:
        extents = [Nodes(np.asarray(volume.shape, np.int32))]
    place = with_fetches(without_voxels(volume), extents)
    return unchecked(place, labels=None, label_ids=None)


class Place(NamedTuple):
    """Place of a volume, for programs that serve volumes of all shapes."""

    seams: March
    volume: Volume

    @classmethod
    def of(cls, march: March, volume: Volume) -> "Place":
        seams = _with_seams(march, "locate", "clip")
        return cls(seams, _without_voxels(volume, seams))

    @property
    def space(self) -> Space:
        return self.seams.locate(self.volume)

    def voxel(self, blocks: tuple[int, ...]) -> float:
        """The size of a voxel; if it varies, the median over the centres of some of the `blocks`."""
        if not self.seams.overriding("locate"):
            return float(np.min(np.asarray(self.volume.spacing)))
        centres = (BLOCK * (np.round(np.linspace(0, n - 1, MIDDLES)) + 0.5) for n in blocks)
        return float(_median_distance(self, *centres))


MIDDLES = 8
"""Places along each axis at which the size of a voxel is measured."""


@program
def _median_distance(place: Place, *centres: Array) -> Array:
    return median_node_distance(place.space, *centres)


def _lines_of(
    source: Source, tiling: Tiling, number: int, size: int, tile: int
) -> tuple[Line, Bool[Any, "groups rays"]]:
    """`RayTiles.ending_lines` of a tile, without a fault; for `GivenRays` on a CPU by NumPy."""
    if (
        not isinstance(source, GivenRays)
        or platform() != "cpu"
        or getattr(source.origins, "committed", False)
    ):
        return _lines(source, tiling, number, size, np.asarray(tile, jnp.result_type(int)))
    count = size * tiling.rays_per_beam
    span = slice(tile * count, (tile + 1) * count)

    def rows(leaf: Array | np.ndarray) -> Any:
        flat = np.asarray(leaf).reshape(-1, leaf.shape[-1])
        flat = flat[span] if len(flat) else np.ones((1, leaf.shape[-1]), flat.dtype)
        flat = np.pad(flat, ((0, count - len(flat)), (0, 0)), "edge")
        return tuple(np.ascontiguousarray(flat.T).reshape(leaf.shape[-1], -1, tiling.group))

    numbers = np.arange(span.start, span.stop, dtype=np.int32).reshape(-1, tiling.group)
    first = np.asarray(source.first, np.int32)
    pixel: Any = (first + numbers, 0 * numbers) if source.pixels is None else rows(source.pixels)
    line: Any = Line(rows(source.origins), rows(source.directions), pixel)
    return line, numbers < math.prod(source.origins.shape[:-1])


@program
def _lines(
    source: Source, tiling: Tiling, number: int, size: int, tile: Int[Array, ""]
) -> tuple[Line, Bool[Array, "groups rays"]]:
    """The rays of a tile, not yet cut to the volume, and whether each belongs to the image."""
    tiles = RayTiles.of(source, tiling, tiles=(number, size))
    return tiles.ending_lines(source, tile, jnp.zeros((), bool))


@program
def _start(
    line: Line,
    wanted: Bool[Array, "groups rays"],
    corners: bool,
    seams: March,
    place: Volume,
    index: EmptySpaceIndex | None,
    fault: Bool[Array, ""],
    tiling: Tiling,
) -> StartedTile:
    """Cuts the rays of a tile to the volume. `corners`: whether the rays at the corners of a beam bound it,
    as for squares of a camera's pixels."""
    x, y, z = line.origin
    line = line._replace(origin=(jnp.where(fault, jnp.nan, x), y, z))
    rays = enter_rays(seams.locate(place), line, wanted, tiling.searched)
    track = vmap_rays(partial(track_of, seams))(rays)
    offset = track.offset if seams.overriding("start") else None
    box = box_of_corners if corners else box_of_rays
    skips = None
    if index is not None:
        skips = index.on_axes_of(place).skips(partial(box, tiling, rays), tiling.cells * seams.step)
    track = unchecked(track, offset=offset, shifted=None, until=None)
    return StartedTile(rays, track, skips, seams.locate(place))


@cache
def _defaults(groups: int, group: int, dtype: Any) -> tuple[Array, Array, Array, Stretches]:
    """Defaults without offset, shift or empty space: offset 0, cell 0, cell NEVER, unknown stretches."""
    none, beams = np.zeros((groups, group), dtype), groups // GROUPS_OF_BEAM
    stretches = Stretches.unknown(beams, none.dtype)
    zero, never = (np.full(none.shape, number, np.int32) for number in (0, NEVER))
    return jax.device_put((none, zero, never, stretches))


def _depends_on_view(scene: Scene) -> bool:
    """True if the empty-space index depends on the view."""
    leaps: list[Any] = scene.march.overriding("empty_space")
    return bool(leaps) and leaps[0].method in ("min_distance", "beam")


def _index_of(scene: Scene, acceleration: VolumeAcceleration) -> EmptySpaceIndex | None:
    """The empty-space index of a scene for all views, computed once for each volume and transfer function."""
    if not scene.march.leaps:
        return None
    march = unchecked(_with_seams(scene.march, "empty_space", "locate", "clip"), step=None)
    inputs = scene._replace(source=None, march=march, lighting=None), acceleration.of_space
    if all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(inputs)):
        return memoized_of(inputs, _index)
    return _index(inputs)


def _index(inputs: tuple[Scene, VolumeAcceleration]) -> EmptySpaceIndex | None:
    scene, acceleration = inputs
    transforms: tuple[Any, ...] = scene.march.transforms
    transfer: Any = scene.transfer
    (leap, *seams), blocks = transforms, acceleration.blocks
    plain = scene.volume.field is None and scene.volume.first is None
    if seams or not plain or leap.method != "blocks" or not isinstance(blocks, Blocks):
        return _index_by_jax(inputs)
    visible = visible_in_numpy(scene.compositing, transfer, blocks)
    if visible is None or blocks.low.committed:
        return _index_by_jax(inputs)
    spacing, origin = np.asarray(scene.volume.spacing), np.asarray(scene.volume.origin)
    size, zero = tuple(blocks.side * step for step in spacing), np.zeros_like(spacing[0])
    place = {"origin": (zero, zero, zero), "size": size, "anchor": tuple(origin), "frame": None}
    sizes = np.asarray(visible.shape, np.int32)
    occupancy = unchecked(Occupancy, occupied=None, **place, known=None, sizes=sizes)
    return leap.index_of(occupancy, Sums.of(visible))


@program
def _index_by_jax(inputs: tuple[Scene, VolumeAcceleration]) -> EmptySpaceIndex | None:
    scene, acceleration = inputs
    nowhere = GivenRays(jnp.zeros((0, 3)), jnp.zeros((0, 3)))
    index = empty_space_of(scene._replace(source=nowhere), acceleration, Tiling())
    return None if index is None else index.unshaped


@program
def _index_of_view(scene: Scene, acceleration: VolumeAcceleration, tiling: Tiling) -> EmptySpaceIndex | None:
    return empty_space_of(acceleration.packed(scene), acceleration, tiling)


# ---- stage B ----


def _kernel_of(scene: Scene, acceleration: VolumeAcceleration) -> Kernel:
    """The inputs of the march, such that as many scenes as possible share its program."""
    volume, lighting = acceleration.packed(scene).volume, scene.lighting
    shared = lighting is None or (lighting.reads_gradient and lighting.farthest_read == 0)
    if shared and len(grids(volume)) == 1:
        volume = unshaped(volume)
    transfer = with_shared_points(scene.transfer)
    return Kernel(volume, transfer, scene.march.rules, scene.compositing, lighting)


def _march_inputs(kernel: Kernel, started: StartedTile) -> tuple[Kernel, Ray]:
    """The kernel and rays for the march; world coordinates of rays only if they are used."""
    rays, space = started.rays, started.space
    if kernel.lighting is not None:
        return kernel._replace(space=space.whole), rays
    if kernel.rules.custom or not isinstance(started.skips, Stretches):
        return kernel, rays
    return kernel, unchecked(rays, entry=None, direction=None, pixel=None)


@program
def _shift(
    kernel: Kernel, rays: Ray, track: Track, limit: Int[Array, ""], tiling: Tiling
) -> tuple[Track, Int[Array, "groups rays"]]:
    """The track of a tile's rays with their shifts, and the first cell to march."""
    scene, track = kernel.scene, _per_ray(track, rays)
    at = vmap_rays(lambda ray, track: begin(scene, ray, track, None))(rays, track)
    at = find_shifts(scene, rays, with_fields(at, finished=rays.length <= 0), tiling)
    return with_fields(at.track, until=limit), skip_first_cells(scene, rays, at).index


def _per_ray(track: Track, rays: Ray) -> Track:
    """The tracks of rays, from a track with one `until` for all."""
    return with_fields(track, until=jnp.broadcast_to(track.until, rays.length.shape))


@program
def _march(
    kernel: Kernel,
    rays: Ray,
    track: Track,
    first: Int[Array, "groups rays"],
    skips: Skips,
    outputs: Outputs,
    tiling: Tiling,
    record: bool,
) -> Marched:
    """Marches the rays of a tile to their ends."""
    scene, track = kernel.scene, _per_ray(track, rays)
    at = vmap_rays(lambda ray, track: begin(scene, ray, track, outputs))(rays, track)
    at = finish_blind(skips, with_fields(at, index=first, finished=rays.length <= 0))
    if at.stats is not None:  # skipped transparent cells are samples
        at = eqx.tree_at(lambda at: at.stats.samples, at, first)
    return march_rays(scene, rays, at, tiling, skips, record=record)


# ---- stage C ----


@program
def _finish(
    passed: list[MarchedTile],
    compositing: Compositing[Any],
    source: Camera | GivenRays,
    tiling: Tiling,
    size: int,
    record: bool,
) -> tuple[Rendering, Recorded]:
    """The image of all tiles."""
    tiles = RayTiles.of(source, tiling, tiles=(len(passed), size))
    none: Any = None
    scene = Scene(none, none, source, none, compositing)

    def finish(t_in: Array, length: Array, at: Progress) -> Rendering:
        return end(scene, unchecked(Ray, t_in=t_in, length=length), at)

    renderings = [vmap_rays(finish)(tile.t_in, tile.length, tile.marched.at) for tile in passed]
    rendering = jax.tree.map(lambda *leaves: tiles.assemble(jnp.stack(leaves)), *renderings)
    if not record:
        return rendering, Recorded(None, None)
    recorded = [Recorded(tile.marched.range, tile.shifted) for tile in passed]
    return rendering, jax.tree.map(lambda *leaves: jnp.stack(leaves), *recorded)
