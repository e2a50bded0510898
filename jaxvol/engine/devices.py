"""Which device does which part of the work?

A program of the engine runs on all devices (`split`), to which the scene is replicated. Beams of rays and
chunks of pixels are sharded round-robin (`own_share`), so that each device has its share of what is expensive
wherever that lies in the image. What they find is gathered (`gathered`), or summed (`summed`). Without
several devices, all of this changes nothing.
"""

import inspect
from collections.abc import Callable, Iterable, Sequence
from functools import cache, wraps
from typing import Any, Literal, ParamSpec, TypeAlias, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from .._util.checks import described
from ..xla.memo import memoized
from ..xla.platform import is_traced
from ..xla.sharding import varies_over
from ..xla.trees import PyTree


P = ParamSpec("P")
T = TypeVar("T")

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


def number_of(mesh: Mesh | None) -> int:
    """Number of devices."""
    return 1 if mesh is None else mesh.size


def split(
    mesh: Mesh | None, program: Callable[..., tuple[PyTree, PyTree]], replicated: PyTree, sharded: PyTree
) -> tuple[PyTree, PyTree]:
    """What `program(replicated, sharded)` returns on all devices.

    Args:
        replicated: what all devices have, not only arrays.
        sharded: arrays of which each device has a part along the first axis, and is given that.

    The program returns the same two: first what is the same on all devices, then what is sharded.
    """
    if mesh is None:
        return program(replicated, sharded)
    arrays, rest = eqx.partition(replicated, eqx.is_array)

    def own(arrays: PyTree, sharded: PyTree) -> tuple[PyTree, PyTree]:
        return program(eqx.combine(arrays, rest), sharded)

    # Types are not checked: every loop, in a user's transform too, would have to start with arrays that vary.
    specs = (REPLICATED, SHARDED)
    shared = jax.shard_map(own, mesh=mesh, in_specs=specs, out_specs=specs, check_vma=False)
    return jax.jit(shared)(arrays, sharded)


def on_devices(
    gives: Literal["replicated", "sharded", "both"], *, sharded: tuple[str, ...] = ()
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorator: a function of `options` runs by `split` on their devices. `gives`: whether its result
    is replicated, sharded, or a pair of both. `sharded`: names of the sharded arguments."""

    def made(function: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(function)
        called: Callable[..., T] = function

        def program(given: dict[str, Any], parts: dict[str, Any]) -> tuple[PyTree, PyTree]:
            result: Any = called(**given, **parts)
            return {"replicated": (result, None), "sharded": (None, result), "both": result}[gives]

        @wraps(function)
        def run(*args: P.args, **kwargs: P.kwargs) -> T:
            given = signature.bind(*args, **kwargs).arguments
            parts = {name: given.pop(name) for name in sharded}
            result: Any = split(given["options"].tiling.devices, program, given, parts)
            return {"replicated": result[0], "sharded": result[1], "both": result}[gives]

        return run

    return made


def index_of(mesh: Mesh | None) -> Array | int:
    """Number of this device, inside `split`."""
    return 0 if mesh is None else jax.lax.axis_index(AXIS)


def own_share(mesh: Mesh | None, things: Array) -> Array:
    """This device's share of things, round-robin, inside `split`. Their number is a multiple of the
    devices'."""
    if mesh is None:
        return things
    return things.reshape(things.shape[0] // mesh.size, mesh.size, *things.shape[1:])[:, index_of(mesh)]


def gathered(mesh: Mesh | None, things: Array) -> Array:
    """The inverse of `own_share`, on all devices, inside `split`."""
    if mesh is None:
        return things
    turns = jax.lax.all_gather(things, AXIS, axis=1)
    return turns.reshape(things.shape[0] * mesh.size, *things.shape[1:])


def summed(mesh: Mesh | None, tree: PyTree) -> PyTree:
    """The sum of what each device has, inside `split`."""
    return tree if mesh is None else jax.lax.psum(tree, AXIS)


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


def check_not_sharded(mesh: Mesh | None, tree: PyTree) -> None:
    """Raises `ValueError` inside of a `jax.shard_map`, where devices are shared out already."""
    if mesh is not None and (jax.sharding.get_abstract_mesh().manual_axes or _varies(tree)):
        raise ValueError(
            "devices cannot be given inside jax.shard_map, which has dealt them out: leave it out there, or "
            "call the renderer outside."
        )


def _varies(tree: PyTree) -> bool:
    return any(map(varies_over, filter(eqx.is_array, jax.tree.leaves(tree))))
