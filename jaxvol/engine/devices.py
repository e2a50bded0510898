"""Shards the rays of an image over devices; the scene is replicated.

Beams of rays are assigned round-robin, which balances expensive regions of the image over the devices. Each
device runs the program of a single device, and JAX sums the gradients.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from .._util.checks import described
from ..ray import Scene
from ..scene.camera import Camera, RaySubset, without_ends
from ..scene.rendering import Rendering
from ..xla.compiling import compiled
from ..xla.memo import memoized
from ..xla.platform import is_traced
from ..xla.sharding import varies_over
from ..xla.trees import PyTree
from .acceleration import VolumeAcceleration
from .rays import Source
from .tiling import RenderOptions, Tiling


Devices: TypeAlias = Sequence[Any] | Mesh
"""The argument `devices` of the renderers."""

AXIS = "devices"
"""Name of the mesh axis."""

REPLICATED, SHARDED = PartitionSpec(), PartitionSpec(AXIS)
"""Arrays that are copied to every device, and arrays that are divided along their first axis."""

LARGE = 2**16
"""Minimum size in bytes of arrays that are kept on all devices for the next image."""


def mesh_of(devices: Devices | None) -> Mesh | None:
    """The devices as a mesh of one axis; None for None: JAX decides where the image is computed.

    Raises:
        ValueError: if `devices` is neither a sequence of JAX devices nor a mesh of one axis, is empty, has
            duplicates, or is of several platforms.
    """
    if devices is None:
        return None
    expected = "a sequence of JAX devices, such as jax.devices(), or a jax.sharding.Mesh of one axis"
    if isinstance(devices, Mesh):
        if devices.devices.ndim != 1:
            raise ValueError(f"devices must be {expected}; got a mesh of the axes {dict(devices.shape)}.")
        devices = devices.devices.tolist()
    listed: list[Any] = (
        list(devices) if isinstance(devices, Iterable) and not isinstance(devices, str) else [devices]
    )
    wrong = [device for device in listed if not isinstance(device, jax.Device)]
    if wrong or not isinstance(devices, Iterable):
        raise ValueError(f"devices must be {expected}; got {described(wrong[0] if wrong else devices)}.")
    if not listed or len(set(listed)) < len(listed) or len({device.platform for device in listed}) > 1:
        raise ValueError(f"devices must be one or more different devices of one platform; got {listed}.")
    return Mesh(np.asarray(listed), (AXIS,))


def _sharded_image(
    mesh: Mesh,
    render: Callable[[Scene, RenderOptions, VolumeAcceleration], Rendering],
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
) -> Rendering:
    """Renders an image by `render` on all devices of a mesh, each with its shard of the rays. The image is
    replicated."""
    shape, *tables = shard_rays(scene.source, options.tiling, mesh.size)
    indices, place = map(jnp.asarray, tables)
    arrays, static = eqx.partition((scene, acceleration), eqx.is_array)

    def render_shard(arrays: PyTree, indices: Int[Array, " rays"]) -> Rendering:
        scene, acceleration = eqx.combine(arrays, static)
        return render(scene._replace(source=RaySubset(scene.source, indices)), options, acceleration)

    # With `check_vma`, each loop, also of a user's transform, would have to start with varying arrays.
    specs: Any = {"mesh": mesh, "in_specs": (REPLICATED, SHARDED), "out_specs": SHARDED, "check_vma": False}
    shards = jax.shard_map(render_shard, **specs)(arrays, indices)
    image = jax.tree.map(lambda leaf: leaf[place].reshape(*shape, *leaf.shape[1:]), shards)
    return jax.lax.with_sharding_constraint(image, NamedSharding(mesh, REPLICATED))


over_devices = compiled(_sharded_image, has_jvp=True)


def shard_rays(
    source: Source, tiling: Tiling, devices: int
) -> tuple[tuple[int, ...], Int[np.ndarray, " sharded"], Int[np.ndarray, " rays"]]:
    """The shape of an image; its rays' indices, by device and then by beam; and the position of each ray in
    that order. Beams that are not full repeat rays."""
    rays = without_ends(source)
    if isinstance(rays, Camera):
        (width, height), side = rays.size, tiling.beam
        across, down = -(-width // side), -(-height // side)
        y, x = np.indices((down * side, across * side)).reshape(2, down, side, across, side)
        inside = (y < height) & (x < width)
        index = np.minimum(y, height - 1) * width + np.minimum(x, width - 1)
        # rotates the rows if `across` is a multiple of `devices`: else devices would get whole columns
        row = np.arange(down)[:, None]
        column = (np.arange(across) + row * (across % devices == 0)) % across
        index, inside = (np.swapaxes(table, 1, 2)[row, column] for table in (index, inside))
        index, inside = index.reshape(-1, side**2), inside.reshape(-1, side**2)
        shape = height, width
    else:
        shape = rays.origins.shape[:-1]
        count, size = int(np.prod(shape)), tiling.rays_per_beam
        index = np.arange(-(-count // size) * size).reshape(-1, size)
        index, inside = np.minimum(index, count - 1), index < count
    missing = -len(index) % devices
    index, inside = (np.pad(table, ((0, missing), (0, 0))) for table in (index, inside))
    beams = np.arange(len(index)).reshape(-1, devices).T.reshape(-1)
    index, inside = index[beams].reshape(-1), inside[beams].reshape(-1)
    place = np.zeros(int(np.prod(shape)), int)
    place[index[inside]] = np.flatnonzero(inside)
    return shape, index.astype(np.int32), place


def on_all(mesh: Mesh | None, tree: PyTree) -> PyTree:
    """Copies a tree's large (`LARGE`) and committed arrays to all devices, once in their lifetime. JAX copies
    the others for each image."""
    if mesh is None:
        return tree
    targets = set(mesh.devices.tolist())

    def replicate(leaf: PyTree) -> PyTree:
        if not isinstance(leaf, jax.Array) or is_traced(leaf) or leaf.sharding.device_set == targets:
            return leaf
        return memoized(leaf, _copier(mesh)) if leaf.nbytes >= LARGE or leaf.committed else leaf

    return jax.tree.map(replicate, tree)


@cache
def _copier(mesh: Mesh) -> Callable[[Array], Array]:
    def copy(array: Array) -> Array:
        # `device_put` to all devices would compare the arrays of all processes
        parts = [jax.device_put(array, device) for device in mesh.local_devices]
        return jax.make_array_from_single_device_arrays(array.shape, NamedSharding(mesh, REPLICATED), parts)

    return copy


def check_not_sharded(tree: PyTree) -> None:
    """Raises `ValueError` inside `jax.shard_map`, which already assigns devices."""
    varies = any(map(varies_over, filter(eqx.is_array, jax.tree.leaves(tree))))
    if jax.sharding.get_abstract_mesh().manual_axes or varies:
        raise ValueError(
            "devices= is not allowed inside jax.shard_map, which already assigns devices. Remove it, or call "
            "the renderer outside."
        )
