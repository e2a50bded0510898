"""Renders an image by a few programs with plain arrays between them, where nothing is traced.

    A  start: rays are made from a camera, cut to the volume; where they begin, and where they see nothing
    B  march: one program for all cameras, image sizes, shapes of volumes, numbers of control points, and
       subsets of the library's transforms, which are arrays to it
    C  finish: what the march left becomes an image

Larger images are several tiles of rays. Inside of a larger program, `image.march_image` does the same, by the
same functions, as a part of that.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ..compositing.blending import Compositing, Outputs
from ..lighting.shading import Lighting, lit_classification
from ..march.beams import EmptySpaceIndex, Skips, Stretches
from ..march.march import CellRules, March
from ..march.transforms.space_leaping import SpaceLeaping
from ..ray import NEVER, Progress, Scene, Track, begin, end, track_of
from ..scene.camera import Camera, Ending, GivenRays, without_ends
from ..scene.rendering import Rendering
from ..scene.space import Ray, Space
from ..scene.transfer import Transfer, with_shared_points
from ..scene.volume import Volume, grids, with_fetches, without_voxels
from ..scene.voxel_fetch import Extent, Nodes, Packed
from ..xla.compiling import OPTIONS
from ..xla.memo import memoized_of
from ..xla.trees import unchecked, with_fields
from .acceleration import VolumeAcceleration, empty_space_of
from .rays import RayTiles, vmap_rays
from .shifts import find_shifts
from .tiling import RenderOptions, Tiling
from .wavefront import Marched, Recorded, blinded, march_rays


program: Any = partial(eqx.filter_jit, compiler_options=OPTIONS)


class Started(NamedTuple):
    """The rays of a tile before they are marched."""

    rays: Ray
    track: Track
    skips: Skips
    space: Space


class Kernel(NamedTuple):
    """What the march of rays is told of a scene."""

    volume: Volume
    transfer: Transfer
    rules: CellRules
    compositing: Compositing[Any]
    lighting: Lighting | None
    space: Space | None = None

    @property
    def scene(self) -> Scene:
        """The scene for the functions of `ray`."""
        volume, transfer, rules, *rest = self
        march: Any = rules
        _, lighting, space = rest
        light: Any = (volume, transfer, space, lighting)
        classification = lit_classification(*light, integrated=rules.integrates)
        return Scene(*self[:2], None, march, *rest, classification)


class Passed(NamedTuple):
    """What is kept of the rays of a tile: where they enter, where they ended, and where they shifted."""

    t_in: Array
    length: Array
    marched: Marched
    shifted: Array


def is_staged(scene: Scene, options: RenderOptions) -> bool:
    """Whether the image of a scene that is not traced is rendered here."""
    if options.tiling.devices is not None or options.adjoint == "direct":
        return False
    # not where rays are to start where neighbouring ones do, which are found by a march of their own
    leaps = scene.march.overriding("empty_space")
    return all(type(leap) is SpaceLeaping and leap.method in ("hierarchy", "distance") for leap in leaps)


def staged_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, *, record: bool = False
) -> tuple[Rendering, Recorded]:
    """The image; and, if `record` asks for it, what the second march needs of the first."""
    tiling, source = options.tiling, without_ends(scene.source)
    kernel = _kernel_of(scene, acceleration)
    index = _index_of(scene, acceleration)
    fault = _has_fault(scene._replace(volume=without_voxels(scene.volume), source=source))
    seams = _only(scene.march, "start", "shift", "locate", "clip")
    place = _without_voxels(scene.volume, seams)
    size, number = RayTiles.shared(source, tiling)
    most = np.asarray(scene.march.most_samples, np.int32)
    ends = [None] * number
    if isinstance(scene.source, Ending):
        ends = _ends(scene.source, tiling, size, number)
    given, pixels = source, None
    if isinstance(source, Camera):
        given, pixels = source.unsized, np.asarray(source.size, np.int32)
    passed = []
    for tile, until in enumerate(ends):
        number_ = np.asarray(tile, np.int32)
        started = _start(given, pixels, seams, place, index, fault, most, number_, until, tiling, size)
        track = started.track
        if scene.march.may_shift:
            track = _shift(kernel, started.rays, track, tiling)
        found = _march(*_told(kernel, started), track, started.skips, options.outputs, tiling, record)
        passed.append(Passed(started.rays.t_in, started.rays.length, found, track.shifted))
    return _finish(passed, scene.compositing, source, tiling, size, record)


def _only(march: March, *seams: str) -> March:
    """The march with the transforms that override one of these seams alone, and no other static part."""
    chosen = [each for seam in seams for each in march.overriding(seam)]
    kept = tuple(each for each in march.transforms if any(each is one for one in chosen))
    return unchecked(march, transforms=kept, quadrature="left", max_samples=None)


@program
def _has_fault(scene: Scene) -> Bool[Array, ""]:
    return scene.has_fault


# ---- stage A ----


def _without_voxels(volume: Volume, seams: March) -> Volume:
    """The place of the voxels. Of a single grid in the world's own space, their number is an array."""
    own = grids(volume)
    extents = [Extent(grid.shape) for grid in own]
    if len(own) == 1 and not seams.overriding("locate"):
        extents = [Nodes(np.asarray(volume.shape, np.int32))]
    place = with_fetches(without_voxels(volume), extents)
    return unchecked(place, labels=None, label_ids=None)


@program
def _ends(source: Ending, tiling: Tiling, size: int, number: int) -> list[Array]:
    """Where the rays of each tile end."""
    return list(RayTiles.of(source, tiling, tiles=(number, size)).disassemble(source.until))


@program
def _start(
    source: Any,
    pixels: Int[Array, "2"] | None,
    seams: March,
    place: Volume,
    index: EmptySpaceIndex | None,
    fault: Bool[Array, ""],
    most: Int[Array, ""],
    tile: Int[Array, ""],
    until: Array | None,
    tiling: Tiling,
    size: int,
) -> Started:
    """Makes the rays of a tile. `pixels`: width and height of a camera's image. `until`: where rays end."""
    tiles, space = RayTiles.of(source, tiling, tiles=(1, size), pixels=pixels), seams.locate(place)
    rays = tiles.rays(source, space, tile, fault, until)
    track = vmap_rays(partial(track_of, seams))(rays)
    shift = jnp.zeros_like(track.offset) if track.shift is None else track.shift
    shape = rays.length.shape
    track = Track(track.offset, shift, jnp.full(shape, NEVER, jnp.int32), jnp.broadcast_to(most, shape))
    skips = tiles.skips(index, source, rays, tile, seams.step)
    return Started(rays, track, Stretches.nowhere(size, rays.length) if skips is None else skips, space)


def _index_of(scene: Scene, acceleration: VolumeAcceleration) -> EmptySpaceIndex | None:
    """Where the scene is empty: found once for each volume and transfer function."""
    if not scene.march.leaps:
        return None
    march = unchecked(_only(scene.march, "empty_space", "locate", "clip"), step=None)
    given = scene._replace(source=None, march=march, lighting=None), acceleration.of_space
    leaves = jax.tree.leaves(given)
    if all(isinstance(leaf, jax.Array) for leaf in leaves):
        return memoized_of(given, _index)
    return _index(given)


@program
def _index(given: tuple[Scene, VolumeAcceleration]) -> EmptySpaceIndex | None:
    scene, acceleration = given
    nowhere = GivenRays(jnp.zeros((0, 3)), jnp.zeros((0, 3)))
    index = empty_space_of(scene._replace(source=nowhere), acceleration, Tiling())
    return None if index is None else index.unshaped


# ---- stage B ----


def _kernel_of(scene: Scene, acceleration: VolumeAcceleration) -> Kernel:
    """The scene, so that its march is the same program as that of as many other scenes as possible."""
    volume, lighting = acceleration.packed(scene).volume, scene.lighting
    shared = lighting is None or (lighting.reads_gradient and lighting.farthest_read == 0)
    if shared and len(grids(volume)) == 1 and isinstance(volume.fetch, Packed):
        volume = unchecked(volume, fetch=volume.fetch.unshaped(volume.data), data=None)
    transfer = with_shared_points(scene.transfer)
    return Kernel(volume, transfer, scene.march.rules, scene.compositing, lighting)


def _told(kernel: Kernel, started: Started) -> tuple[Kernel, Ray]:
    """What the march is told of a scene and of its rays: what they meet in the world only if it is used."""
    rays, space = started.rays, started.space
    if kernel.lighting is not None:
        return kernel._replace(space=space.whole), rays
    if kernel.rules.custom or not isinstance(started.skips, Stretches):
        return kernel, rays
    return kernel, unchecked(rays, entry=None, direction=None, pixel=None)


@program
def _shift(kernel: Kernel, rays: Ray, track: Track, tiling: Tiling) -> Track:
    """Where the rays of a tile shift."""
    scene = kernel.scene
    at = vmap_rays(lambda ray, track: begin(scene, ray, track, None))(rays, track)
    return find_shifts(scene, rays, with_fields(at, finished=rays.length <= 0), tiling).track


@program
def _march(
    kernel: Kernel, rays: Ray, track: Track, skips: Skips, outputs: Outputs, tiling: Tiling, record: bool
) -> Marched:
    """Marches the rays of a tile to their ends."""
    scene = kernel.scene
    at = vmap_rays(lambda ray, track: begin(scene, ray, track, outputs))(rays, track)
    at = blinded(skips, with_fields(at, finished=rays.length <= 0))
    return march_rays(scene, rays, at, tiling, skips, record=record)


# ---- stage C ----


@program
def _finish(
    passed: list[Passed],
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
        return end(scene, Ray(none, none, t_in, length, none, none), at)

    each = [vmap_rays(finish)(tile.t_in, tile.length, tile.marched.at) for tile in passed]
    rendering = jax.tree.map(lambda *leaves: tiles.assemble(jnp.stack(leaves)), *each)
    if not record:
        return rendering, Recorded(None, None)
    usual = RayTiles.of(source, tiling)
    recorded = [Recorded(tile.marched.range, tile.shifted) for tile in passed]
    return rendering, jax.tree.map(lambda *leaves: _as_usual(usual, jnp.stack(leaves)), *recorded)


def _as_usual(usual: RayTiles, leaf: Array) -> Array:
    """An array of all tiles, as that of the tiles of a single program."""
    groups = usual.groups
    flat = leaf.reshape(-1, *leaf.shape[2:])[: usual.number * groups]
    missing = usual.number * groups - flat.shape[0]
    flat = jnp.pad(flat, [(0, missing)] + [(0, 0)] * (flat.ndim - 1))
    return flat.reshape(usual.number, groups, *flat.shape[1:])
