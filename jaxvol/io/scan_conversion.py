"""Scan conversion: resampling of swept ultrasound volumes onto a Cartesian grid, for other programs.
Rendering under a `ToroidalMap` needs none."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from .._util.checks import Arrayable, described, finite_array, integer, require
from .._util.files import MOST_VOXELS
from .._util.image_record import holds
from .._util.memory import require_room
from ..march.transforms.toroidal_map import ToroidalMap
from ..scene.volume import Volume, check_one_channel


def scan_convert(
    volume: Volume,
    probe: ToroidalMap,
    spacing: Arrayable | None = None,
    *,
    shape: Sequence[int] | None = None,
    origin: Arrayable | None = None,
    fill_value: float = 0,
) -> Volume:
    """Resample an ultrasound volume as acquired onto a Cartesian grid in the world of its probe.

    The value of a node is the trilinear interpolation of the acquired samples in (β, σ, γ), rounded to the
    type of the volume's voxels (convert them to float32 first to keep fractions). Interpolating once more
    between the nodes, as rendering does, blurs details smaller than the spacing, and mixes `fill_value` into
    the sector's faces, over one spacing; `experiments/scan_conversion.py` measures the effect on images.

    The result has no derivatives. Memory is needed for it and for one plane of nodes.

    Args:
        volume: as acquired, `data[β, σ, γ]`, without labels (convert a volume of the labels).
        probe: the map that places the samples; the result lies in the same world.
        spacing: of the grid, one number or three, world length (mm); by default the distance between the
            samples of a beam, which is their minimum distance.
        shape: number of nodes along x, y, z, at least 2; by default just enough to enclose the sector.
        origin: the world position of the first node; by default the sector is centred.
        fill_value: value outside the swept sector, as SciPy's and SimpleITK's: by default 0, no echo.

    Returns:
        A `Volume` with its spacing and origin. Nodes within rounding of a face count as inside.

    Raises:
        ValueError: for arguments of other types, a spacing that is not positive, a grid of 2**31 nodes or
            more or larger than the device's memory, and a `fill_value` that the voxels' type cannot hold.
    """
    from scipy.ndimage import map_coordinates  # slow to import

    if not isinstance(volume, Volume) or volume.labels is not None:
        raise ValueError(f"volume must be a Volume without labels; got {described(volume)}.")
    check_one_channel(volume, "scan_convert")
    if volume.direction is not None:
        raise ValueError("volume must have no direction: ToroidalMap places its voxels by the probe.")
    if not isinstance(probe, ToroidalMap):
        raise ValueError(f"probe must be a ToroidalMap; got {described(probe)}.")
    data, fill = np.asarray(volume.data), np.asarray(fill_value)
    is_whole = data.dtype.kind in "iu"
    is_number = fill.dtype.kind in "iuf" and fill.ndim == 0
    if not is_number or (is_whole and not holds(data.dtype, fill.item())):
        raise ValueError(f"fill_value must be of the voxels' type, {data.dtype.name}; got {fill_value!r}.")
    ends, last = np.array([np.asarray(ends, float) for ends in probe.ranges]), np.array(data.shape) - 1
    low, high = (np.asarray(corner, float) for corner in probe.corners)
    step = (ends[2, 1] - ends[2, 0]) / last[2] if spacing is None else spacing
    steps = finite_array("spacing", [step] * 3 if np.ndim(step) == 0 else step, (3,))
    steps = require(steps, lambda steps: steps > 0, "spacing must be positive along every axis; got {got}.")
    steps = np.asarray(steps, float)
    if shape is None:  # 1e-4: rounding must not add a node to a sector of a whole number of spacings
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
    slack = 1e-5 * (last + 1)  # rounding error of a face's position, in samples
    grid, forward = np.full(nodes, fill, data.dtype), eqx.filter_jit(ToroidalMap.to_toroidal)
    for plane, plane_x in zip(grid, x, strict=True):
        points = np.stack(np.broadcast_arrays(plane_x, y[:, None], z), axis=-1)
        at = (np.asarray(forward(probe, points), float) - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) * last
        inside = np.all((at >= -slack) & (at <= last + slack), axis=-1)
        values = map_coordinates(data, np.clip(at[inside], 0, last).T, float, order=1)
        plane[inside] = np.rint(values) if is_whole else values
    return Volume(grid, steps, first)
