"""How many steps long may a cell be? As many as the scene lets it be, for a tolerated error of the image."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Int32

from ..._util.checks import number, power_of_two
from ..._util.vec3 import Scalar
from ...scene.occupancy import BLOCK, with_neighbours
from ...scene.space import Ray, Space, node_distance
from ...scene.variation import MARGIN, Variation, Windows
from ...xla.memory import gather, in_memory
from ..march import March
from ..strides import RUN, Run, StrideControl


SHARE = 1 / 20
"""Ratio of an image's error to the greatest e of a block (`AdaptiveSampling`), as measured by
`experiments.adaptive_error`."""

HIDDEN = 1 / 4
"""The same ratio for h, whose errors have one sign along a ray."""

FARTHEST = 8
"""Blocks around its own that a run may touch."""


class AdaptiveSampling(StrideControl):
    """Cells of 1, 2, 4, … steps: as long as what is predicted of their error stays below `tolerance`.

    Of a block of 4³ voxels, and up to two nodes around it, take (`variation.Windows`, `variation.Variation`)

    - ℓ, the side of the block;
    - R, the range of its values, and H, their greatest second difference, per length²;
    - V, the total change of extinction and emission while the value passes through R once; C, the part of V
      that is due to the colour; D, which is C times the extinction;
    - K, the sum of all changes of their slopes over the value.

    Between the ends of a cell of width w the value leaves the straight line by about δ = H w² / 8. Then the
    optical depth along the block is wrong by about

        e = ℓ V min(1, δ / R) + q

    where q is what the quadrature errs by where the value is linear: 0 for `"preintegrated"`; V w / 2 for
    `"left"`; and for `"midpoint"` K (R / ℓ) w² / 24, since it errs where emission bends, or V w / 2 where
    that is less. The front of a cell hides of its back, in colour, at most h = min(C, D w) w / 8. Cells come
    in runs of four that are equally long: as long as T max(e / 20, h / 4) is at most `tolerance`, with the
    largest e and h of the blocks that may hold a part of the run, and T the transmittance in front of it.

    **It is an estimate, not a bound**, of the RMSE of the image's colours, calibrated on five scenes
    (`experiments.adaptive_error`), without light. No cell is shorter than a step: an eighth of a voxel suits
    tolerances of 0.001, a quarter larger ones; `quadrature="left"` may need less. `Rendering.error` is the
    root of the summed squares of a ray's runs, and exceeds the tolerance where a step is too long. On CPU it
    is faster only where rays take many samples (`experiments/results/README.md`).

    All cells are one step long, and `Rendering.error` is infinite, for modes other than "over", and for
    transfer functions that do not say how they vary, such as `LabelTransferFunction`.

    Args:
        tolerance: of the image's RMSE, > 0. It may be traced.
        longest: length of the longest cell, in steps of the march; a power of two up to 64.

    Under jitter, each ray's runs begin at a random depth, too. Strides, and `Rendering.error`, are constants
    to derivatives, and the image jumps where a stride changes: compare gradients with finite differences
    without this transform, and search along lines with care.

    Where it fails: `experiments/stability.py`, "tolerances finer than the finest cell",
    "adaptive strides under light".

    Raises:
        ValueError: for another tolerance or `longest`.

    Source: unpublished.
    """

    tolerance: Float[Array, ""]
    longest: int = eqx.field(static=True)
    errors: Int32[Array, "levels bx by bz"] | None
    """Predicted error by stride and block, `_coded` as integers, which have no gradient; None before the
    scene is known."""
    first: Int[Array, "3"] | None
    """Index of the first block, where only a part of the volume is known."""

    def __init__(self, tolerance: Any, longest: int | Any = 8):
        self.tolerance = number("tolerance", tolerance, above=0)
        self.longest = power_of_two("longest", longest, 64)
        self.errors = self.first = None

    def prepared(
        self, march: March, space: Space, windows: Windows, variation: Variation
    ) -> "AdaptiveSampling":
        # in a branch of its own, so that it is rounded alike in every program, and strides are the same
        predict = partial(_errors, self.longest)
        found = in_memory(march.step > 0, predict, march, space, windows, variation), windows.first
        return eqx.tree_at(lambda of: (of.errors, of.first), self, found, is_leaf=lambda leaf: leaf is None)

    def error(self, ray: Ray, run: Run) -> Scalar:
        assert self.errors is not None
        _, nx, ny, nz = self.errors.shape
        begin = (0, 0, 0) if self.first is None else self.first
        # the window of the block that holds the middle holds all of the run
        i, j, k = (
            jnp.clip(jnp.floor(c / BLOCK).astype(jnp.int32) - first, 0, n - 1)
            for c, n, first in zip(ray.path(run.middle), (nx, ny, nz), begin, strict=True)
        )
        level = run.stride.bit_length() - 1
        code = gather(self.errors.reshape(-1), ((level * nx + i) * ny + j) * nz + k)
        return jax.lax.bitcast_convert_type(code, jnp.float32).astype(ray.length.dtype)


def _coded(error: Float[Array, "*blocks"]) -> Int32[Array, "*blocks"]:
    """An error as the bits of a float32, which are in the same order. NaN is infinite."""
    known = jnp.where(error >= 0, error, jnp.inf).astype(jnp.float32)
    return jax.lax.bitcast_convert_type(known, jnp.int32)


def _errors(
    longest: int, march: March, space: Space, windows: Windows, variation: Variation
) -> Int32[Array, "levels bx by bz"]:
    """By stride and block, the coded error of a run whose middle lies there."""
    dtype = march.step.dtype
    low, high, bend, variation = jax.tree.map(
        lambda leaf: leaf.astype(dtype), (windows.low, windows.high, windows.bend, variation)
    )
    distance = node_distance(space, low.shape, windows.first).astype(dtype)
    spread, length, shortest = high - low, BLOCK * distance, BLOCK * _shortest(space, windows, distance)
    levels = []
    for stride in (2**k for k in range(longest.bit_length())):
        width = stride * march.step
        bent = bend * (width / distance) ** 2 / 8
        error = length * variation.total * jnp.where(bent >= spread, 1, bent / spread)
        if not march.integrates:
            sampled = width * variation.total / 2
            if march.quadrature == "midpoint":
                # NaN where there is a step, but no spread
                turned = variation.turns * (spread / length) * width**2 / 24
                sampled = jnp.where(turned < sampled, turned, sampled)
            error = error + sampled
        # a window exceeds its block by half of one, and each block around it by one more
        reach = RUN * width / 2 / shortest
        rounds = jnp.maximum(jnp.ceil(reach - MARGIN / BLOCK), 0)
        # a cell's front hides its back
        hidden = jnp.minimum(variation.hidden * width, variation.colored) * width / 8
        code = _coded(jnp.maximum(SHARE * error, HIDDEN * hidden))
        number = jnp.minimum(rounds, FARTHEST).astype(jnp.int32)
        code = jax.lax.fori_loop(0, number, lambda _, code: with_neighbours(code, jnp.maximum), code)
        levels.append(jnp.where(rounds <= FARTHEST, code, _coded(jnp.asarray(jnp.inf))))
    return jnp.stack(levels)


def _shortest(space: Space, windows: Windows, distance: Float[Array, "bx by bz"]) -> Scalar:
    """The least distance between nodes in all of the grid, of which the windows may cover a part."""
    if windows.whole is None:
        return jnp.min(distance)
    bx, by, bz = windows.whole
    zero = jnp.zeros((), jnp.int32)
    layers = jax.lax.map(
        lambda x: jnp.min(node_distance(space, (1, by, bz), jnp.stack([x, zero, zero]))), jnp.arange(bx)
    )
    return jnp.min(layers).astype(distance.dtype)
