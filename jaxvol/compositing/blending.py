"""How do the cells of a ray become a pixel?

A `Weighting` gives each cell a weight: the pixel is the weighted sum of their colours, and the sum of the
weights is its opacity. A `Selection` picks one depth on the ray, such as that of the greatest value.
"""

from abc import abstractmethod
from typing import Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._util.vec3 import Color, Scalar
from ..march.march import Cell, March
from ..scene.transfer import Classification, Measured, Transfer
from ..scene.volume import Volume


State = TypeVar("State")

Outputs: TypeAlias = Literal["all", "depth", "rgba"]
"""What is computed besides the image and `Rendering.exhausted`: everything, the depth, or nothing."""


class Fragment(NamedTuple):
    """A sample, as compositing sees it.

    Attributes:
        alpha: opacity of its cell; 0 past the ray's end.
        depth: of the sample, past the ray's entry.
        cell: the piece of the ray that it stands for.
        measured: what was read from the volume, the value first; for a `Weighting`, the rest may be missing.
        color: as shaded; None for a `Selection`, or where only opacities are computed.
        valid: false past the ray's end, in gaps of the volume, and for cells of width 0.
    """

    alpha: Scalar
    depth: Scalar
    cell: Cell
    measured: Measured
    color: Color | None
    valid: Bool[Array, ""]

    @property
    def value(self) -> Scalar:
        """The volume's value; of a cell that is integrated, the mean of those at its ends."""
        return self.measured[0]


class Compositing(eqx.Module, Generic[State]):
    """A compositing mode: a `Weighting` or a `Selection`. All methods see one ray, whose fragments are added
    to a `State`, a tree of arrays, front to back."""

    @abstractmethod
    def begin(self, zero: Scalar, outputs: Outputs | None) -> State:
        """The state before the first fragment. `zero`: a 0 of the ray's type. `outputs`: what is computed;
        None for only the opacity."""

    @abstractmethod
    def add(self, state: State, fragment: Fragment) -> State:
        """The state with the next fragment."""

    @abstractmethod
    def end(self, state: State) -> tuple[Float[Array, " n"], Scalar | None]:
        """Premultiplied colour and opacity; and the depth past the entry, if it is computed, infinite where
        nothing is visible."""

    @property
    def resolves(self) -> bool:
        """Whether the pixel is computed after the march, from its final state."""
        return False

    @property
    def can_be_lit(self) -> bool:
        """Whether lighting shades what is shown. Not where a `Weighting` has `resolved`: its cells are
        marched without light, and what it shows lies at no one place."""
        return not self.resolves

    @property
    def reads_value(self) -> bool:
        """Whether it compares or averages values, so that there must be one at a place."""
        return True

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        """The transfer function and the march for the cells of a mode that `resolves`; by default those that
        are given."""
        return transfer, march

    @abstractmethod
    def transmittance(self, state: State) -> Scalar:
        """Of all cells so far, for `Transform.stop` and for shading."""

    def finished(self, state: State) -> Bool[Array, ""]:
        """Whether further fragments cannot change the pixel."""
        return jnp.zeros(jnp.shape(self.transmittance(state)), bool)

    def occupied(self, transfer: Transfer, blocks: Any) -> Bool[Array, "bx by bz"]:
        """Which blocks of a volume may change a pixel, from the ranges of their values, `Blocks` (of several
        volumes, `SeveralBlocks`); rays leap over the others. `transfer`: that of `marched`."""
        return transfer.visible(blocks)


class Composite(eqx.Module):
    """Sums of the weights w of a ray's cells so far, of w × colour and of w × depth, if computed."""

    opacity: Scalar
    color: Color | None = None
    moment: Scalar | None = None

    def add(self, weight: Scalar, color: Color | None = None, depth: Scalar | None = None) -> "Composite":
        """With one more cell."""
        sums = moment = None
        if self.color is not None and color is not None:
            sums = tuple(sum_ + weight * part for sum_, part in zip(self.color, color, strict=True))
        if self.moment is not None and depth is not None:
            moment = self.moment + weight * depth
        return Composite(self.opacity + weight, sums, moment)


class Weighting(Compositing[Composite]):
    """A mode that gives each cell of colour c a weight w. The pixel is Σ w c, its opacity Σ w. Subclasses
    must override `weight` and `slope`; these, and `transmittance`, work elementwise.

    Weights depend only on the cells' opacities, are at least 0, and sum to at most 1. Where transforms
    divide cells, each piece has a weight. Parameters are static fields, or, if only `resolved` depends on
    them, arrays, which have gradients.
    """

    @abstractmethod
    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        """Weight of a cell of opacity `alpha` behind cells whose weights sum to `before`. It must be 0 where
        `alpha` is, since engines leave such cells out."""

    @abstractmethod
    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        """Derivative of a loss with respect to the optical depth τ of a cell, for the second march. The
        arguments suffice only for weights f(`alpha`) or (constant - `before`) f(`alpha`).

        Args:
            alpha: opacity of the cell, 1 - exp(-τ), so that its own derivative is 1 - `alpha`.
            after: sum of the weights up to and including this cell's.
            worth: derivative of the loss with respect to the cell's weight.
            behind: sum over all cells behind this one of weight × worth.
        """

    def transmittance(self, state: Composite) -> Scalar:
        """By default 1: what is in front hides nothing."""
        return jnp.ones_like(state.opacity)

    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        """The pixel of a ray that is not transparent, from its Σ w c and Σ w, where it is computed after the
        march. `classification`: of the transfer function that was given, not of that of `marched`. JAX also
        differentiates it at sums of 0, where neither value nor derivative may be NaN."""
        return sums

    @property
    def reads_value(self) -> bool:
        return False

    @property
    def resolves_transparent(self) -> bool:
        """Whether `resolved` has a derivative to be known where nothing is seen. By default not."""
        return False

    @property
    @final
    def resolves(self) -> bool:
        return type(self).resolved is not Weighting.resolved

    @final
    def begin(self, zero: Scalar, outputs: Outputs | None) -> Composite:
        moment = zero if outputs in ("all", "depth") else None
        return Composite(zero, None if outputs is None else (zero, zero, zero), moment)

    @final
    def add(self, state: Composite, fragment: Fragment) -> Composite:
        return state.add(self.weight(fragment.alpha, state.opacity), fragment.color, fragment.depth)

    @final
    def end(self, state: Composite) -> tuple[Float[Array, " n"], Scalar | None]:
        assert state.color is not None
        rgba = jnp.stack([*state.color, state.opacity])
        if state.moment is None:
            return rgba, None
        visible = ~(state.opacity <= 0)  # also NaN
        # Both are first divided by a constant, so that the denominator is 1: its square, by which the
        # derivative divides, would underflow where the opacity is very small.
        whole = jax.lax.stop_gradient(jnp.where(visible, state.opacity, 1))
        mean = (state.moment / whole) / jnp.where(visible, state.opacity / whole, 1)
        return rgba, jnp.where(visible, mean, jnp.inf)


class Over(Weighting):
    """The operator "over": emission and absorption, front to back.

    A cell of opacity α and colour c, behind opacity A, has the weight w:

        w = (1 - A) α        C ← C + w c        A ← A + w

    so that the weights of a ray and the remaining transmittance 1 - A sum to 1. A is stored rather than the
    transmittance, from which thousands of small weights could not be subtracted exactly.

    Source: Porter and Duff 1984; Max 1995.
    """

    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        return (1 - before) * alpha

    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        transmittance = 1 - after
        # below this transmittance `behind` is only rounding, which a high extinction would amplify
        nothing = 2 * float(jnp.finfo(behind.dtype).eps)
        return jnp.where(transmittance <= nothing, 0, transmittance * worth - behind)

    def transmittance(self, state: Composite) -> Scalar:
        return 1 - state.opacity


class OpticalDepths(Weighting):
    """A mode whose weights are the cells' optical depths: what is in front hides nothing. A subclass scales
    its sums (`marched`, `resolved`), so that the depth of a cell is known from its opacity in float32."""

    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        return -jnp.log1p(-alpha)

    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        return worth

    @abstractmethod
    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        """The pixel, from sums of optical depths."""


def joined(front: Composite, back: Composite) -> Composite:
    """Joins a front and a back part of a ray, marched independently under "over", which is associative."""
    return jax.tree.map(lambda a, b: a + (1 - front.opacity) * b, front, back)
