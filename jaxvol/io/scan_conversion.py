"""Resamples what a swept probe acquired onto a Cartesian grid, which other programs read.

Rendering under a `ToroidalMap` needs no such conversion.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from .._util.checks import Arrayable, described, finite_array, integer, require
from .._util.files import MOST_VOXELS
from .._util.memory import require_room
from .._util.vec3 import Scalar, apart
from ..march.march import March
from ..march.transforms import ToroidalMap
from ..scene.volume import Volume
from ..xla.platform import is_traced


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

    **Arguments:**

    - `volume`: as acquired, `data[β, σ, γ]`. Its labels, if any, become those of the nearest sample, and 0
      outside.
    - `probe`: the map that places the samples; the result lies in the same world.
    - `spacing`: of the grid, one number or three, world length (mm); by default the distance between the
      samples of a beam, as fine as they are anywhere.
    - `shape`, `origin`: number of nodes along x, y, z, at least 2, and the world position of the first node;
      by default those of the grid that just encloses the sector, centered on it.
    - `fill_value`: value outside the swept sector, as SciPy's and SimpleITK's: by default 0, no echo.

    **Returns:** a `Volume` with its spacing and origin. A grid node within rounding of a face counts as
    inside.

    Beside the result, memory is taken for one plane of nodes at a time; and then on the host, where a result
    of floats is checked to be finite, for as much as it takes itself and a byte a node.

    Differentiable with respect to float voxels and to the probe. For the probe, the grid must be given
    (`spacing`, `shape` and `origin`), since its size cannot depend on traced values; where a node crosses a
    face its value jumps, which the gradient does not see.

    **Raises:** `ValueError` for arguments of other kinds, a spacing that is not positive, a grid of 2**31
    nodes or more or larger than the device's memory, and a `fill_value` that the voxels' type does not hold.
    """
    if not isinstance(volume, Volume):
        raise ValueError(f"volume must be a Volume; got {described(volume)}.")
    if not isinstance(probe, ToroidalMap):
        raise ValueError(f"probe must be a ToroidalMap; got {described(probe)}.")
    fill = _fill(fill_value, volume.data.dtype)
    first, last = probe.gamma_range
    wide: Any = (last - first) / (volume.shape[2] - 1) if spacing is None else spacing
    steps = require(
        finite_array("spacing", [wide] * 3 if np.ndim(wide) == 0 else wide, (3,)),
        lambda steps: steps > 0,
        "spacing must be positive along every axis; got {got}.",
    )
    nodes, first = _grid(probe, steps, shape, origin)
    itemsize = volume.data.dtype.itemsize + (0 if volume.labels is None else volume.labels.dtype.itemsize)
    require_room(
        math.prod(nodes) * itemsize, f"a grid of {' x '.join(map(str, nodes))} nodes (spacing, shape)"
    )
    data, labels = _resampled(volume, probe, first, steps, nodes, fill)
    return Volume(data, steps, first, labels)


@eqx.filter_jit
def _resampled(
    volume: Volume,
    probe: ToroidalMap,
    origin: Float[Array, "3"],
    spacing: Float[Array, "3"],
    shape: tuple[int, int, int],
    fill: float,
) -> tuple[Shaped[Array, "nx ny nz"], Shaped[Array, "nx ny nz"] | None]:
    """Voxels and labels at the nodes, plane by plane."""
    space = March(1.0, (probe,)).locate(volume)
    x, y, z = (
        first + jnp.arange(n, dtype=first.dtype) * step
        for first, n, step in zip(apart(origin), shape, apart(spacing), strict=True)
    )
    # the rounding of a face's place, in nodes
    slack = [64 * float(jnp.finfo(y.dtype).eps) * n for n in volume.shape]
    dtype = volume.data.dtype

    def node(x: Scalar, y: Scalar, z: Scalar) -> tuple[Array, Array | None]:
        at = space.coordinate((x, y, z))
        inside = jnp.array(True)
        for c, n, more in zip(at, volume.shape, slack, strict=True):
            inside = inside & (c >= -more) & (c <= n - 1 + more)
        value = jnp.where(inside, volume.value(at), fill)
        value = (jnp.rint(value) if dtype.kind in "ui" else value).astype(dtype)
        if volume.labels is None:
            return value, None
        return value, jnp.where(inside, volume.label(at), 0).astype(volume.labels.dtype)

    @jax.checkpoint  # else a gradient keeps the coordinates of all planes
    def plane(x: Scalar) -> tuple[Array, Array | None]:
        return jax.vmap(jax.vmap(node, (None, None, 0)), (None, 0, None))(x, y, z)

    return jax.lax.map(plane, x)


def _fill(value: Any, kind: np.dtype) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as fault:
        raise ValueError(f"fill_value must be a number; got {described(value)}.") from fault
    whole = kind.kind in "ui"
    limits = np.iinfo(kind) if whole else jnp.finfo(kind)
    if not float(limits.min) <= number <= float(limits.max) or (whole and not number.is_integer()):
        raise ValueError(f"fill_value must be a value of the voxels' type, {kind.name}; got {value!r}.")
    return number


def _grid(
    probe: ToroidalMap, spacing: Float[Array, "3"], shape: Any, origin: Arrayable | None
) -> tuple[tuple[int, int, int], Float[Array, "3"]]:
    """Number of nodes along each axis, and the place of the first one."""
    if shape is None:
        if is_traced(probe, spacing):
            raise ValueError(
                "shape, spacing and origin must be given where the probe is traced: the size of the grid "
                "cannot depend on it. Take those of a scan_convert outside of the transformation."
            )
        low, high = (np.asarray(corner, np.float64) for corner in probe.corners)
        # a sector that is a whole number of spacings wide gets no further node from rounding
        wide = np.ceil((high - low) / np.asarray(spacing, np.float64) - 1e-4)
        shape = [int(min(n, MOST_VOXELS)) + 1 for n in np.maximum(wide, 1)]
    if not isinstance(shape, tuple | list) or len(shape) != 3:
        raise ValueError(f"shape must be three numbers of nodes, along x, y and z; got {shape!r}.")
    nodes = nx, ny, nz = tuple(integer("shape", n, 2) for n in shape)
    if math.prod(nodes) > MOST_VOXELS:
        raise ValueError(
            "spacing must be so wide, or shape so small, that the grid has fewer than 2**31 nodes; got "
            f"{nodes}."
        )
    if origin is None:
        return (nx, ny, nz), probe.center - (jnp.asarray(nodes, spacing.dtype) - 1) * spacing / 2
    return (nx, ny, nz), finite_array("origin", origin, (3,))
