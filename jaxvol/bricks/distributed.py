"""Distributes bricks over devices: each gets consecutive ones of the order front to back, reads them, and
marches all rays as if nothing lay in front. "Over", which is associative, joins the partial images. All
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
from .traversal import Load, Traversal


class Share(eqx.Module):
    """All rays as a device marches them, and which of their cells are its own. Arrays of many shares have one
    more axis in front, which is sharded."""

    underway: RayStates
    own: CellRange

    def of_brick(self, grid: BrickGrid, scene: Scene, brick: Int[Array, ""]) -> CellRange:
        """The device's cells in a brick; none in the brick -1."""
        rays, alive = self.underway.rays, ~self.underway.at.finished & (brick >= 0)
        cells = straight_cells(grid, scene.march, rays, alive, jnp.maximum(brick, 0))
        first, until = jnp.maximum(cells.first, self.own.first), jnp.minimum(cells.until, self.own.until)
        some = first < until
        return CellRange(jnp.where(some, first, 0), jnp.where(some, until, 0))


def check_joins(scene: Scene, method: Any) -> None:
    """Raises where partial images of bricks cannot be combined."""
    march, mode = scene.march, scene.compositing
    refused = {
        f"method={method!r}": method != "overlap",
        f"compositing by {type(mode).__name__}, which does not join segments of a ray": not isinstance(
            mode, Over
        ),
        "EmptySpaceJitter, which shifts a ray by what lies in front": march.may_shift,
        "ToroidalMap, where a ray may come back to a brick": not is_straight(march.locate(scene.volume)),
    }
    for what, refuses in refused.items():
        if refuses:
            raise ValueError(f"devices, which own bricks, do not go with {what}. Leave them out.")


def render_distributed(traversal: Traversal, mesh: Mesh) -> Rendering:
    """The image of a traversal's scene, for which `check_joins` holds."""
    scene, options, grid = traversal.scene, traversal.options, traversal.grid
    share = _on_each(mesh, _begin, False, (scene, options), jnp.arange(mesh.size))
    every = jnp.broadcast_to(jnp.arange(grid.number, dtype=jnp.int32), (mesh.size, grid.number))
    wanted = traversal.visible & np.asarray(_on_each(mesh, _met, True, (grid, scene), share, every))[0]
    bounds = bounds_of(wanted[traversal.order], mesh.size)
    order = jnp.asarray(traversal.order, jnp.int32)
    share = _on_each(mesh, _divided, False, (grid, scene, order), share, jnp.asarray(bounds, jnp.int32))
    own = [[brick for brick in traversal.order[i:j] if wanted[brick]] for i, j in bounds]
    remaining = zip_longest(*own, fillvalue=-1)
    following = _next_loads(traversal, mesh, share, remaining)
    while following is not None:
        jax.block_until_ready(share)  # or two bricks, and what is made of both, would be in memory
        placed, number = _placed(traversal, mesh, *following), len(following[1])
        following = _next_loads(traversal, mesh, share, remaining)
        share = _on_each(mesh, _march, False, (grid, scene, options), share, *placed)
        traversal.finish(number, int(wanted.sum()))
    return _on_each(mesh, _join, True, (scene, options), share)


def bounds_of(wanted: Bool[np.ndarray, " bricks"], number: int) -> list[tuple[int, int]]:
    """Cuts ordered bricks into `number` ranges, with about as many wanted ones in each."""
    seen = np.cumsum(wanted)
    ends = [int(np.searchsorted(seen, seen[-1] * i / number)) + 1 for i in range(1, number)]
    return list(pairwise([0, *ends, len(wanted)]))


def _next_loads(
    traversal: Traversal, mesh: Mesh, share: Share, remaining: Iterator[tuple[int, ...]]
) -> tuple[np.ndarray, dict[int, Load]] | None:
    """Next brick of each device (-1: none is needed), and this process's loads by device."""
    for each in remaining:
        bricks = np.asarray(each, np.int32)
        given = traversal.grid, traversal.scene
        needed = np.asarray(_on_each(mesh, _met, True, given, share, jnp.asarray(bricks)[:, None]))[:, 0]
        loads = {
            d: traversal.load(each[d], None)
            for d, device in enumerate(mesh.devices)
            if device.process_index == jax.process_index() and needed[d]
        }
        if needed.any():
            return np.where(needed, bricks, -1), loads
    return None


def _placed(
    traversal: Traversal, mesh: Mesh, bricks: np.ndarray, loads: dict[int, Load]
) -> tuple[Array, Array, Array]:
    """The bricks, their first nodes and their voxels, each on its device."""
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
def _on_each(mesh: Mesh, one: Callable[..., Any], replicated: bool, given: Any, *shares: Any) -> Any:
    """`one(*given, *shares)` on each device's shares. `replicated`: the result is the same on all."""

    def local(*shares: Any) -> Any:
        found = one(*given, *jax.tree.map(lambda leaf: leaf[0], shares))
        return found if replicated else jax.tree.map(lambda leaf: leaf[None], found)

    out = REPLICATED if replicated else SHARDED
    return jax.shard_map(local, mesh=mesh, in_specs=SHARDED, out_specs=out, check_vma=False)(*shares)


def _begin(scene: Scene, options: RenderOptions, _: Array) -> Share:
    """All rays at their entries, and all of their cells."""
    underway = begin_image(scene, options)
    none = jnp.zeros(underway.rays.length.shape, jnp.int32)
    return Share(underway, CellRange(none, jnp.full_like(none, jnp.iinfo(jnp.int32).max)))


def _met(grid: BrickGrid, scene: Scene, share: Share, bricks: Int[Array, " n"]) -> Bool[Array, "devices n"]:
    """Whether any ray of a device needs each of its bricks: the answers of all devices."""

    def met(brick: Int[Array, ""]) -> Bool[Array, ""]:
        cells = share.of_brick(grid, scene, brick)
        return jnp.any(cells.until > cells.first)

    return jax.lax.all_gather(jax.lax.map(met, bricks), AXIS)


def _divided(
    grid: BrickGrid, scene: Scene, order: Int[Array, " bricks"], share: Share, bounds: Int[Array, "2"]
) -> Share:
    """Each device's own cells. `bounds`: its first brick in the order, and the one behind its last."""
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
    """Each device's rays behind its brick."""
    part = part_of(with_voxels(scene.volume, [voxels]), first, grid.shape)
    acceleration = VolumeAcceleration.of(part, scene.transfer, scene.march, scene.lighting)
    cells, here = share.of_brick(grid, scene, brick), scene._replace(volume=part)
    return Share(march_brick(here, options, acceleration, share.underway, cells), share.own)


def _join(scene: Scene, options: RenderOptions, share: Share) -> Rendering:
    """The whole image, on all devices."""
    at = jax.lax.all_gather(share.underway.at, AXIS)
    rays = jax.tree.map(lambda leaf: leaf[None], share.underway.rays)
    return finish_image(scene, options, join_segments(scene, RayStates(rays, at)))
