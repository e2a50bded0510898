"""Of which type are the voxels of a source once they are read? As in a `Volume`, but decided before that."""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from .._util.axes import Axes
from .._util.voxels import DTYPES, WHOLE, check_type


Box: TypeAlias = tuple[tuple[int, int, int], tuple[int, int, int]]
"""First voxel along x, y and z, and the one behind the last."""


def voxel_type(stored: np.dtype) -> np.dtype:
    """The type in which voxels stored as `stored` are read: one of `Volume`'s, in native byte order.

    Booleans become uint8, integers of 32 and 64 bits float32. float64 stays where JAX's 64-bit types are
    enabled. **Raises** `ValueError` for a type that no volume has, such as a complex one."""
    check_type(stored)
    if stored.kind == "b":
        return np.dtype(np.uint8)
    if stored.name in DTYPES:
        return stored.newbyteorder("=")
    return np.dtype(np.float32) if stored.kind in "iu" else np.dtype(jnp.result_type(float))


def comparable(voxels: np.ndarray) -> np.ndarray:
    """16-bit floats as float32, of which NumPy finds extremes many times faster."""
    return voxels if voxels.dtype.kind in "iu" or voxels.itemsize > 2 else voxels.astype(np.float32)


def range_of(voxels: np.ndarray) -> tuple[float, float]:
    """Least and greatest voxel; NaN if any is, and infinite if any is: unlike a mask, they take no memory."""
    with np.errstate(invalid="ignore"):
        ranges = [(layer.min(), layer.max()) for layer in map(comparable, voxels)]
        return float(np.min(ranges)), float(np.max(ranges))


def converted(voxels: np.ndarray, box: Box, axes: Axes, name: str) -> np.ndarray:
    """Voxels as `voxel_type` says, and C-contiguous. `box`, `axes`, `name`: where they were read.

    **Raises:** `ValueError` for NaN, infinity, and integers that float32 does not hold exactly."""
    dtype, place = voxel_type(voxels.dtype), f"in the box {box[0]} to {box[1]}"
    if dtype == np.float32 and voxels.dtype.kind in "iu":
        least, most = WHOLE["float32"]
        low, high = int(voxels.min()), int(voxels.max())
        if low < least or high > most:
            raise ValueError(
                f"{name}: voxels must be whole numbers from -2**24 to 2**24, which float32 holds exactly; "
                f"got {voxels.dtype} from {low} to {high} {place}."
            )
    with np.errstate(over="ignore"):  # overflow to infinity is rejected below
        voxels = np.ascontiguousarray(voxels, dtype)
    if dtype.kind not in "iu" and not np.all(np.isfinite(range_of(voxels))):
        wrong = ~(abs(voxels) < np.inf)
        first = np.argwhere(wrong)[0]
        at = tuple(start + int(first[axes.index(axis)]) for axis, start in enumerate(box[0]))
        raise ValueError(
            f"{name}: voxels must be finite in {dtype}; got {np.sum(wrong)} that are NaN or infinite "
            f"{place}, the first at {at}. Replace them first."
        )
    return voxels
