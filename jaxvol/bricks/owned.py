"""Bricks owned by devices: each device reads and renders its own, of all rays, and the partial images are
combined front to back.

Devices get consecutive bricks of the order front to back. Where rays are straight, each ray meets them in
this order, and so passes from what the first device owns to what the second one does, and never back. From
where it does, found from its geometry alone, each device marches its cells as if nothing lay in front; and
the operator "over" is associative. All devices take a brick each in turn, in one program.
"""

from collections.abc import Iterator
from concurrent.futures import Future
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, Bool, Int, Shaped

from .._util.axes import permuted
from ..engine.acceleration import VolumeAcceleration
from ..engine.brick_march import RayStates, begin_rays, finish_image, join_segments, march_brick
from ..engine.devices import AXIS, REPLICATED, SHARDED
from ..engine.tiling import RenderOptions
from ..engine.wavefront import CellRange
from ..ray import Scene
from ..scene.rendering import Rendering
from ..scene.volume import part_of, with_voxels
from ..xla.compiling import compiled
from ..xla.trees import PyTree
from .cells import behind_straight, of_straight
from .grid import BrickGrid, Node
from .stream import Stream


class Share(eqx.Module):
    """What a device marches of an image: all rays, and which of their cells lie in its bricks. Arrays of many
    shares have one more axis in front, which is sharded."""

    underway: RayStates
    own: CellRange

    def of_brick(self, grid: BrickGrid, scene: Scene, brick: Int[Array, ""]) -> CellRange:
        """The cells that lie in one of the bricks; none in the brick -1."""
        rays, alive = self.underway.rays, ~self.underway.at.finished & (brick >= 0)
        cells = of_straight(grid, scene.march, rays, alive, jnp.maximum(brick, 0))
        first, until = jnp.maximum(cells.first, self.own.first), jnp.minimum(cells.until, self.own.until)
        some = first < until
        return CellRange(jnp.where(some, first, 0), jnp.where(some, until, 0))


class Turn(NamedTuple):
    """The next brick of each device, -1 for none, and the voxels that this process reads of them: by device,
    the first node and what is read."""

    bricks: np.ndarray
    reading: dict[int, tuple[Node, "Future[np.ndarray]"]]


def render_owned(stream: Stream, mesh: Mesh) -> Rendering:
    """The image of a stream's scene. Rays are straight, and nothing that shows on a ray depends on what lies
    in front but by its transmittance."""
    scene, options, grid = stream.scene, stream.options, stream.grid
    order = jnp.asarray(stream.order, jnp.int32)
    underway = _set_out(mesh, scene, options)
    # a brick outside of the view is nobody's work
    wanted = stream.visible & np.asarray(_in_view(mesh, grid, scene, underway))
    bounds = bounds_of(wanted[stream.order], mesh.size)
    share = _divided(mesh, grid, scene, underway, order, jnp.asarray(bounds, jnp.int32))
    lists = [[b for b in stream.order[i:j] if wanted[b]] for i, j in bounds]
    newest = [share]
    turns = _turns(stream, mesh, lists, newest)
    turn = next(turns, None)
    while turn is not None:
        jax.block_until_ready(share)  # or two bricks, and what is made of both, would be in memory
        placed, number = _placed(stream, mesh, turn), len(turn.reading)
        turn = next(turns, None)
        newest[0] = share = _march(mesh, grid, scene, options, share, *placed)
        stream.finish(number, int(wanted.sum()))
    return _join(mesh, scene, options, share)


def bounds_of(wanted: Bool[np.ndarray, " bricks"], number: int) -> list[tuple[int, int]]:
    """Cuts bricks in their order into so many parts, with about as many wanted ones in each."""
    seen = np.cumsum(wanted)
    ends = [int(np.searchsorted(seen, seen[-1] * i / number)) + 1 for i in range(1, number)]
    return list(pairwise([0, *ends, len(wanted)]))


def _turns(stream: Stream, mesh: Mesh, lists: list[list[int]], newest: list[Share]) -> Iterator[Turn]:
    """A brick for each device that any of its rays still needs, each from when it is planned to be read."""
    here = jax.process_index()
    for i in range(max(map(len, lists))):
        bricks = np.asarray([own[i] if i < len(own) else -1 for own in lists], np.int32)
        needed = np.asarray(_needed(mesh, stream.grid, stream.scene, newest[0], jnp.asarray(bricks)))
        bricks = np.where(needed, bricks, -1)
        mine = [d for d, device in enumerate(mesh.devices) if device.process_index == here and needed[d]]
        if needed.any():
            yield Turn(bricks, {d: stream.read(int(bricks[d]), *stream.around(int(bricks[d]))) for d in mine})


def _placed(stream: Stream, mesh: Mesh, turn: Turn) -> tuple[Array, Array, Array]:
    """The bricks, their first nodes and their voxels, each on its device."""
    shape = permuted(stream.stored, stream.source.order)
    nothing, first = np.zeros(shape, stream.source.dtype), np.zeros((mesh.size, 3), np.int32)
    voxels = []
    for d, device in enumerate(mesh.devices):
        if device.process_index != jax.process_index():
            continue
        part = nothing
        if d in turn.reading:
            first[d], coming = turn.reading[d]
            part = coming.result()
        voxels.append(jax.device_put(part[None], device))
    sharding = NamedSharding(mesh, SHARDED)
    return (
        jnp.asarray(turn.bricks),
        jax.make_array_from_callback(first.shape, sharding, lambda index: first[index]),
        jax.make_array_from_single_device_arrays((mesh.size, *shape), sharding, voxels),
    )


def _on_each(mesh: Mesh, one: Any, *shares: PyTree, whole: bool = False) -> PyTree:
    """`one` of each device's own part of arrays. `whole`: it returns the same on all devices."""

    def own(*parts: PyTree) -> PyTree:
        found = one(*jax.tree.map(lambda leaf: leaf[0], parts))
        return found if whole else jax.tree.map(lambda leaf: leaf[None], found)

    out = REPLICATED if whole else SHARDED
    return jax.shard_map(own, mesh=mesh, in_specs=SHARDED, out_specs=out, check_vma=False)(*shares)


@compiled
def _set_out(mesh: Mesh, scene: Scene, options: RenderOptions) -> RayStates:
    return _on_each(mesh, lambda _: begin_rays(scene, options), jnp.arange(mesh.size))


@compiled
def _in_view(mesh: Mesh, grid: BrickGrid, scene: Scene, underway: RayStates) -> Bool[Array, " bricks"]:
    """For each brick, whether any ray meets it."""

    def met(underway: RayStates) -> Bool[Array, " bricks"]:
        def one(brick: Int[Array, ""]) -> Bool[Array, ""]:
            cells = of_straight(grid, scene.march, underway.rays, underway.rays.length > 0, brick)
            return jnp.any(cells.until > cells.first)

        return jax.lax.map(one, jnp.arange(grid.number, dtype=jnp.int32))

    return _on_each(mesh, met, underway, whole=True)


@compiled
def _divided(
    mesh: Mesh,
    grid: BrickGrid,
    scene: Scene,
    underway: RayStates,
    order: Int[Array, " bricks"],
    bounds: Int[Array, "devices 2"],
) -> Share:
    """Each device's own cells. `bounds`: its first brick in the order, and the one behind its last."""

    def one(underway: RayStates, bounds: Int[Array, "2"]) -> Share:
        first, until = (behind_straight(grid, scene.march, underway.rays, order, end) for end in bounds)
        return Share(underway, CellRange(first, until))

    return _on_each(mesh, one, underway, bounds)


@compiled
def _needed(
    mesh: Mesh, grid: BrickGrid, scene: Scene, share: Share, bricks: Int[Array, " devices"]
) -> Bool[Array, " devices"]:
    """Whether any ray of a device needs its brick: the answers of all devices."""

    def one(share: Share, brick: Int[Array, ""]) -> Bool[Array, " devices"]:
        cells = share.of_brick(grid, scene, brick)
        return jax.lax.all_gather(jnp.any(cells.until > cells.first), AXIS)

    return _on_each(mesh, one, share, bricks, whole=True)


@compiled
def _march(
    mesh: Mesh,
    grid: BrickGrid,
    scene: Scene,
    options: RenderOptions,
    share: Share,
    bricks: Int[Array, " devices"],
    first: Int[Array, "devices 3"],
    voxels: Shaped[Array, "devices x y z"],
) -> Share:
    """Each device's rays behind its brick."""

    def one(share: Share, brick: Array, first: Array, voxels: Array) -> Share:
        part = part_of(with_voxels(scene.volume, voxels), first, grid.shape)
        acceleration = VolumeAcceleration.of(part, scene.transfer, scene.march, scene.lighting)
        cells, here = share.of_brick(grid, scene, brick), scene._replace(volume=part)
        after = march_brick(here, options, acceleration, share.underway, cells, exact=True)
        return Share(after, share.own)

    return _on_each(mesh, one, share, bricks, first, voxels)


@compiled
def _join(mesh: Mesh, scene: Scene, options: RenderOptions, share: Share) -> Rendering:
    """The whole image, on all devices."""

    def one(share: Share) -> Rendering:
        at = jax.lax.all_gather(share.underway.at, AXIS)
        rays = jax.tree.map(lambda leaf: leaf[None], share.underway.rays)
        return finish_image(scene, options, join_segments(scene, RayStates(rays, at)))

    return _on_each(mesh, one, share, whole=True)
