"""Faults of volumes in bricks, and several devices."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import Fault


IMAGE = "bricks/test_images.py::test_bricks_of_a_file_look_like_the_whole_within_the_budget_of_memory"
CURVED = "bricks/test_images.py::test_bricks_look_like_the_whole_where_rays_leave_them_and_come_back[overlap]"
DEVICES = (
    "engine/test_devices.py::"
    "test_work_is_balanced_and_image_gradient_and_owned_bricks_are_those_of_one_device"
)


def _all_of_its_cells(of_brick: Callable[..., Any]) -> Callable[..., Any]:
    """A device marches from where its brick begins, also where those before it have been."""

    def faulty(self: Any, grid: Any, scene: Any, brick: Any) -> Any:
        everything = self.owned._replace(first=jnp.zeros_like(self.owned.first))
        return of_brick(type(self)(self.underway, everything), grid, scene, brick)

    return faulty


def _only(brick: int, empty: Any) -> Any:
    """A ray goes on from a brick through none but itself, and what is empty."""
    return empty | (np.arange(len(empty)) == brick)


FAULTS = [
    Fault(
        "devices: each ray of a beam that is not full is taken for another",
        "engine.devices:shard_rays",
        lambda dealt: lambda *given: (*dealt(*given)[:2], dealt(*given)[2][::-1]),
        (DEVICES,),
    ),
    Fault(
        "shards: the cotangent of each fetch is summed over the shards, and so is the gradient by voxels",
        "engine.voxel_gradient:zero_perturbations",
        lambda zeros: lambda *given: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), zeros(*given)),
        (DEVICES,),
    ),
    Fault(
        "owned bricks: a device begins where its bricks do, rather than where those before it end",
        "bricks.distributed:Share.of_brick",
        _all_of_its_cells,
        (DEVICES,),
    ),
    Fault(
        "bricks: back to front",
        "bricks.grid:BrickGrid.order",
        lambda order: lambda *given: order(*given)[::-1],
        (IMAGE,),
    ),
    Fault(
        "bricks: nothing is read around them but what interpolation needs",
        "bricks.grid:nodes_within",
        lambda nodes: lambda *given: 0 * nodes(*given),
        (IMAGE,),
    ),
    Fault(
        "bricks: none takes what rays meet in another one that was read before",
        "bricks.traversal:Traversal.cells_of",
        lambda of: lambda self, brick, _, empty, *given: of(self, brick, _only(brick, empty), empty, *given),
        (CURVED,),
    ),
    Fault(
        "bricks: a file that changed after it was opened is read",
        "bricks.sources:VoxelSource.check_unchanged",
        lambda _: lambda self: None,
        ("bricks/test_sources.py::test_a_file_that_is_cut_or_written_to_after_opening_is_an_error[change1]",),
    ),
]
