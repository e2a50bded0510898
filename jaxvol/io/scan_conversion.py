"""Resamples what a swept probe acquired onto a Cartesian grid, which other programs read. Rendering under a
`ToroidalMap` needs no such conversion."""

import math
from typing import Any

import equinox as eqx
import numpy as np

from .._util.checks import Arrayable, described, finite_array, integer, require
from .._util.files import MOST_VOXELS
from .._util.memory import require_room
from ..march.transforms import ToroidalMap
from ..scene.volume import Volume, check_one_channel


def scan_convert(
    volume: Volume | Any,
    probe: ToroidalMap | Any,
    spacing: Arrayable | None = None,
    *,
    shape: tuple[int, int, int] | Any | None = None,
    origin: Arrayable | None = None,
    fill_value: float | Any = 0,
) -> Volume:
    """Resample an ultrasound volume as acquired onto a Cartesian grid in the world of its probe.

    The value of a node is the trilinear interpolation of the acquired samples, in (β, σ, γ), at the place
    where the map puts it: exact for values linear in these between samples, and rounded to the type of the
    volume's voxels; convert them to float32 first to keep fractions. Interpolating once more between the
    nodes, as rendering does, blurs what is smaller than the spacing, and mixes `fill_value` into the sector's
    faces, over one spacing. What it does to images: `experiments/scan_conversion.py`.

    It has no derivatives, and takes memory for the result and for one plane of nodes at a time.

    Args:
        volume: as acquired, `data[β, σ, γ]`, without labels (convert a volume of these).
        probe: the map that places the samples; the result lies in the same world.
        spacing: of the grid, one number or three, world length (mm); by default the distance between the
            samples of a beam, as fine as they are anywhere.
        shape: number of nodes along x, y, z, at least 2; by default those that just enclose the sector.
        origin: the world position of the first node; by default such that the sector is in the middle.
        fill_value: value outside the swept sector, as SciPy's and SimpleITK's: by default 0, no echo.

    Returns:
        A `Volume` with its spacing and origin. Nodes within rounding of a face count as inside.

    Raises:
        ValueError: for arguments of other kinds, a spacing that is not positive, a grid of 2**31 nodes or
            more or larger than the device's memory, and a `fill_value` that the voxels' type does not hold.
    """
    from scipy.ndimage import map_coordinates  # here, so that a first image does not wait for it

    if not isinstance(volume, Volume) or volume.labels is not None:
        raise ValueError(f"volume must be a Volume without labels; got {described(volume)}.")
    check_one_channel(volume, "scan_convert")
    if volume.direction is not None:
        raise ValueError("volume must have no direction: ToroidalMap places its voxels by the probe.")
    if not isinstance(probe, ToroidalMap):
        raise ValueError(f"probe must be a ToroidalMap; got {described(probe)}.")
    data, fill = np.asarray(volume.data), np.asarray(fill_value)
    is_whole, limits = data.dtype.kind in "iu", (0, 0)
    if is_whole:
        limits = np.iinfo(data.dtype).min, np.iinfo(data.dtype).max
    is_held = fill.dtype.kind in "iuf" and fill.ndim == 0
    if not is_held or (is_whole and not (limits[0] <= fill <= limits[1] and fill % 1 == 0)):
        raise ValueError(f"fill_value must be of the voxels' type, {data.dtype.name}; got {fill_value!r}.")
    ends, last = np.array([np.asarray(each, float) for each in probe.ranges]), np.array(data.shape) - 1
    low, high = (np.asarray(corner, float) for corner in probe.corners)
    wide = (ends[2, 1] - ends[2, 0]) / last[2] if spacing is None else spacing
    given = finite_array("spacing", [wide] * 3 if np.ndim(wide) == 0 else wide, (3,))
    steps = require(given, lambda steps: steps > 0, "spacing must be positive along every axis; got {got}.")
    steps = np.asarray(steps, float)
    if shape is None:  # a sector that is a whole number of spacings wide gets no further node from rounding
        shape = np.minimum(np.maximum(np.ceil((high - low) / steps - 1e-4), 1) + 1, MOST_VOXELS).tolist()
    if not isinstance(shape, tuple | list) or len(shape) != 3:
        raise ValueError(f"shape must be three numbers of nodes, along x, y and z; got {shape!r}.")
    nodes = tuple(integer("shape", int(n) if n == int(n) else n, 2) for n in shape)
    if math.prod(nodes) > MOST_VOXELS:
        raise ValueError(f"spacing and shape must make a grid of fewer than 2**31 nodes; got {nodes}.")
    sizes = " x ".join(map(str, nodes))
    require_room(math.prod(nodes) * data.itemsize, f"a grid of {sizes} nodes (spacing, shape)")
    middle = (low + high) / 2 - (np.array(nodes) - 1) * steps / 2
    first = middle if origin is None else np.asarray(finite_array("origin", origin, (3,)), float)
    x, y, z = (start + step * np.arange(n) for start, step, n in zip(first, steps, nodes, strict=True))
    slack = 1e-5 * (last + 1)  # the rounding of a face's place, in samples
    found, forward = np.full(nodes, fill, data.dtype), eqx.filter_jit(ToroidalMap.to_toroidal)
    for plane, here in zip(found, x, strict=True):
        points = np.stack(np.broadcast_arrays(here, y[:, None], z), axis=-1)
        at = (np.asarray(forward(probe, points), float) - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) * last
        inside = np.all((at >= -slack) & (at <= last + slack), axis=-1)
        values = map_coordinates(data, np.clip(at[inside], 0, last).T, float, order=1)
        plane[inside] = np.rint(values) if is_whole else values
    return Volume(found, steps, first)
