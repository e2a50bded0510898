"""Deals the rays of an image out to devices, each of which has the whole scene.

Beams of rays are dealt round-robin, so that each device has its share of what is expensive wherever that lies
in the image. Each renders its own by the program of one device, and JAX sums their gradients.
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
"""What a caller may pass for devices."""

AXIS = "devices"
"""Name of the mesh axis."""

REPLICATED, SHARDED = PartitionSpec(), PartitionSpec(AXIS)
"""An array that every device has; and one of which each has its part along the first axis."""

LARGE = 2**16
"""Bytes from which on an array is kept on all devices for the next image."""


def mesh_of(devices: Any) -> Mesh | None:
    """The devices as a mesh of one axis; None for None: JAX decides where the image is computed.

    Raises:
        ValueError: for what is neither a sequence of JAX's devices nor a mesh of them of one axis, for none,
            for one that is there twice, and for devices of several kinds.
    """
    if devices is None:
        return None
    expected = "a sequence of JAX devices, such as jax.devices(), or a jax.sharding.Mesh of one axis"
    if isinstance(devices, Mesh):
        if devices.devices.ndim != 1:
            raise ValueError(f"devices must be {expected}; got a mesh of the axes {dict(devices.shape)}.")
        devices = devices.devices.tolist()
    listed = list(devices) if isinstance(devices, Iterable) and not isinstance(devices, str) else [devices]
    found: list[Any] = [each for each in listed if isinstance(each, jax.Device)]
    if len(found) < len(listed) or not isinstance(devices, Iterable):
        wrong = next((each for each in listed if not isinstance(each, jax.Device)), devices)
        raise ValueError(f"devices must be {expected}; got {described(wrong)}.")
    if not found or len(set(found)) < len(found) or len({each.platform for each in found}) > 1:
        raise ValueError(f"devices must be one or more different devices of one platform; got {found}.")
    return Mesh(np.asarray(found), (AXIS,))


def _dealt_image(
    mesh: Mesh,
    render: Callable[[Scene, RenderOptions, VolumeAcceleration], Rendering],
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
) -> Rendering:
    """What `render` returns, by all devices of a mesh, each of which renders its part of the rays. The image
    is then on all of them."""
    shape, *dealt = dealt_rays(scene.source, options.tiling, mesh.size)
    indices, place = map(jnp.asarray, dealt)
    arrays, rest = eqx.partition((scene, acceleration), eqx.is_array)

    def own(arrays: PyTree, indices: Int[Array, " rays"]) -> Rendering:
        scene, acceleration = eqx.combine(arrays, rest)
        return render(scene._replace(source=RaySubset(scene.source, indices)), options, acceleration)

    # Types are not checked: every loop, in a user's transform too, would have to start with arrays that vary.
    how: Any = {"mesh": mesh, "in_specs": (REPLICATED, SHARDED), "out_specs": SHARDED, "check_vma": False}
    found = jax.shard_map(own, **how)(arrays, indices)
    whole = jax.tree.map(lambda leaf: leaf[place].reshape(*shape, *leaf.shape[1:]), found)
    return jax.lax.with_sharding_constraint(whole, NamedSharding(mesh, REPLICATED))


over_devices = compiled(_dealt_image, has_jvp=True)


def dealt_rays(
    source: Source, tiling: Tiling, devices: int
) -> tuple[tuple[int, ...], Int[np.ndarray, " dealt"], Int[np.ndarray, " rays"]]:
    """The shape of an image; the indices of its rays, those of each device in turn, beam by beam; and where
    each ray of the image is among these. Beams that are not full repeat rays."""
    rays = without_ends(source)
    if isinstance(rays, Camera):
        (width, height), side = rays.size, tiling.beam
        across, down = -(-width // side), -(-height // side)
        y, x = np.indices((down * side, across * side)).reshape(2, down, side, across, side)
        inside = (y < height) & (x < width)
        index = np.minimum(y, height - 1) * width + np.minimum(x, width - 1)
        # where the columns are a multiple of the devices, each device would always get the same ones
        row = np.arange(down)[:, None]
        column = (np.arange(across) + row * (across % devices == 0)) % across
        index, inside = (np.swapaxes(each, 1, 2)[row, column] for each in (index, inside))
        index, inside = index.reshape(-1, side**2), inside.reshape(-1, side**2)
        shape = height, width
    else:
        shape = rays.origins.shape[:-1]
        count, size = int(np.prod(shape)), tiling.rays_per_beam
        index = np.arange(-(-count // size) * size).reshape(-1, size)
        index, inside = np.minimum(index, count - 1), index < count
    missing = -len(index) % devices
    index, inside = (np.pad(each, ((0, missing), (0, 0))) for each in (index, inside))
    beams = np.arange(len(index)).reshape(-1, devices).T.reshape(-1)
    index, inside = index[beams].reshape(-1), inside[beams].reshape(-1)
    place = np.zeros(int(np.prod(shape)), int)
    place[index[inside]] = np.flatnonzero(inside)
    return shape, index.astype(np.int32), place


def on_all(mesh: Mesh | None, tree: PyTree) -> PyTree:
    """The tree, with its large arrays (`LARGE` bytes or more) and committed ones copied to all devices, once
    in the lifetime of each; JAX copies the others for each image."""
    if mesh is None:
        return tree
    there = set(mesh.devices.tolist())

    def one(leaf: Any) -> Any:
        if not isinstance(leaf, jax.Array) or is_traced(leaf) or leaf.sharding.device_set == there:
            return leaf
        return memoized(leaf, _copier(mesh)) if leaf.nbytes >= LARGE or leaf.committed else leaf

    return jax.tree.map(one, tree)


@cache
def _copier(mesh: Mesh) -> Callable[[Array], Array]:
    def copied(array: Array) -> Array:
        # not `device_put` to all, which would compare the arrays of all processes
        parts = [jax.device_put(array, device) for device in mesh.local_devices]
        return jax.make_array_from_single_device_arrays(array.shape, NamedSharding(mesh, REPLICATED), parts)

    return copied


def check_not_sharded(tree: PyTree) -> None:
    """Raises `ValueError` inside of a `jax.shard_map`, where devices are shared out already."""
    varies = any(map(varies_over, filter(eqx.is_array, jax.tree.leaves(tree))))
    if jax.sharding.get_abstract_mesh().manual_axes or varies:
        raise ValueError(
            "devices cannot be given inside jax.shard_map, which has dealt them out: leave it out there, or "
            "call the renderer outside."
        )
