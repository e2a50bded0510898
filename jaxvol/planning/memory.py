"""Does a volume fit into a budget of memory, and if not, by which steps and bricks is it rendered?"""

import math
from typing import Any

import jax.numpy as jnp

from ..bricks.grid import TooLittleMemory
from ..bricks.opening import Openable, source_of
from ..bricks.render import budget, scene_of
from ..bricks.sources import VoxelSource
from ..bricks.traversal import Request, Traversal
from ..compositing.blending import Compositing
from ..lighting.shading import Lighting
from ..march.march import March
from ..scene.camera import Camera
from ..scene.rendering import BrickReport
from ..scene.transfer import Transfer
from ..scene.volume import Volume


IN_MEMORY = 9
"""Most bytes that `render` takes for each byte of voxels: these as read and in the device, a packed copy of
8-bit ones, the extremes of blocks, and slopes."""

HALVED = 4
"""How often a step may be halved so that bricks fit."""


def read_within(volume: Openable, memory: Any) -> tuple[Volume, VoxelSource, int, int]:
    """The volume if `render` takes no more than so many bytes for it, or a copy that does; its source; the
    bytes; and the stride of the copy, 1 for the volume itself."""
    room, source = budget(memory), source_of(volume)
    if source.direction is not None:
        raise ValueError("volume must lie along the axes of the world to be planned with memory.")
    stride = 1
    while IN_MEMORY * source.dtype.itemsize * math.prod(-(-n // stride) for n in source.shape) > room:
        stride += 1
        if min(source.shape) // stride < 2:
            raise ValueError(f"memory must hold a copy of 2 voxels along each axis; got {room} bytes.")
    return source.subsampled(stride), source, room, stride


def with_bricks(
    source: VoxelSource,
    transfer: Transfer,
    camera: Camera,
    march: March,
    stride: int,
    *,
    memory: int,
    compositing: Compositing[Any],
    lighting: Lighting | None,
) -> tuple[March, BrickReport]:
    """The march that was planned for a copy of every n-th voxel, with steps of 1/n, and shorter ones if
    bricks fit only then; and the bricks."""
    finer = stride
    while True:
        shorter = March(jnp.asarray(march.step) / finer, march.transforms, march.quadrature)
        try:
            scene = scene_of(source, transfer, camera, shorter, compositing, lighting)
            return shorter, Traversal(Request(source, memory), scene).report()
        except TooLittleMemory:  # what is read around a brick is a number of steps
            if finer == stride * 2**HALVED:
                raise
            finer *= 2
