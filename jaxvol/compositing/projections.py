"""Projections: the greatest, least or mean value of a ray, classified by the transfer function and shown as a
layer of a `thickness`, by default 1 as in VTK and PyVista."""

from abc import abstractmethod
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.checks import Arrayable, number
from .._util.vec3 import Color, Scalar, Vec3
from ..march.march import March
from ..scene.occupancy import Blocks
from ..scene.transfer import Classification, Classify, Measured, Transfer
from ..scene.volume import Volume
from .blending import Fragment, OpticalDepths, Outputs
from .selection import RaySampler, Selection


Chosen: TypeAlias = tuple[Scalar, Scalar]
"""Score and depth of the selected sample."""

ROUNDING = 4
"""Rounding errors of equal interpolated values, units in the last place."""


class Extreme(Selection[Chosen]):
    """A mode that shows the sample of the highest score. `Maximum` documents it."""

    thickness: Float[Array, ""]

    @abstractmethod
    def score(self, value: Scalar) -> Scalar:
        """Score of a value."""

    def begin(self, zero: Scalar, outputs: Outputs | None) -> Chosen:
        return zero - jnp.inf, zero + jnp.inf

    def add(self, state: Chosen, fragment: Fragment) -> Chosen:
        (best, depth), score = state, self.score(fragment.value)
        # interpolation rounds equal values to either side
        slack = ROUNDING * float(jnp.finfo(best.dtype).eps) * jnp.abs(best)
        higher = fragment.valid & ~(score <= best + slack) & ~jnp.isnan(best)
        return jnp.where(higher, score, best), jnp.where(higher, fragment.depth, depth)

    def depth(self, state: Chosen) -> Scalar:
        return state[1]

    def pixel(self, sampler: RaySampler, state: Chosen) -> tuple[Float[Array, " n"], Scalar]:
        _, depth = state
        rgba = layer(*sampler.shaded(depth), self.thickness)
        return rgba, jnp.where(rgba[3] <= 0, jnp.inf, depth)


class Maximum(Extreme):
    """The greatest value along a ray (maximum intensity projection), looked up in the transfer function.

    Values are compared at the samples of the march: at a smooth peak their maximum is less than the ray's by
    O(step²), and a peak thinner than a step may be missed. Of values that are equal up to four units in the
    last place, the nearest is selected. NaN compares greater than all numbers, so that faulty volumes show.
    Under `quadrature="preintegrated"`, the means of the values at the two ends of cells are compared, and the
    pixel shows the middle of the cell. `Rendering.depth` is the sample's, infinite if it is transparent.

    `SpaceLeaping` leaps over blocks in which neither the values nor any lesser ones are visible: air, under
    most transfer functions. `"min_distance"` is refused.

    Gradients, also that of the thickness, are those of the selected sample (`Selection`). Where the selection
    changes, the value is continuous, and the image has a kink; depth, light, and other attributes that a
    transfer function reads (a magnitude, a label) jump there, and rounding may decide: such a pixel differs
    between float32 and float64.

    Source: VTK's MAXIMUM_INTENSITY_BLEND; Wallis et al. 1989.

    Args:
        thickness: thickness of a layer of the value, world length, > 0. The pixel's opacity is the layer's,
            `1 - exp(-extinction thickness)`. With the transfer function's `unit_distance` as thickness, it is
            the opacity of the control points.

    Raises:
        ValueError: for a thickness that is not a positive finite number.
    """

    def __init__(self, thickness: Arrayable = 1.0):
        self.thickness = number("thickness", thickness, above=0)

    def score(self, value: Scalar) -> Scalar:
        return value

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Mask of the blocks in which a value or any lesser one is visible: other maxima are invisible."""
        return transfer.visible(Blocks(jnp.full_like(blocks.low, jnp.nanmin(blocks.low)), blocks.high, None))


class Minimum(Extreme):
    """The least value along a ray (minimum intensity projection), looked up in the transfer function.

    Otherwise as `Maximum`, with less for greater.

    Source: VTK's MINIMUM_INTENSITY_BLEND.

    Args:
        thickness: as for `Maximum`.

    Raises:
        ValueError: for a thickness that is not a positive finite number.
    """

    def __init__(self, thickness: Arrayable = 1.0):
        self.thickness = number("thickness", thickness, above=0)

    def score(self, value: Scalar) -> Scalar:
        return -value

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Mask of the blocks in which a value or any greater one is visible."""
        return transfer.visible(Blocks(blocks.low, jnp.full_like(blocks.high, jnp.nanmax(blocks.high)), None))


class Average(OpticalDepths):
    """The mean value along a ray, classified by the transfer function.

    The mean of values v_k in cells of widths e_k is Σ e_k v_k / Σ e_k over the ray's part in the volume. It
    is classified once. Transparent cells count, too, so that rays do not leap, and `EmptySpaceJitter` does
    not shift. `Rendering.depth` is the middle of the ray's part in the volume.

    With `AlphaCorrection`, the mean of values that are linear along the ray is exact up to rounding under
    `"midpoint"` and `"preintegrated"`; under `"left"` it errs by half their change over one step; and
    gradients are complete. Without it, the last cell has the full width, and gradients miss the jumps of the
    exit (`render`).

    Source: VTK's AVERAGE_INTENSITY_BLEND.

    Args:
        thickness: thickness of a layer of the mean value, world length, > 0, as in `Maximum`.

    Raises:
        ValueError: for a thickness that is not a positive finite number; in a render, for a lighting and for
            a transfer function that reads more than the value, since a mean has no position.
    """

    thickness: Float[Array, ""]

    def __init__(self, thickness: Arrayable = 1.0):
        self.thickness = number("thickness", thickness, above=0)

    @property
    def reads_value(self) -> bool:
        return True

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        """A fog of constant extinction whose colours are the values: optical depths measure widths."""
        if transfer.reads_more:
            raise ValueError(
                "compositing by an average needs a transfer function that depends on the value alone; "
                f"{type(transfer).__name__} reads more."
            )
        # the optical depth of a ray is at most 1, which float32 resolves well
        longest = march.locate(volume).diagonal + march.step
        return _Values(jax.lax.stop_gradient(1 / longest)), march

    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        # the sums of padding rays are 0, and their derivatives must not be NaN
        mean = sums[0] / jnp.where(sums[3] == 0, 1, sums[3])
        return layer(*classification.classify(classification.searched((mean,))), self.thickness)


class _Values(Transfer):
    """A fog whose red is the volume's value."""

    bands = 3
    extinction: Float[Array, ""]

    def classifier(self) -> Classify:
        def shown(measured: Measured) -> tuple[Vec3, Scalar]:
            value, none = measured[0], jnp.zeros_like(measured[0])
            return (value, none, none), none + self.extinction

        return shown

    def integrator(self) -> Classify:
        return self.classifier()  # the mean value of a cell is the first of `measured`


def layer(color: Color, extinction: Scalar, thickness: Scalar) -> Float[Array, " n"]:
    """Premultiplied colour and opacity of a layer."""
    opacity = -jnp.expm1(-extinction * thickness)
    return opacity * jnp.stack([*color, jnp.ones_like(opacity)])
