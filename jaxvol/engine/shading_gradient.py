"""What does a loss see of the light? Each visible sample is lit again, with the derivatives of that.

The counterpart of `visible.shaded_colors` in the second march.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from .._util.fetching import scatter_add
from .._util.trees import added, floats
from .._util.vec3 import Scalar, Vec3
from ..lighting.shading import Shading, Surroundings, lit
from ..march import March
from ..space import Ray
from ..transfer import Classification
from .shading import Weighed, samples_of, visible
from .wavefront import Samples


class Lit(NamedTuple):
    """By what the samples of an image are lit."""

    shading: Shading
    around: Surroundings

    @property
    def leaves(self) -> PyTree:
        """What has a gradient, but for the transfer function and the voxels."""
        return self.shading, self.around.space


class LightTotal(NamedTuple):
    """Gradients that all samples add to: of what lights, of the transfer function, and of the voxels."""

    light: PyTree
    transfer: PyTree
    voxels: Float[Array, " voxels"] | None


class ShadingVjp(NamedTuple):
    """Samples as lit, arrays (cells, rays); and what their colour, extinction, measured values and world
    points get of what is wanted of them. 0 for those that are not seen."""

    color: Vec3
    of_color: Vec3
    of_extinction: Scalar
    of_measured: PyTree
    of_point: Vec3


def shading_vjp(
    light: Lit,
    seen: Classification,
    march: March,
    ray: Ray,
    samples: Samples,
    known: Weighed,
    wanted: list[Vec3],
    total: LightTotal,
) -> tuple[list[ShadingVjp], LightTotal]:
    """A segment's samples, and the total with what they add to it. `wanted`: of each piece's colour."""
    chosen, around = visible(known), light.around
    size = sum(weight.size for weight in known.weight)
    moving, fixed = eqx.partition((light.leaves, around.transfer), eqx.is_inexact_array)

    def one(
        places: Int[Array, " chunk"], carry: tuple[ShadingVjp, LightTotal]
    ) -> tuple[ShadingVjp, LightTotal]:
        found, total = carry
        some = samples_of(chosen, places, seen, march, ray, samples.cells, samples.measured, known)
        moving_sample, fixed_sample = eqx.partition(some, eqx.is_inexact_array)

        def colors(moving: PyTree, moving_sample: PyTree, taps: Any) -> tuple[Vec3, Any]:
            (shading, space), transfer = eqx.combine(moving, fixed)
            here = Surroundings(around.volume, transfer, space)
            each = eqx.combine(moving_sample, fixed_sample)
            return jax.vmap(lambda sample, taps: lit(shading, here, sample, taps))(each, taps)

        taps = None
        if total.voxels is not None:
            _, asked = jax.eval_shape(lambda: colors(moving, moving_sample, []))
            taps = [jnp.zeros(each.shape, around.volume.data.dtype) for each in asked]
        color, pull, asked = jax.vjp(colors, moving, moving_sample, taps, has_aux=True)
        real = places < size
        cotangent = tuple(jnp.where(real, part, 0) for part in chosen.take(wanted, places))
        (of_light, of_transfer), of_sample, of_taps = pull(cotangent)
        voxels = None if total.voxels is None else scatter_add(total.voxels, asked, of_taps)
        total = LightTotal(added(total.light, of_light), added(total.transfer, of_transfer), voxels)
        part = ShadingVjp(color, of_sample.color, of_sample.extinction, of_sample.measured, of_sample.point)
        return chosen.put(found, places, part), total

    zero = jnp.zeros(size, known.weight[0].dtype)
    measured = jax.tree.map(lambda _: zero, floats(samples.measured[0]))
    zeros = zero, zero, zero
    start = ShadingVjp(zeros, zeros, zero, measured, zeros)
    found, total = chosen.over(one, (start, total))
    return chosen.apart(found, len(known.weight)), total
