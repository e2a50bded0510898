"""Distributes bricks over devices. A device reads consecutive bricks of the front-to-back order and marches
all rays through them as if nothing lay in front. "Over", which is associative, joins the partial images. All
devices render one brick at a time, in one program."""

from collections.abc import Callable, Iterator
from itertools import pairwise, zip_longest
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, Bool, Int, Shaped

from .._util.axes import permuted
from ..compositing.blending import Over
from ..engine.acceleration import VolumeAcceleration
from ..engine.brick_march import RayStates, begin_image, finish_image, join_segments, march_brick
from ..engine.devices import AXIS, REPLICATED, SHARDED
from ..engine.tiling import RenderOptions
from ..engine.wavefront import CellRange
from ..ray import Scene
from ..scene.rendering import Rendering
from ..scene.volume import part_of, with_voxels
from ..xla.compiling import compiled
from .cells import first_behind, straight_cells
from .grid import BrickGrid, is_straight
from .traversal import Load, Method, Traversal


class Share(eqx.Module):
    """A device's states of all rays, and the cells that it marches. Arrays of several shares are stacked
    along a sharded first axis."""

    underway: RayStates
    owned: CellRange

    def of_brick(self, grid: BrickGrid, scene: Scene, brick: Int[Array, ""]) -> CellRange:
        """The device's cells in a brick; none in the brick -1."""
        rays, alive = self.underway.rays, ~self.underway.at.finished & (brick >= 0)
        cells = straight_cells(grid, scene.march, rays, alive, jnp.maximum(brick, 0))
        first, until = jnp.maximum(cells.first, self.owned.first), jnp.minimum(cells.until, self.owned.until)
        nonempty = first < until
        return CellRange(jnp.where(nonempty, first, 0), jnp.where(nonempty, until, 0))


def check_joins(scene: Scene, method: Method) -> None:
    """Raises `ValueError` for a scene whose partial images of bricks cannot be combined."""
    march, mode = scene.march, scene.compositing
    refused = {
        f"method={method!r}": method != "overlap",
        f"compositing by {type(mode).__name__}, which joins no segments": not isinstance(mode, Over),
        "EmptySpaceJitter, which shifts a ray by what lies in front": march.may_shift,
        "roulette, which depends on what lies in front": march.reweights,
        "ToroidalMap, where a ray may come back to a brick": not is_straight(march.locate(scene.volume)),
    }
    for feature, refuses in refused.items():
        if refuses:
            raise ValueError(f"devices, which own bricks, do not go with {feature}. Leave them out.")


def render_distributed(traversal: Traversal, mesh: Mesh) -> Rendering:
    """The image of a traversal's scene, which passed `check_joins`."""
    scene, options, grid = traversal.scene, traversal.options, traversal.grid
    share = _on_each(mesh, _begin, False, (scene, options), jnp.arange(mesh.size))
    bricks = jnp.broadcast_to(jnp.arange(grid.number, dtype=jnp.int32), (mesh.size, grid.number))
    wanted = traversal.visible & np.asarray(_on_each(mesh, _met, True, (grid, scene), share, bricks))[0]
    bounds = bounds_of(wanted[traversal.order], mesh.size)
    order = jnp.asarray(traversal.order, jnp.int32)
    share = _on_each(mesh, _divided, False, (grid, scene, order), share, jnp.asarray(bounds, jnp.int32))
    queues = [[brick for brick in traversal.order[i:j] if wanted[brick]] for i, j in bounds]
    remaining = zip_longest(*queues, fillvalue=-1)
    following = _next_loads(traversal, mesh, share, remaining)
    while following is not None:
        jax.block_until_ready(share)  # else two bricks and their derived arrays would be in memory
        placed, number = _placed(traversal, mesh, *following), len(following[1])
        following = _next_loads(traversal, mesh, share, remaining)
        share = _on_each(mesh, _march, False, (grid, scene, options), share, *placed)
        traversal.finish(number, int(wanted.sum()))
    return _on_each(mesh, _join, True, (scene, options), share)


def bounds_of(wanted: Bool[np.ndarray, " bricks"], number: int) -> list[tuple[int, int]]:
    """Cuts ordered bricks into `number` ranges with about equally many wanted bricks."""
    count = np.cumsum(wanted)
    ends = [int(np.searchsorted(count, count[-1] * i / number)) + 1 for i in range(1, number)]
    return list(pairwise([0, *ends, len(wanted)]))


def _next_loads(
    traversal: Traversal, mesh: Mesh, share: Share, remaining: Iterator[tuple[int, ...]]
) -> tuple[np.ndarray, dict[int, Load]] | None:
    """Next brick of each device (-1: none is needed), and this process's loads by device."""
    for row in remaining:
        bricks, constants = np.asarray(row, np.int32), (traversal.grid, traversal.scene)
        needed = np.asarray(_on_each(mesh, _met, True, constants, share, jnp.asarray(bricks)[:, None]))[:, 0]
        loads = {
            d: traversal.load(row[d], None)
            for d, device in enumerate(mesh.devices)
            if device.process_index == jax.process_index() and needed[d]
        }
        if needed.any():
            return np.where(needed, bricks, -1), loads
    return None


def _placed(
    traversal: Traversal, mesh: Mesh, bricks: np.ndarray, loads: dict[int, Load]
) -> tuple[Array, Array, Array]:
    """The bricks, their first nodes and their voxels, sharded over the devices."""
    shape = permuted(traversal.stored, traversal.source.order)
    nothing, first, voxels = np.zeros(shape, traversal.source.dtype), np.zeros((mesh.size, 3), np.int32), []
    for d, device in enumerate(mesh.devices):
        if device.process_index == jax.process_index():
            first[d] = loads[d].first if d in loads else 0
            part = loads[d].voxels.result() if d in loads else nothing
            voxels.append(jax.device_put(part[None], device))
    sharding = NamedSharding(mesh, SHARDED)
    return (
        jnp.asarray(bricks),
        jax.make_array_from_callback(first.shape, sharding, lambda index: first[index]),
        jax.make_array_from_single_device_arrays((mesh.size, *shape), sharding, voxels),
    )


@compiled
def _on_each(mesh: Mesh, function: Callable[..., Any], replicated: bool, constants: Any, *shares: Any) -> Any:
    """`function(*constants, *shares)` on each device. `replicated`: the result is the same on all devices."""

    def local(*shares: Any) -> Any:
        result = function(*constants, *jax.tree.map(lambda leaf: leaf[0], shares))
        return result if replicated else jax.tree.map(lambda leaf: leaf[None], result)

    out = REPLICATED if replicated else SHARDED
    return jax.shard_map(local, mesh=mesh, in_specs=SHARDED, out_specs=out, check_vma=False)(*shares)


def _begin(scene: Scene, options: RenderOptions, _: Array) -> Share:
    """Share of all cells, with all rays at their entries."""
    underway = begin_image(scene, options)
    none = jnp.zeros(underway.rays.length.shape, jnp.int32)
    return Share(underway, CellRange(none, jnp.full_like(none, jnp.iinfo(jnp.int32).max)))


def _met(grid: BrickGrid, scene: Scene, share: Share, bricks: Int[Array, " n"]) -> Bool[Array, "devices n"]:
    """Mask of the bricks that rays of a device need, gathered from all devices."""

    def met(brick: Int[Array, ""]) -> Bool[Array, ""]:
        cells = share.of_brick(grid, scene, brick)
        return jnp.any(cells.until > cells.first)

    return jax.lax.all_gather(jax.lax.map(met, bricks), AXIS)


def _divided(
    grid: BrickGrid, scene: Scene, order: Int[Array, " bricks"], share: Share, bounds: Int[Array, "2"]
) -> Share:
    """The share, restricted to the cells in the device's bricks, `order[bounds[0]:bounds[1]]`."""
    rays = share.underway.rays
    first, until = (first_behind(grid, scene.march, rays, order, end) for end in bounds)
    return Share(share.underway, CellRange(first, until))


def _march(
    grid: BrickGrid,
    scene: Scene,
    options: RenderOptions,
    share: Share,
    brick: Int[Array, ""],
    first: Int[Array, "3"],
    voxels: Shaped[Array, "x y z"],
) -> Share:
    """The share after the march through `brick`."""
    part = part_of(with_voxels(scene.volume, [voxels]), first, grid.shape)
    acceleration = VolumeAcceleration.of(part, scene.transfer, scene.march, scene.lighting)
    cells, scene = share.of_brick(grid, scene, brick), scene._replace(volume=part)
    return Share(march_brick(scene, options, acceleration, share.underway, cells), share.owned)


def _join(scene: Scene, options: RenderOptions, share: Share) -> Rendering:
    """The joined image, replicated on all devices."""
    at = jax.lax.all_gather(share.underway.at, AXIS)
    rays = jax.tree.map(lambda leaf: leaf[None], share.underway.rays)
    return finish_image(scene, options, join_segments(scene, RayStates(rays, at)))
