"""Which device does which part of the work?

Things of about the same cost, beams of rays and chunks of pixels, are dealt out to devices in turn, so that
each has its share of what is expensive wherever that lies in the image. Each device does its own one after
the other. All have the whole scene; what they sum is summed over all of them.

An array of such things is stored *dealt*: those of the first device, then those of the second, and so on.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from .._util.checks import described, is_traced
from .._util.memo import memoized
from .._util.sharding import varies_over
from .._util.trees import PyTree, added


Devices: TypeAlias = Sequence[Any] | Mesh
"""What a caller may pass for devices."""

AXIS = "devices"
"""Name of the mesh axis."""

WHOLE, DEALT = PartitionSpec(), PartitionSpec(AXIS)
"""An array that every device has; and one of which each has its part along the first axis."""

LARGE = 2**16
"""Bytes from which on an array is kept on all devices for the next image."""


def mesh_of(devices: Any) -> Mesh | None:
    """The devices as a mesh of one axis; None for None: JAX decides where the image is computed.

    **Raises:** `ValueError` for what is neither a sequence of JAX's devices nor a mesh of them of one axis,
    for none, for one that is there twice, and for devices of several kinds."""
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


def number_of(mesh: Mesh | None) -> int:
    """Number of devices."""
    return 1 if mesh is None else mesh.size


def dealt(mesh: Mesh | None, things: Array) -> Array:
    """Things in their order, along the first axis, as they are dealt out in turn; a multiple of the number of
    devices."""
    number = number_of(mesh)
    turns = things.reshape(things.shape[0] // number, number, *things.shape[1:])
    return jnp.swapaxes(turns, 0, 1).reshape(things.shape)


def collected(mesh: Mesh | None, things: Array) -> Array:
    """The inverse of `dealt`, on all devices."""
    if mesh is None:
        return things
    things = jax.lax.with_sharding_constraint(things, NamedSharding(mesh, WHOLE))
    turns = things.reshape(mesh.size, things.shape[0] // mesh.size, *things.shape[1:])
    return jnp.swapaxes(turns, 0, 1).reshape(things.shape)


def scan(
    mesh: Mesh | None, f: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], sums: PyTree, dealt: PyTree
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan`, by each device over its own things. What `f` adds to `sums` is summed over devices; its
    other results are dealt out as the things are. What `f` closes over, all devices have."""
    if mesh is None:
        return jax.lax.scan(f, sums, dealt)

    def own(dealt: PyTree) -> tuple[PyTree, PyTree]:
        found, results = jax.lax.scan(f, jax.tree.map(jnp.zeros_like, sums), dealt)
        return jax.lax.psum(found, AXIS), results

    # Types are not checked, which would ask every loop in a user's transform to start with arrays that vary.
    # Under jit, since what it closes over may be differentiated.
    dealt_out = jax.shard_map(own, mesh=mesh, in_specs=DEALT, out_specs=(WHOLE, DEALT), check_vma=False)
    found, results = jax.jit(dealt_out)(dealt)
    return added(sums, found), results


def map_over(mesh: Mesh | None, f: Callable[[PyTree], PyTree], dealt: PyTree) -> PyTree:
    """`jax.lax.map`, by each device over its own things."""
    return scan(mesh, lambda none, thing: (none, f(thing)), None, dealt)[1]


def on_all(mesh: Mesh | None, tree: PyTree) -> PyTree:
    """The tree, with those of its arrays on all devices that would otherwise be copied there for each image,
    or that lie where JAX would not move them from. They are copied once in their lifetime."""
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
        return jax.make_array_from_single_device_arrays(array.shape, NamedSharding(mesh, WHOLE), parts)

    return copied


def check_not_sharded(mesh: Mesh | None, tree: PyTree) -> None:
    """Raises `ValueError` inside of a `jax.shard_map`, where devices are dealt out already."""
    if mesh is not None and (jax.sharding.get_abstract_mesh().manual_axes or _varies(tree)):
        raise ValueError(
            "devices cannot be given inside jax.shard_map, which has dealt them out: leave it out there, or "
            "call the renderer outside."
        )


def _varies(tree: PyTree) -> bool:
    return any(map(varies_over, filter(eqx.is_array, jax.tree.leaves(tree))))
