"""The first crossing of a ray with an isosurface."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.checks import Arrayable, number
from .._util.vec3 import Scalar, Vec3
from ..march.march import March, within
from ..march.transforms.alpha_correction import AlphaCorrection
from ..scene.occupancy import Blocks
from ..scene.transfer import Classify, Measured, Transfer
from ..scene.volume import Volume
from .blending import Fragment, Outputs
from .selection import RaySampler, Selection


class Crossing(NamedTuple):
    """Ends of the first cell that crosses the value, infinite if there is none; `rises`: towards the back."""

    front: Scalar
    back: Scalar
    rises: Bool[Array, ""]


class Isosurface(Selection[Crossing]):
    """The first crossing of a ray with an isosurface: opaque, in the transfer function's colour of the value,
    shaded by the lighting, if there is one.

    A cell contains the surface if the field is below the value at exactly one of its ends. Bisection finds
    the root of the interpolated field along the ray, up to the rounding of depths (some 10⁻⁴ of a voxel in
    float32 and grids of 256³ voxels). The volume's faces are no surface. `Rendering.depth` is the depth of
    the root, `Rendering.normal` the unit vector -∇v / |∇v| there, which points to lower values; ∇v is
    `Volume.gradient`, with an error of O(spacing²).

    `March.quadrature` has no effect, and cells are cut at the exit even without `AlphaCorrection`. Cells
    without a crossing count as empty for `EmptySpaceJitter`; `SpaceLeaping` leaps over blocks whose range
    does not contain the value.

    **Missed crossings:** two crossings within a cell, as in a sheet thinner than a step, are not seen
    (`experiments/stability.py`, "isosurfaces of thin sheets"); of three, any may be found. `Jitter` without
    `front_residual` misses the interval before its first cell.

    Gradients of depth and normal follow from the implicit function theorem. They miss the jumps at
    silhouettes, and the gradient of the depth grows without bound where a ray only touches the surface. In a
    plane of voxels, where the interpolated field has an edge, they are one-sided.

    Args:
        value: the volume's value on the surface. It has a gradient.

    Raises:
        ValueError: for a value that is not a finite number.
    """

    value: Float[Array, ""]

    def __init__(self, value: Arrayable):
        self.value = number("value", value)

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        cut = () if march.ends_at_exit else (AlphaCorrection(),)
        integrated = March(1.0, (*march.transforms, *cut), "preintegrated", max_samples=march.max_samples)
        # replaced, since the constructor would check the step again
        return _Crossings(self.value), eqx.tree_at(lambda march: march.step, integrated, march.step)

    def begin(self, zero: Scalar, outputs: Outputs | None) -> Crossing:
        return Crossing(zero + jnp.inf, zero + jnp.inf, jnp.zeros(zero.shape, bool))

    def add(self, state: Crossing, fragment: Fragment) -> Crossing:
        *_, (before,), (_,) = fragment.measured
        front, back = fragment.cell.front, fragment.cell.front + fragment.cell.width
        crossing = Crossing(front, back, before < self.value)
        first = (state.back == jnp.inf) & ~(fragment.alpha <= 0)  # NaN counts as a crossing
        return jax.tree.map(lambda new, old: jnp.where(first, new, old), crossing, state)

    def depth(self, state: Crossing) -> Scalar:
        return state.back

    def finished(self, state: Crossing) -> Bool[Array, ""]:
        return state.back < jnp.inf

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        return transfer.visible(blocks)

    def pixel(self, sampler: RaySampler, state: Crossing) -> tuple[Float[Array, " n"], Scalar]:
        depth = self._implicit(sampler, jax.lax.stop_gradient(self._root(sampler, state)))
        classification = sampler.classification
        # the exact value, since the value at the root is rounded
        attributes = classification.attributes(sampler.coordinate(depth))
        measured = classification.searched((self.value, *attributes))
        color = sampler.color(depth, measured, classification.classify(measured), jnp.ones_like(depth))
        known = jnp.where(jnp.isnan(depth), jnp.nan, jnp.ones_like(depth))
        return jnp.stack([*color, known]) * known, depth

    def normal(self, sampler: RaySampler, depth: Scalar) -> Float[Array, "3"]:
        assert sampler.gradient is not None
        slopes = jnp.stack(sampler.gradient(sampler.place(depth)))
        square = jnp.sum(slopes * slopes)
        # 0 where the gradient vanishes
        return -slopes * jnp.where(square == 0, 0, jax.lax.rsqrt(jnp.where(square == 0, 1, square)))

    def _root(self, sampler: RaySampler, state: Crossing) -> Scalar:
        """Depth of the crossing, by bisection."""
        front, back = (within(sampler.ray, depth) for depth in (state.front, state.back))

        def halved(_: object, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
            near, far = bracket
            middle = (near + far) / 2
            # not by the values at the ends, which may now round to the other side
            past = (sampler.value(middle) >= self.value) == state.rises
            return jnp.where(past, near, middle), jnp.where(past, middle, far)

        near, far = jax.lax.fori_loop(0, jnp.finfo(front.dtype).nmant, halved, (front, back))
        # the end below the value: around the other end, the field may be constant
        return jnp.where(state.rises, near, far)

    def _implicit(self, sampler: RaySampler, root: Scalar) -> Scalar:
        """The root with the derivatives of v(s) = value: ds = (dvalue - dv) / v'."""
        value, slope = jax.jvp(sampler.value, (root,), (jnp.ones_like(root),))
        slope = jax.lax.stop_gradient(slope)
        missing = self.value - value
        missing = missing - jax.lax.stop_gradient(missing)  # 0 with derivatives: the root is accurate
        return root + jnp.where(slope == 0, 0, missing / jnp.where(slope == 0, 1, slope))


class _Crossings(Transfer):
    """Extinction 1 in cells whose ends lie on both sides of the value, else 0."""

    bands = 3
    value: Float[Array, ""]

    def classifier(self) -> Classify:
        return self.integrator()  # only cells are classified

    def integrator(self) -> Classify:
        def crossed(measured: Measured) -> tuple[Vec3, Scalar]:
            mean, (front,), (back,) = measured
            crosses = ((front >= self.value) != (back >= self.value)).astype(mean.dtype)
            none = jnp.zeros_like(mean)
            return (none, none, none), jnp.where(jnp.isnan(mean), jnp.nan, crosses)

        return crossed

    def majorant(self, blocks: Blocks) -> Float[Array, "bx by bz"]:
        value = self.value.astype(blocks.low.dtype)
        return ((blocks.low <= value) & (value <= blocks.high)).astype(blocks.low.dtype)
