"""Volumes: values, gradients and labels of a regular grid at grid coordinates.

Grid coordinates count voxels: node `data[i, j, k]` lies at (i, j, k), so that n nodes span n - 1 cells.
Values are interpolated trilinearly; outside the grid they are those of the nearest point of the grid.
"""

import operator
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer, Shaped

from .._util.affine import FLAT
from .._util.axes import XYZ, Axes
from .._util.checks import Arrayable, described, finite_array, integers, require, shortened
from .._util.texts import is_concrete, pasted
from .._util.vec3 import Frame, Scalar, Vec3
from .._util.voxels import label_array, voxel_array
from ..xla.memory import gather
from ..xla.platform import in_numpy, is_traced
from ..xla.trees import is_none
from .voxel_fetch import Fetch, OneByOne, Voxel, Window, corners, flat_index, nearest_node


PLACE = 1e-4
"""Tolerance, in voxels, for rounding of a box that should meet a node."""


class Field(eqx.Module):
    """A user-defined field in place of interpolated voxels: `Volume(data, field=...)`.

    Gradients reach arrays that are leaves of the field, and voxels that it reads by `volume.interpolated`.
    Values captured by its functions are refused in reverse mode. A field may hold other volumes, whose voxels
    have gradients in less time and memory than arrays; `adjoint="replay"` requires that it reads them outside
    `jax.vmap`, loops and branches. `SpaceLeaping` never leaps in a field, since its range is unknown.
    """

    @abstractmethod
    def value(self, volume: "Volume", coordinate: Vec3) -> Voxel:
        """Value, or a tuple of channels, at a grid coordinate, whose world position is
        `volume.origin + volume.direction @ (coordinate * volume.spacing)`."""


class Volume(eqx.Module):
    """A field sampled on a regular grid, `data[x, y, z]`, or `data[x, y, z, channel]`.

    Args:
        data: (nx, ny, nz) voxels, at least 2 along each axis, in an array of any library; or (nx, ny, nz, c)
            for c channels, for a transfer function that reads them (`RadianceField`). 8- and 16-bit integers
            and floats of up to 32 bits keep their type; float64 does if JAX's 64-bit types are enabled.
            Others become the first of uint8, int8, uint16, int16 and float32 that holds every value exactly.
            Axes x, y, z of an xarray `DataArray` are put in this order, and its coordinates, which must be
            evenly spaced, give spacing and origin. Images of nibabel (x, y to the right and front in its
            world, left and back here), SimpleITK and VTK (`vtkImageData`, with scalars at points) keep their
            place. Pass an image stack [plane, row, column] as `stack.T`.
        spacing: distance between neighbouring nodes along x, y, z, world length (mm for CT); by default 1.
        origin: world position of node (0, 0, 0), by default 0.
        direction: 3 x 3 matrix whose columns, of length 1, are the world directions of the data's axes, as in
            ITK (`GetDirection`): node (i, j, k) lies at `origin + direction @ (spacing * (i, j, k))`; by
            default the world's axes. Axes need not be orthogonal: a scan with a tilted gantry is sheared.
        labels: optional integer label of every node (a segmentation). 64-bit labels become 32-bit.
        label_ids: original ids of renumbered labels 0, 1, 2, …: label k, or the value k of a volume without
            labels, has the id `label_ids[k]`. `jv.load` sets them;
            `LabelTransferFunction({volume.label_ids.index(997): function})` uses them. Static.
        field: optional `Field` that supplies the values; voxels then only set the volume's extent.

    Limits of its accuracy: `experiments/stability.py`, "voxels of 16-bit floats".

    Raises:
        ValueError: for data that are not 3-D or 4-D, have an axis of one voxel or an unsupported type, or
            hold NaN, infinity or integers that no type holds exactly; for spacing that is not positive; for a
            direction whose columns are not of length 1 to 1e-4, or nearly lie in a plane; and for labels of
            another shape, or beyond int32.
    """

    # the engine packs voxels, finds ranges of blocks and differentiates by what it knows of this class
    subclass_instead: ClassVar[str] = "jaxvol.Field instead, and pass it as Volume(..., field=...)"

    data: Shaped[Array, "nx ny nz *c"]
    spacing: Float[Array, "3"]
    origin: Float[Array, "3"]
    direction: Float[Array, "3 3"] | None
    labels: Integer[Array, "nx ny nz"] | None
    label_ids: tuple[int, ...] | None = eqx.field(static=True)
    field: Field | None
    fetch: Fetch
    """Access to the voxels. Internal."""

    def __init__(
        self,
        data: Arrayable,
        spacing: Arrayable | None = None,
        origin: Arrayable | None = None,
        labels: Arrayable | None = None,
        *,
        direction: Arrayable | None = None,
        label_ids: Arrayable | None = None,
        field: Field | None = None,
    ):
        place: dict[str, Any] = {"data": data}
        if not isinstance(data, np.ndarray | jax.Array):
            from .._util.named_axes import object_arguments  # here, since most volumes are arrays

            place = object_arguments(data) or place
        self.data = voxel_array(place["data"])
        spacing = place.get("spacing", (1.0, 1.0, 1.0)) if spacing is None else spacing
        origin = place.get("origin", (0.0, 0.0, 0.0)) if origin is None else origin
        spacing = finite_array("spacing", spacing, (3,))
        self.spacing = require(spacing, lambda s: s > 0, "spacing must be positive; got {got}.")
        self.origin = finite_array("origin", origin, (3,))
        direction = place.get("direction") if direction is None else direction
        self.direction = None if direction is None else _checked_direction(direction)
        self.labels = None if labels is None else label_array(labels, self.data.shape[:3])
        self.label_ids = None if label_ids is None else integers("label_ids", label_ids)
        if not isinstance(field, Field | None):
            raise ValueError(f"field must be a jaxvol Field, or None; got {described(field)}.")
        self.field, self.fetch = field, OneByOne()

    def __repr__(self) -> str:
        if not is_concrete(self.data):
            return eqx.tree_pformat(self)
        data, place = np.asarray(self.data), ("spacing", "origin", "direction")
        parts = [f"{name}={pasted(getattr(self, name))}" for name in place if getattr(self, name) is not None]
        parts += [] if self.labels is None else [f"labels to {np.asarray(self.labels).max()}"]
        parts += [f"values {data.min():g} to {data.max():g}" if self.field is None else f"field={self.field}"]
        return f"<Volume shape={data.shape}, dtype={data.dtype}, {', '.join(parts)}>"

    def __getitem__(self, part: Any) -> "Volume":
        """The part of the volume in a slice such as `volume[10:90, :, ::2]` or `volume[..., :50]`, at its
        place in the world.

        Raises:
            ValueError: for an index that is no slice with a step above 0, fewer than two voxels along an
                axis, and a volume with a `field`.
        """
        indices = list(part) if isinstance(part, tuple) else [part]
        at = next((k for k, index in enumerate(indices) if index is ...), len(indices))
        indices[at : at + 1] = [slice(None)] * (3 - len(indices) + (at < len(indices)))
        if self.field is not None:
            raise ValueError("volume[a:b, c:d, e:f] is of voxels; this volume has a field.")
        try:
            slices = tuple(slice(*map(_index, (s.start, s.stop, s.step))) for s in indices)
            ranges = [range(n)[s] for n, s in zip(self.shape, slices, strict=True)]
        except (AttributeError, TypeError, ValueError) as fault:
            expected = "takes up to three slices of integers, with steps above 0, and an Ellipsis"
            raise ValueError(f"volume[a:b, c:d, e:f] {expected}; got {shortened(part)}.") from fault
        if any(len(r) < 2 or r.step < 1 for r in ranges):
            counts = tuple(len(r) if r.step > 0 else 0 for r in ranges)
            raise ValueError(
                f"volume[a:b, c:d, e:f] must leave 2 voxels or more along each axis, in order; "
                f"{shortened(part)} of {self.shape} leaves {counts}."
            )
        # in NumPy where numbers are known, which compiles nothing
        arrays = self.data, self.spacing, self.origin, self.direction, self.labels
        known: list[Any] = [np.asarray(array) if is_concrete(array) else array for array in arrays]
        data, spacing, origin, direction, labels = known
        start, step = (
            np.array([getattr(r, name) for r in ranges], spacing.dtype) for name in ("start", "step")
        )
        shift = spacing * start
        shift = shift if direction is None else (direction * shift[None, :]).sum(axis=1)
        labels = None if labels is None else labels[slices]
        place = spacing * step, origin + shift
        return Volume(data[slices], *place, labels, direction=direction, label_ids=self.label_ids)

    def crop(self, box: Arrayable) -> "Volume":
        """The smallest part of the grid that contains a world box, at its place in the world.

        Args:
            box: (x_min, x_max, y_min, y_max, z_min, z_max) in the world, as `bounds`.

        Returns:
            The `Volume`, cut between voxels.

        Raises:
            ValueError: for a box outside the volume, traced arguments, and the errors of slices.
        """
        if is_traced(box, self.origin, self.spacing, self.direction):
            raise ValueError("crop needs numbers; box or place is traced: call it outside of jax.jit.")
        ends = np.asarray(finite_array("box", box, (6,)), np.float64).reshape(3, 2)
        turn = np.eye(3) if self.direction is None else np.asarray(self.direction, np.float64)
        corners = np.array(np.meshgrid(*ends)).reshape(3, -1) - np.asarray(self.origin, np.float64)[:, None]
        at = np.linalg.solve(turn * np.asarray(self.spacing, np.float64), corners)
        first, end = np.floor(at.min(1) + PLACE), np.ceil(at.max(1) - PLACE) + 1
        misses = (at.max(1) < -PLACE) | (at.min(1) > np.array(self.shape) - 1 + PLACE)
        if misses.any() or (ends[:, 0] >= ends[:, 1]).any():
            bounds = pasted(self.bounds)
            expected = f"(x_min, x_max, y_min, …) that meets the volume, {bounds}"
            raise ValueError(f"box must be {expected}; got {pasted(ends.ravel())}.")
        low = np.clip(first, 0, np.array(self.shape) - 2).astype(int)
        high = np.maximum(end.astype(int), low + 2)
        return self[tuple(map(slice, low.tolist(), high.tolist()))]

    @property
    def valid(self) -> Any:
        """True if spacing is positive and direction not flat; both may be traced."""
        placed = (self.spacing > 0).all()
        if self.direction is None:
            return placed
        return placed & (abs(_determinant(self.direction)) > FLAT / 2)

    @property
    def shape(self) -> Any:
        """Number of nodes along x, y, z: three integers, traced in some kernels."""
        return self.fetch.shape(self.data)

    @property
    def channels(self) -> int:
        """Number of values at each point."""
        if self.field is None:
            return self.data.shape[3] if self.data.ndim > 3 else 1
        at = (jax.ShapeDtypeStruct((), self.spacing.dtype),) * 3
        answer = eqx.filter_eval_shape(Volume.value, self, at)
        numbers = answer if isinstance(answer, tuple) else (answer,)
        if not numbers or any(getattr(n, "shape", None) != () for n in numbers):
            kind = type(self.field).__name__
            raise ValueError(f"{kind}.value must return a number, or a tuple of numbers; got {answer}.")
        return len(numbers)

    @property
    def first(self) -> Vec3 | None:
        """The node at which `data` begins, in the type of `spacing`; None if `data` is the full grid."""
        if self.fetch.window is None:
            return None
        x, y, z = self.fetch.window.first.astype(self.spacing.dtype)
        return x, y, z

    def in_grid_order(self, of_data: Array) -> Array:
        """Move the last three axes of an array, in the order of `data`, into the order x, y, z."""
        if self.fetch.axes == XYZ:
            return of_data
        return jnp.moveaxis(of_data, (-3, -2, -1), tuple(axis - 3 for axis in self.fetch.axes))

    @property
    def frame(self) -> Frame:
        """The grid's axes."""
        return Frame() if self.direction is None else Frame.of(self.direction)

    @property
    def bounds(self) -> Float[Array, "6"]:
        """World extent (x_min, x_max, y_min, y_max, z_min, z_max) of the nodes."""
        xp, (origin, spacing, turn) = in_numpy(self.origin, self.spacing, self.direction)
        turn = np.eye(3, dtype=spacing.dtype) if turn is None else turn
        # extent of each axis of the data along the world's axes
        reach = turn * (self._steps * spacing)[None, :]
        ends = (origin + xp.sum(end(reach, 0), axis=1) for end in (xp.minimum, xp.maximum))
        return jnp.asarray(xp.stack(list(ends), axis=-1).reshape(-1), self.origin.dtype)

    @property
    def corners(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """World positions of the first and the last node."""
        xp, (origin, spacing, turn) = in_numpy(self.origin, self.spacing, self.direction)
        diagonal = self._steps * spacing
        if turn is not None:  # no matrix product, which some GPUs round to 10 bits
            diagonal = xp.sum(turn * diagonal[None, :], axis=1)
        return self.origin, jnp.asarray(origin + diagonal, self.origin.dtype)

    @property
    def _steps(self) -> Float[np.ndarray, "3"]:
        """Number of cells along x, y, z."""
        return np.asarray(self.shape, self.spacing.dtype) - 1

    @property
    def center(self) -> Float[Array, "3"]:
        """World position of the center of the grid."""
        _, (low, high) = in_numpy(*self.corners)
        return jnp.asarray((low + high) / 2, self.origin.dtype)

    def value(self, coordinate: Vec3) -> Voxel:
        """Value, or a tuple of channels, at a grid coordinate, in its float type; from `field` if set."""
        return self.interpolated(coordinate) if self.field is None else self.field.value(self, coordinate)

    def values(self, coordinate: Vec3) -> tuple[Scalar, ...]:
        """Values of all channels."""
        value = self.value(coordinate)
        return value if isinstance(value, tuple) else (value,)

    def interpolated(self, coordinate: Vec3) -> Voxel:
        """Trilinear interpolation of the voxels, or a tuple of channels, at a grid coordinate."""
        return self.fetch.interpolated(self.data, coordinate)

    def gradient(self, coordinate: Vec3) -> Vec3:
        """Gradient of the value along the grid axes, in value units per world length: interpolated central
        differences of the nodes, one-sided at the border, with an error of O(spacing²); for a `field`,
        differences of its values one node to either side, inside the grid."""
        central = self.field is None
        sx, sy, sz = self.fetch.slopes(self.data, coordinate) if central else self._field_slopes(coordinate)
        return sx / self.spacing[0], sy / self.spacing[1], sz / self.spacing[2]

    def label(self, coordinate: Vec3) -> Int[Array, ""]:
        """Label of the node nearest to a grid coordinate; half-way between two nodes, the upper one."""
        return self.label_at(flat_index(nearest_node(coordinate, self.shape), self.shape))

    def label_at(self, place: Int[Array, ""]) -> Int[Array, ""]:
        """Label of a node, by its index into the flattened labels."""
        return gather(self._labels().reshape(-1), place).astype(jnp.int32)

    def label_share(self, coordinate: Vec3, label: int) -> Scalar:
        """Trilinear interpolation of the indicator of a label: 1 at its nodes, 0 at others."""
        labels, share = self._labels().reshape(-1), jnp.zeros_like(coordinate[0])
        for index, weight in corners(coordinate, self.shape):
            share = share + weight * (gather(labels, index) == label).astype(share.dtype)
        return share

    def _labels(self) -> Integer[Array, "nx ny nz"]:
        if self.labels is None:
            raise ValueError("labels are needed here, but volume has none; pass Volume(..., labels=...).")
        return self.labels

    def _field_slopes(self, coordinate: Vec3) -> Vec3:
        def slope(axis: int) -> Scalar:
            last = self.shape[axis] - 1
            before, after = (jnp.clip(coordinate[axis] + side, 0, last) for side in (-1, 1))
            rise = self.value(_with(coordinate, axis, after)) - self.value(_with(coordinate, axis, before))
            # at least half a node apart unless the coordinate is more than half a node outside the grid
            return rise / jnp.maximum(after - before, 0.5)

        return slope(0), slope(1), slope(2)


def check_one_channel(volume: Volume, use: str) -> None:
    """Raise `ValueError` for a volume of several channels."""
    if (channels := volume.channels) > 1:
        raise ValueError(f"volume must have one channel for {use}; got one of {channels}.")


def _checked_direction(direction: Arrayable) -> Float[Array, "3 3"] | None:
    """The direction, checked; None for a known identity."""
    turn = require(
        finite_array("direction", direction, (3, 3)),
        lambda d: (abs((d * d).sum(0) - 1) < 2e-4).all() & (abs(_determinant(d)) > FLAT),
        "direction must be a 3 x 3 matrix of columns of length 1 that do not lie in a plane; got {got}.",
    )
    return None if not is_traced(turn) and np.array_equal(turn, np.eye(3)) else turn


def _determinant(turn: Any) -> Any:
    (x, y, z), after, before = turn.T, np.array([1, 2, 0]), np.array([2, 0, 1])
    return (x * (y[after] * z[before] - y[before] * z[after])).sum()


def _with(coordinate: Vec3, axis: int, component: Scalar) -> Vec3:
    x, y, z = (component if i == axis else c for i, c in enumerate(coordinate))
    return x, y, z


def grids(volume: Volume) -> list[Volume]:
    """The volume itself and all volumes inside its field."""
    leaves = jax.tree.leaves(volume.field, is_leaf=_is_volume)
    return [volume, *(grid for leaf in leaves if _is_volume(leaf) for grid in grids(leaf))]


def voxels_of(volume: Volume) -> tuple[Any, ...]:
    """The voxels of all `grids`."""
    return tuple(grid.data for grid in grids(volume))


def without_voxels(volume: Volume) -> Volume:
    return with_voxels(volume, (None,) * len(grids(volume)))


def with_voxels(volume: Volume, data: Sequence[Any]) -> Volume:
    """The volume with other voxels in its `grids`."""
    return eqx.tree_at(lambda v: [grid.data for grid in grids(v)], volume, list(data), is_leaf=is_none)


def _is_volume(node: Any) -> bool:
    return isinstance(node, Volume)


def part_of(
    volume: Volume, first: Int[Array, "3"], nodes: tuple[int, int, int], axes: Axes | None = None
) -> Volume:
    """The volume as the `Window` of a grid of `nodes` that begins at the node `first`, with the grid's
    place; by default with unchanged `axes`."""
    window = Window(first, nodes, volume.fetch.axes if axes is None else axes)
    return eqx.tree_at(lambda v: v.fetch.window, volume, window, is_leaf=is_none)


def read_as(volume: Volume, *fetches: Fetch | None) -> Volume:
    """The volume with new fetches of its `grids`, in the same windows; None keeps the old one."""
    windowed = [
        old if new is None else eqx.tree_at(lambda f: f.window, new, old.window, is_leaf=is_none)
        for old, new in zip(fetches_of(volume), fetches, strict=True)
    ]
    return with_fetches(volume, windowed)


def with_fetches(volume: Volume, fetches: list[Fetch]) -> Volume:
    """The volume with new fetches of its `grids`."""
    return eqx.tree_at(
        lambda v: [grid.fetch for grid in grids(v)],
        volume,
        fetches,
        is_leaf=lambda leaf: isinstance(leaf, Fetch),
    )


def fetches_of(volume: Volume) -> list[Fetch]:
    return [grid.fetch for grid in grids(volume)]


def _index(bound: Any) -> int | None:
    return None if bound is None else operator.index(bound)
