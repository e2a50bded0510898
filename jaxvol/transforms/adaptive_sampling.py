"""How many steps long may a cell be? As many as the scene lets it be, for a tolerated error of the image."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from .._util.checks import integer, number
from .._util.vec3 import Scalar, Vec3
from .._util.xla import gather, in_memory
from ..march import March, Transform
from ..occupancy import BLOCK
from ..space import Ray, Space
from ..variation import Variation, Windows


SHARE = 1 / 20
"""What a block's predicted error is worth in the image: errors of a ray's cells have either sign, most are
much smaller than predicted, and what lies in front hides them. Measured: `experiments.accuracy`."""

FARTHEST = 8
"""Blocks around its own that a stretch may touch: it is at most 17 blocks long."""


class AdaptiveSampling(Transform):
    """Cells of 1, 2, 4, … steps: as long as what is predicted of their error stays below `tolerance`.

    Where the value bends little between nodes, or the transfer function changes little with it, a long cell
    is as good as several short ones. Take a block of 4³ voxels, of side ℓ, whose values, with those up to two
    nodes around it, range over R, with second differences of at most H (per length²). Between the ends of a
    cell of width w the value leaves the straight line by at most δ = H w² / 8. While it runs through R once,
    extinction and emission change by V in total, and their slopes by K (`variation.Variation`). Then the
    optical depth of a stretch as long as the block is wrong by about

        e = ℓ V min(1, δ / R) + q

    where q is what the quadrature errs by where the value is linear: 0 for `"preintegrated"`; V w / 2 for
    `"left"`; and for `"midpoint"` K (R / ℓ) w² / 24, since it errs where a cell crosses a control point, or
    V w / 2 where that is less. All cells of a stretch of `longest` steps are equally long: as long as e / 20
    is at most `tolerance` in all blocks that may hold a part of it.

    **It is an estimate, not a bound**: of the RMSE of the image's colours, calibrated on five scenes
    (`experiments.accuracy`). It knows neither what is hidden by what lies in front nor how light varies along
    a cell. Cells are never shorter than a step: choose the step for the finest detail, half or a quarter of a
    voxel, and `longest` so that a stretch is about four voxels long: of longer ones less is known.

    **It saves samples, and as yet no time**: on CPU a sample takes about twice as long, since where it lies
    must be looked up first, so that uniform steps of the same error are somewhat faster in all five scenes.

    For modes that do not composite "over", and for transfer functions that do not say how they vary, all
    cells are one step long.

    **Arguments:**

    - `tolerance`: of the image's RMSE, > 0. It may be traced: images of any tolerance are made by one
      program.
    - `longest`: the most steps of a cell, a power of two up to 64.

    What is known of the voxels is computed once for each array of them. Which cells may be long follows from
    the transfer function in each image, inside `jax.jit`, too. Strides are constants to derivatives; the
    image jumps where one changes.

    **Raises:** `ValueError` for another tolerance or `longest`.

    Source: unpublished.
    """

    tolerance: Float[Array, ""]
    longest: int = eqx.field(static=True)
    strides: UInt8[Array, "bx by bz"] | None
    """By block, the most steps of a cell; None before the scene is known."""

    def __init__(self, tolerance: Any, longest: int | Any = 8):
        self.tolerance = number("tolerance", tolerance, above=0)
        self.longest = integer("longest", longest, 1, 64)
        if self.longest & (self.longest - 1):
            raise ValueError(f"longest must be a power of two; got {longest!r}.")
        self.strides = None

    @property
    def longest_stride(self) -> int:
        return self.longest

    def prepared(
        self, march: March, space: Space, windows: Windows, variation: Variation
    ) -> "AdaptiveSampling":
        # In a branch of its own, so that it is rounded alike in every program: an error that nearly equals
        # the tolerance must not make different cells where an image is made in `jax.jit`, or differentiated.
        strides = in_memory(march.step > 0, _strides, self, march, space, windows, variation)
        return eqx.tree_at(lambda of: of.strides, self, strides, is_leaf=lambda leaf: leaf is None)

    def stride(self, ray: Ray, depth: Scalar, step: Scalar) -> Int[Array, ""]:
        # the window around the middle of the stretch holds all of it
        return self._at(ray.path(depth + self.longest / 2 * step))

    def _at(self, coordinate: Vec3) -> Int[Array, ""]:
        """The most steps of a cell in the block of a grid coordinate."""
        assert self.strides is not None
        _, ny, nz = shape = self.strides.shape
        i, j, k = (
            jnp.clip(jnp.floor(c / BLOCK), 0, n - 1).astype(jnp.int32)
            for c, n in zip(coordinate, shape, strict=True)
        )
        return gather(self.strides.reshape(-1), (i * ny + j) * nz + k).astype(jnp.int32)


def _strides(
    sampling: AdaptiveSampling, march: March, space: Space, windows: Windows, variation: Variation
) -> UInt8[Array, "bx by bz"]:
    """By block, the most steps of a cell whose error is tolerated."""
    dtype = march.step.dtype
    windows, variation = jax.tree.map(lambda leaf: leaf.astype(dtype), (windows, variation))
    distance = _node_distance(space, windows.low.shape).astype(dtype)
    spread, length = windows.high - windows.low, BLOCK * distance
    strides = jnp.ones(windows.low.shape, jnp.uint8)
    for stride in (2**k for k in range(1, sampling.longest.bit_length())):
        width = stride * march.step
        bent = windows.bend * (width / distance) ** 2 / 8
        # where the bend is NaN, so is the error, and no cell fits
        error = length * variation.total * jnp.where(bent >= spread, 1, bent / spread)
        if not march.integrates:
            sampled = width * variation.total / 2
            if march.quadrature == "midpoint":
                turned = variation.turns * (spread / length) * width**2 / 24
                sampled = jnp.minimum(turned, sampled)
            error = error + sampled
        fits = (SHARE * error <= sampling.tolerance) & (strides == stride // 2)
        strides = jnp.where(fits, stride, strides).astype(jnp.uint8)
    # a window holds a stretch as long as a block, and each block around it two more
    reach = jnp.max(sampling.longest * march.step / length)
    rounds = jnp.ceil((reach - 1) / 2)
    strides = jax.lax.fori_loop(0, jnp.clip(rounds, 0, FARTHEST).astype(jnp.int32), _eroded, strides)
    return jnp.where(rounds <= FARTHEST, strides, 1).astype(jnp.uint8)


def _eroded(_: Any, strides: UInt8[Array, "bx by bz"]) -> UInt8[Array, "bx by bz"]:
    """The least of each block and all around it."""
    for axis in range(3):
        ends = [(1, 1) if i == axis else (0, 0) for i in range(3)]
        padded, n = jnp.pad(strides, ends, mode="edge"), strides.shape[axis]
        for first in (0, 2):
            strides = jnp.minimum(strides, jax.lax.slice_in_dim(padded, first, first + n, axis=axis))
    return strides


def _node_distance(space: Space, shape: tuple[int, ...]) -> Float[Array, "bx by bz"]:
    """By block, the least world distance between neighbouring nodes, in its middle."""
    middle = [BLOCK * (jnp.arange(n, dtype=space.middle[0].dtype) + 0.5) for n in shape]

    def least(x: Scalar, y: Scalar, z: Scalar) -> Scalar:
        along = jax.jacfwd(lambda at: jnp.stack(space.point((at[0], at[1], at[2]))))(jnp.stack([x, y, z]))
        return jnp.sqrt(jnp.min(jnp.sum(along * along, axis=0)))

    return jnp.vectorize(least)(*jnp.meshgrid(*middle, indexing="ij"))
