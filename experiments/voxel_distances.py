"""The distance map of Chae and Shin as published: a distance for each voxel, made before rendering.

`jv.SpaceLeaping` determines visible blocks of 4³ voxels, and distances between these, in every image. With a
distance for each voxel, leaps end nearer to what is visible, but the map takes seconds to make, holds for one
transfer function only, and is 64 times as large.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped, UInt8
from scipy.ndimage import distance_transform_cdt

import jaxvol as jv
from jaxvol.march.march import EmptySpaceIndex, View
from jaxvol.scene.occupancy import FARTHEST, ROUNDING, Blocks, Occupancy


class Measured(Occupancy):
    """Occupied cells, of which the distances are known."""

    distances: UInt8[Array, " cells"] = eqx.field(kw_only=True)

    def distance(self) -> UInt8[Array, " cells"]:
        return self.distances


class VoxelLeaping(jv.SpaceLeaping):
    """`SpaceLeaping` by distances of voxels: under `"distance"` as they are, under `"min_distance"` from
    starts found with them. Only for the volume and the transfer function that the `grid` is of: the image of
    others would be wrong."""

    grid: Measured

    def __init__(self, grid: Measured, method: Any = "distance", cell: int = 8):
        super().__init__(method, cell)
        self.grid = grid

    def empty_space(self, occupancy: Occupancy, view: View | None) -> EmptySpaceIndex:
        return super().empty_space(self.grid, view)


def distances(volume: jv.Volume, transfer: jv.TransferFunction) -> Measured:
    """Chessboard distance from each cell between voxels to the nearest in which anything may be visible."""
    data = np.asarray(volume.data, np.float32)
    low, high = over_corners(data, np.minimum), over_corners(data, np.maximum)
    slack = ROUNDING * np.maximum(abs(low), abs(high))
    ranges = Blocks(jnp.asarray(low - slack), jnp.asarray(high + slack), None)
    visible = np.asarray(transfer.visible(ranges))
    away = np.full(visible.shape, FARTHEST)
    if visible.any():
        found = np.asarray(distance_transform_cdt(~visible, metric="chessboard"))
        away = np.minimum(found, FARTHEST - 1)
    corner, size = (tuple(of) for of in (volume.origin, volume.spacing))
    return Measured(jnp.asarray(visible), corner, size, distances=jnp.asarray(away.astype(np.uint8).ravel()))


def over_corners(data: Shaped[np.ndarray, "nx ny nz"], combine: np.ufunc) -> np.ndarray:
    """Combines the eight voxels at the corners of each cell."""
    for axis in range(3):
        n = data.shape[axis]
        data = combine(data.take(range(n - 1), axis), data.take(range(1, n), axis))
    return data
