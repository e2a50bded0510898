"""Shows one value of a ray, its greatest, least or mean, looked up in the transfer function, as opaque as a
layer of a `thickness`: by default 1, as by VTK and PyVista."""

from abc import abstractmethod
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.checks import number
from .._util.vec3 import Color, Scalar, Vec3
from ..march.march import March
from ..scene.occupancy import Blocks
from ..scene.transfer import Classification, Classify, Measured, Transfer
from ..scene.volume import Volume
from .blending import Fragment, OpticalDepths, Outputs
from .selection import RaySampler, Selection


Chosen: TypeAlias = tuple[Scalar, Scalar]
"""Score and depth of the sample that is chosen."""


ROUNDING = 4
"""Last digits in which interpolated values may differ that are equal."""


class Extreme(Selection[Chosen]):
    """A mode that shows the sample of the highest score. `Maximum` says what holds for all of them."""

    thickness: Float[Array, ""]

    @abstractmethod
    def score(self, value: Scalar) -> Scalar:
        """Score; the maximum wins."""

    def begin(self, zero: Scalar, outputs: Outputs | None) -> Chosen:
        return zero - jnp.inf, zero + jnp.inf

    def add(self, state: Chosen, fragment: Fragment) -> Chosen:
        (best, depth), score = state, self.score(fragment.value)
        # where values are equal, interpolation rounds them to either side
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

    Values are compared at the samples of the march: at a smooth peak the greatest of them is less than that
    of the ray by O(step²), and a peak thinner than a step may be missed. Of values that are equal, up to four
    units in the last place, the nearest is chosen. NaN is above all numbers, so that a fault of the volume
    shows. Under `quadrature="preintegrated"`, means of the values at the two ends of cells are compared, and
    what lies in the middle of the cell is shown. `Rendering.depth` is that of the sample, infinite where it
    is transparent.

    `SpaceLeaping` leaps over blocks in which neither the values nor any that are less are visible: air, under
    most transfer functions. `"min_distance"` is refused.

    Gradients, also that of the thickness, are those of the sample that is chosen (`Selection`). Where the
    choice changes, the value is the same on both sides, and the image has a kink; depth, light, and what a
    transfer function reads beside the value (a magnitude, a label) jump there, and rounding may decide it:
    such a pixel differs between float32 and float64.

    Source: VTK's MAXIMUM_INTENSITY_BLEND; Wallis et al. 1989.

    Args:
        thickness: of a layer of the value, world length, > 0. Its opacity, `1 - exp(-extinction thickness)`,
            is that of the pixel: if it is equal to the `unit_distance` of the transfer function, the opacity
            that was given for the value.

    Raises:
        ValueError: for a thickness that is not a positive finite number.
    """

    def __init__(self, thickness: Any = 1.0):
        self.thickness = number("thickness", thickness, above=0)

    def score(self, value: Scalar) -> Scalar:
        return value

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Blocks in which some value is visible, or any that is less: a maximum in another is invisible."""
        return transfer.visible(Blocks(jnp.full_like(blocks.low, jnp.nanmin(blocks.low)), blocks.high, None))


class Minimum(Extreme):
    """The least value along a ray (minimum intensity projection), looked up in the transfer function.

    All else is as in `Maximum`, with less for greater. Source: VTK's MINIMUM_INTENSITY_BLEND.

    Args:
        thickness: as for `Maximum`.

    Raises:
        ValueError: for a thickness that is not a positive finite number.
    """

    def __init__(self, thickness: Any = 1.0):
        self.thickness = number("thickness", thickness, above=0)

    def score(self, value: Scalar) -> Scalar:
        return -value

    def occupied(self, transfer: Transfer, blocks: Blocks) -> Bool[Array, "bx by bz"]:
        """Blocks in which some value is visible, or any that is greater."""
        return transfer.visible(Blocks(blocks.low, jnp.full_like(blocks.high, jnp.nanmax(blocks.high)), None))


class Average(OpticalDepths):
    """The mean value along a ray, as classified by the transfer function.

    With the values v_k in cells of widths e_k, the mean is Σ e_k v_k / Σ e_k over what lies in the volume. It
    is classified once. What is transparent counts, too, so that nothing is leapt over, and `EmptySpaceJitter`
    does not shift. `Rendering.depth` is the middle of the ray's part in the volume.

    With `AlphaCorrection`, the mean of values that are linear along the ray is exact but for rounding under
    `"midpoint"` and `"preintegrated"`; under `"left"` it errs by half their change over one step; and
    gradients are complete. Without, the last cell counts as a whole, and gradients miss the jumps of the exit
    (`render`). Source: VTK's AVERAGE_INTENSITY_BLEND.

    Args:
        thickness: of a layer of the mean value, world length, > 0, as in `Maximum`.

    Raises:
        ValueError: for a thickness that is not a positive finite number; in a render, for a lighting and for
            a transfer function that reads more than the value: a mean lies nowhere.
    """

    thickness: Float[Array, ""]

    def __init__(self, thickness: Any = 1.0):
        self.thickness = number("thickness", thickness, above=0)

    @property
    def reads_value(self) -> bool:
        return True

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        """Through a fog of constant extinction whose colours are the values: optical depths are widths."""
        if transfer.reads_more:
            raise ValueError(
                "compositing by an average needs a transfer function that depends on the value alone; "
                f"{type(transfer).__name__} reads more."
            )
        # so that the optical depth of a ray is at most 1, where float32 resolves it well
        longest = march.locate(volume).diagonal + march.step
        return _Values(jax.lax.stop_gradient(1 / longest)), march

    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        # of rays that only fill up a chunk, sums are 0, and derivatives must not be NaN
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
        return self.classifier()  # a mean of values comes first of what is measured


def layer(color: Color, extinction: Scalar, thickness: Scalar) -> Float[Array, " n"]:
    """Premultiplied colour and opacity of a layer."""
    opacity = -jnp.expm1(-extinction * thickness)
    return opacity * jnp.stack([*color, jnp.ones_like(opacity)])
