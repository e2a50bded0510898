"""Which value stands at this grid coordinate?

Grid coordinates count voxels: the node `data[i, j, k]` stands at coordinate (i, j, k), so a
grid of n nodes spans n - 1 steps along an axis. Between nodes the value is trilinear; outside
the grid it is that of the nearest point of the grid.
"""

import itertools
import math
import os
from typing import Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer, Shaped

from ._util.checks import Arrayable, described, finite, finite_array, is_traced, require
from ._util.vec3 import Scalar, Vec3


DTYPES = ("uint8", "int8", "uint16", "int16", "float16", "bfloat16", "float32")

WHOLE = {
    "uint8": (0, 2**8 - 1),
    "int8": (-(2**7), 2**7 - 1),
    "uint16": (0, 2**16 - 1),
    "int16": (-(2**15), 2**15 - 1),
    "float32": (-(2**24), 2**24),
}
"""The whole numbers that a type holds exactly, from the smallest type on."""


Cube: TypeAlias = list[list[list[Scalar]]]
"""Eight voxels, [x][y][z]."""


class Volume(eqx.Module):
    """A scalar field sampled on a regular grid, `data[x, y, z]`.

    **Arguments:**

    - `data`: (nx, ny, nz) voxels, at least 2 along each axis: an array of any library and memory layout, or
      nested sequences. uint8, int8, uint16, int16, float16, bfloat16 and float32 are kept as they are on the
      device, and converted after a voxel is fetched. float64 follows JAX: kept where 64-bit types are
      enabled, else made float32. Booleans, and integers of 32 and 64 bits, become the first of uint8, int8,
      uint16, int16 and float32 that holds each of the values exactly.
    - `spacing`: distance between neighbouring nodes along x, y, z, in world length (mm for CT).
    - `origin`: world position of node (0, 0, 0).
    - `labels`: optional integer label of every node (a segmentation), of the same shape. 64 bits become 32.

    **Raises:** `ValueError` naming the argument for data that are not 3-D, have an axis of one
    voxel, another type, or voxels that are NaN or infinite, also in float32 alone; for integers that no type
    holds exactly; for spacing that is not positive; and for labels of another shape or type, or beyond int32.

    A subclass may override `value` (a field of its own, say), which every engine and adjoint then measures;
    `SpaceLeaping` leaps over nothing of it. The gradient to its voxels under `"replay"` takes those that it
    asks `super().value` for.
    """

    data: Shaped[Array, "nx ny nz"]
    spacing: Float[Array, "3"]
    origin: Float[Array, "3"]
    labels: Integer[Array, "nx ny nz"] | None

    def __init__(
        self,
        data: Arrayable,
        spacing: Arrayable = (1.0, 1.0, 1.0),
        origin: Arrayable = (0.0, 0.0, 0.0),
        labels: Arrayable | None = None,
    ):
        self.data = _voxels(data)
        spacing = finite_array("spacing", spacing, (3,))
        self.spacing = require(
            spacing, lambda s: s > 0, "spacing must be positive along every axis; got {got}."
        )
        self.origin = finite_array("origin", origin, (3,))
        self.labels = None if labels is None else _labels(labels, self.data.shape)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along x, y, z."""
        nx, ny, nz = self.data.shape
        return nx, ny, nz

    @property
    def bounds(self) -> Float[Array, "6"]:
        """World extent (x_min, x_max, y_min, y_max, z_min, z_max), from the first node to the last."""
        low, high = self.corners
        return jnp.stack([low, high], axis=-1).reshape(-1)

    @property
    def corners(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """World positions of the first and the last node."""
        steps = jnp.asarray(self.shape, self.spacing.dtype) - 1
        return self.origin, self.origin + steps * self.spacing

    @property
    def center(self) -> Float[Array, "3"]:
        """World position of the middle of the bounds."""
        low, high = self.corners
        return (low + high) / 2

    def value(self, coordinate: Vec3) -> Scalar:
        """Trilinear value at a grid coordinate, in the coordinate's float type."""
        (((c000, c001), (c010, c011)), ((c100, c101), (c110, c111))), (fx, fy, fz) = self._cube(coordinate)
        return _mix(
            fx,
            _mix(fy, _mix(fz, c000, c001), _mix(fz, c010, c011)),
            _mix(fy, _mix(fz, c100, c101), _mix(fz, c110, c111)),
        )

    def gradient(self, coordinate: Vec3, method: Literal["trilinear", "central"] = "central") -> Vec3:
        """Gradient of the value in the grid's own axes, in value units per world length.

        - `"trilinear"`: derivative of the trilinear value inside the cell; exact for what is
          rendered, and discontinuous where cells meet.
        - `"central"`: difference over one node to either side, continuous, with an error of
          O(spacing²) against the gradient of the field that was sampled; where the grid ends, the
          difference is taken over the part inside.
        """
        if method == "trilinear":
            slopes = self._trilinear_slopes(coordinate)
        elif method == "central":
            slopes = self._central_slopes(coordinate)
        else:
            raise ValueError(f'method must be "trilinear" or "central"; got {method!r}.')
        sx, sy, sz = slopes
        return sx / self.spacing[0], sy / self.spacing[1], sz / self.spacing[2]

    def label(self, coordinate: Vec3) -> Int[Array, ""]:
        """Label of the node nearest to a grid coordinate (the upper one half-way between two)."""
        if self.labels is None:
            raise ValueError("labels are needed here and this volume has none; give Volume(..., labels=...).")
        i, j, k = (
            jnp.clip(jnp.floor(c + 0.5).astype(jnp.int32), 0, n - 1)
            for c, n in zip(coordinate, self.shape, strict=True)
        )
        _, ny, nz = self.shape
        return _fetch(self.labels, (i * ny + j) * nz + k).astype(jnp.int32)

    def label_share(self, coordinate: Vec3, label: int) -> Scalar:
        """The trilinear share of a label at a grid coordinate: 1 among nodes that have it, 0 among others."""
        if self.labels is None:
            raise ValueError("labels are needed here and this volume has none; give Volume(..., labels=...).")
        (i, j, k), fraction = split(coordinate, self.shape)
        _, ny, nz = self.shape
        share = jnp.zeros_like(fraction[0])
        for x, y, z in itertools.product((0, 1), repeat=3):
            node = _fetch(self.labels, ((i + x) * ny + j + y) * nz + k + z)
            sides = (f if side else 1 - f for side, f in zip((x, y, z), fraction, strict=True))
            share = share + math.prod(sides) * (node == label).astype(share.dtype)
        return share

    def _cube(self, coordinate: Vec3) -> tuple[Cube, Vec3]:
        """The eight voxels around a coordinate, [x][y][z], and the fractions between them."""
        dtype = coordinate[0].dtype
        (i, j, k), fraction = split(coordinate, self.shape)
        _, ny, nz = self.shape
        base = (i * ny + j) * nz + k
        cube = [
            [[self._voxel(base + (x * ny + y) * nz + z).astype(dtype) for z in (0, 1)] for y in (0, 1)]
            for x in (0, 1)
        ]
        return cube, fraction

    def _voxel(self, flat: Int[Array, ""]) -> Shaped[Array, ""]:
        return _fetch(self.data, flat)

    def _trilinear_slopes(self, coordinate: Vec3) -> Vec3:
        (((c000, c001), (c010, c011)), ((c100, c101), (c110, c111))), (fx, fy, fz) = self._cube(coordinate)
        return (
            _mix(fy, _mix(fz, c100 - c000, c101 - c001), _mix(fz, c110 - c010, c111 - c011)),
            _mix(fx, _mix(fz, c010 - c000, c011 - c001), _mix(fz, c110 - c100, c111 - c101)),
            _mix(fx, _mix(fy, c001 - c000, c011 - c010), _mix(fy, c101 - c100, c111 - c110)),
        )

    def _central_slopes(self, coordinate: Vec3) -> Vec3:
        def slope(axis: int) -> Scalar:
            last = self.shape[axis] - 1
            before, after = (jnp.clip(coordinate[axis] + side, 0, last) for side in (-1, 1))
            rise = self.value(_with(coordinate, axis, after)) - self.value(_with(coordinate, axis, before))
            # at least half a node apart for any coordinate less than half a node outside the grid
            return rise / jnp.maximum(after - before, 0.5)

        return slope(0), slope(1), slope(2)


def _voxels(data: Arrayable) -> Array:
    data = _array("data", data)
    if data.ndim != 3 or min(data.shape) < 2:
        raise ValueError(
            f"data must be data[x, y, z] with at least 2 voxels along each axis; got shape {data.shape}. "
            "For a stack of images, stack them along the last axis."
        )
    if data.size >= 2**31:
        raise ValueError(f"data must have fewer than 2**31 voxels; got {data.size} (shape {data.shape}).")
    if data.dtype.kind in "bui" and str(data.dtype) not in DTYPES:
        return jnp.asarray(_narrow(data))
    if str(data.dtype) not in (*DTYPES, "float64"):
        raise ValueError(
            f"data must be of type {', '.join(DTYPES)}; got {data.dtype}. Convert it, for example with "
            "data.astype(np.float32), where that keeps the values apart."
        )
    if data.dtype.kind in "ui":
        return jnp.asarray(data)
    if is_traced(data):
        message = "data must be finite; got some voxels that are NaN or infinite. Replace them first."
        return require(jnp.asarray(data), finite, message)
    kept = np.asarray(data)
    if kept.dtype == np.float64:
        with np.errstate(over="ignore"):  # what becomes infinite is refused below
            kept = kept.astype(jnp.result_type(float))
    if not np.all(finite(kept)):
        beyond = f" in {kept.dtype}, as which they are kept" if np.all(finite(np.asarray(data))) else ""
        raise ValueError(
            f"data must be finite{beyond}; got {np.sum(~finite(kept))} of {kept.size} voxels that are NaN or "
            "infinite. Replace them, or rescale all, first."
        )
    return jnp.asarray(kept if kept.dtype != data.dtype else data)


def _narrow(data: Array | np.ndarray) -> np.ndarray:
    """The same whole numbers in the smallest type that voxels may have."""
    if is_traced(data):
        raise ValueError(
            f"data must be of type {', '.join(DTYPES)} where they are traced; got {data.dtype}, whose range "
            "is not known before the program runs. Convert them: data.astype(jnp.float32)."
        )
    low, high = int(data.min()), int(data.max())
    for dtype, (least, most) in WHOLE.items():
        if least <= low and high <= most:
            return np.asarray(data).astype(dtype)
    raise ValueError(
        f"data must be whole numbers from -2**24 to 2**24, which float32 keeps apart; got {data.dtype} from "
        f"{low} to {high}. Subtract an offset, or rescale them to data.astype(np.float32)."
    )


def _labels(labels: Arrayable, shape: tuple[int, ...]) -> Array:
    labels = _array("labels", labels)
    if labels.dtype.kind not in "bui":
        raise ValueError(
            f"labels must be integers; got {labels.dtype}. Convert them: labels.astype(np.int32)."
        )
    if labels.shape != shape:
        raise ValueError(f"labels must stand on the grid of data, shape {shape}; got shape {labels.shape}.")
    if labels.dtype.kind == "b":
        return jnp.asarray(labels, jnp.uint8)
    if labels.dtype.itemsize < 4 or labels.dtype == np.int32 or is_traced(labels):
        return jnp.asarray(labels)
    low, high = int(labels.min()), int(labels.max())
    if low < -(2**31) or high >= 2**31:
        raise ValueError(
            f"labels must lie within int32; got {labels.dtype} from {low} to {high}. Number them anew: "
            "np.unique(labels, return_inverse=True)."
        )
    return jnp.asarray(np.asarray(labels).astype(np.int32))


def _array(name: str, value: Arrayable) -> Array | np.ndarray:
    """An array of JAX or, in native byte order, of NumPy."""
    if isinstance(value, str | os.PathLike):
        raise ValueError(f"{name} must be an array; got {described(value)}. jv.load(path) reads files.")
    if is_traced(value) or isinstance(value, jax.Array):
        return jnp.asarray(value)
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(
            f"{name} must be an array without a mask; got a masked one. Fill it: data.filled(0)."
        )
    try:
        array = np.asarray(value)
    except ValueError as fault:  # sequences of different lengths
        raise ValueError(f"{name} must be an array; got {described(value)}: {fault}") from fault
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def split(
    coordinate: Vec3, shape: tuple[int, int, int]
) -> tuple[tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]], Vec3]:
    """The node below a coordinate and the fractions past it; the last node belongs to the cell below."""
    x, y, z = (jnp.clip(c, 0, n - 1) for c, n in zip(coordinate, shape, strict=True))
    # the second limit also keeps NaN inside the array
    i, j, k = (jnp.clip(c.astype(jnp.int32), 0, n - 2) for c, n in zip((x, y, z), shape, strict=True))
    return (i, j, k), (x - i.astype(x.dtype), y - j.astype(y.dtype), z - k.astype(z.dtype))


def _with(coordinate: Vec3, axis: int, component: Scalar) -> Vec3:
    x, y, z = (component if i == axis else c for i, c in enumerate(coordinate))
    return x, y, z


def _fetch(array: Shaped[Array, "nx ny nz"], flat: Int[Array, ""]) -> Shaped[Array, ""]:
    return array.reshape(-1).at[flat].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _mix(fraction: Scalar, a: Scalar, b: Scalar) -> Scalar:
    # a + f (b - a) would round differently at f = 1; this form gives a and b exactly at the ends
    return a * (1 - fraction) + b * fraction


def without_voxels(volume: Volume) -> Volume:
    """A volume but for its voxels, of which there are too many to be handed around."""
    return eqx.tree_at(lambda v: v.data, volume, None)


def with_voxels(volume: Volume, data: Array) -> Volume:
    """The volume with these voxels."""
    return eqx.tree_at(lambda v: v.data, volume, data, is_leaf=lambda leaf: leaf is None)
