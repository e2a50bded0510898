"""Base classes of compositing modes, and the operator "over".

A `Weighting` gives each cell a weight: the pixel is the weighted sum of the colours, and its opacity is the
sum of the weights. A `Selection` picks one depth on the ray, such as that of the greatest value.
"""

from abc import abstractmethod
from functools import partial
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
"""Outputs besides the image and `Rendering.exhausted`: all, the depth, or none."""


class Fragment(NamedTuple):
    """A sample and its cell, the input of compositing.

    Attributes:
        alpha: opacity of the cell; 0 past the ray's end.
        depth: depth of the sample, past the ray's entry.
        cell: interval of the ray that the sample represents.
        measured: values read from the volume, the volume's value first; for a `Weighting`, the others may be
            missing.
        color: shaded colour; None for a `Selection`, or if only opacities are computed.
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
        """The volume's value; for an integrated cell, the mean of the values at its ends."""
        return self.measured[0]


class Compositing(eqx.Module, Generic[State]):
    """A compositing mode: a `Weighting` or a `Selection`. Methods take one ray, whose fragments are added
    front to back to a `State`, a tree of arrays."""

    @abstractmethod
    def begin(self, zero: Scalar, outputs: Outputs | None) -> State:
        """The state before the first fragment. `zero`: 0 in the ray's dtype. `outputs`: None for only the
        opacity."""

    @abstractmethod
    def add(self, state: State, fragment: Fragment) -> State:
        """The state with the next fragment."""

    @abstractmethod
    def end(self, state: State) -> tuple[Float[Array, " n"], Scalar | None]:
        """Premultiplied colour and opacity; and the depth past the entry, if computed, infinite if nothing is
        visible."""

    @property
    def resolves(self) -> bool:
        """True if the pixel is computed after the march, from its final state."""
        return False

    @property
    def can_be_lit(self) -> bool:
        """True if the mode supports lighting. A `Weighting` with `resolved` does not: its cells are marched
        without light, and its pixel has no single position."""
        return not self.resolves

    @property
    def reads_value(self) -> bool:
        """True if the mode compares or averages values, so that each point must have a single value."""
        return True

    def marched(self, transfer: Transfer, march: March, volume: Volume) -> tuple[Transfer, March]:
        """Transfer function and march for the cells of a mode that `resolves`; by default the arguments."""
        return transfer, march

    @abstractmethod
    def transmittance(self, state: State) -> Scalar:
        """Transmittance of all cells so far, for `Transform.stop` and for shading."""

    def finished(self, state: State) -> Bool[Array, ""]:
        """True once further fragments cannot change the pixel; by default never."""
        return jnp.zeros(jnp.shape(self.transmittance(state)), bool)

    def occupied(self, transfer: Transfer, blocks: Any) -> Bool[Array, "bx by bz"]:
        """Mask of the blocks that may change a pixel; rays leap over the others. `transfer`: by `marched`.
        `blocks`: ranges of values, `Blocks`, or `SeveralBlocks` for several volumes."""
        return transfer.visible(blocks)


class Composite(eqx.Module):
    """Sums over a ray's cells so far, with weights w, which have factors under `Transform.roulette`.

    Attributes:
        opacity: sum of w without factors, on which later weights depend.
        color: sum of w × colour, if computed.
        moment: sum of w × depth, if computed.
        factor: product of the factors so far, of all later weights; None: 1.
        reweighted: sum of w, if it differs from `opacity`.
    """

    opacity: Scalar
    color: Color | None = None
    moment: Scalar | None = None
    factor: Scalar | None = None
    reweighted: Scalar | None = None

    def add(self, weight: Scalar, color: Color | None = None, depth: Scalar | None = None) -> "Composite":
        """Adds a cell to the sums."""
        opacity, sums, moment, reweighted = self.opacity + weight, None, None, None
        if self.factor is not None:
            weight = weight * self.factor
        if self.color is not None and color is not None:
            sums = tuple(sum_ + weight * part for sum_, part in zip(self.color, color, strict=True))
        if self.moment is not None and depth is not None:
            moment = self.moment + weight * depth
        if self.reweighted is not None:
            reweighted = self.reweighted + weight
        return Composite(opacity, sums, moment, self.factor, reweighted)


class Weighting(Compositing[Composite]):
    """A mode that gives each cell of colour c a weight w. The pixel is Σ w c, its opacity Σ w. Subclasses
    must override `weight`; it, `slope` and `transmittance` work elementwise, and know nothing of the factors
    of `Transform.roulette`.

    Weights depend on the cells' opacities and on parameters, are at least 0, and sum to at most 1. If
    transforms divide a cell, each part has a weight. Parameters are static fields, or JAX arrays, which have
    gradients in every adjoint. For `jax.grad` with `adjoint="replay"`, weights must be f(`alpha`) or
    (constant - `before`) f(`alpha`), with f(1/2) > 0; for other weights the gradient is NaN, and
    `adjoint="direct"` has it.
    """

    @abstractmethod
    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        """Weight of a cell of opacity `alpha` behind cells whose weights sum to `before`. It must be 0 if
        `alpha` is 0, since engines skip such cells."""

    def slope(self, alpha: Scalar, after: Scalar, weight_bar: Scalar, sum_behind: Scalar) -> Scalar:
        """Derivative of a loss with respect to the optical depth τ of a cell, for the second march; by
        default, JAX derives it from `weight`. Override it to save time. It is linear in the last two
        arguments, by which factors of `Transform.roulette` enter.

        Args:
            alpha: opacity of the cell, 1 - exp(-τ), with the derivative 1 - `alpha`.
            after: sum of the weights up to and including this cell's.
            weight_bar: derivative of the loss with respect to the cell's weight.
            sum_behind: sum of weight × weight_bar over all cells behind this one.

        Raises:
            NotImplementedError: unless it is overridden (`has_slope`); engines do not call it then.
        """
        raise NotImplementedError

    @property
    @final
    def has_slope(self) -> bool:
        """True if `slope` is overridden."""
        return type(self).slope is not Weighting.slope

    @final
    def total_bar(self, after: Scalar, weight_bar: Scalar, sum_behind: Scalar) -> Scalar:
        """Derivative of a loss with respect to the weight of a cell, which hides the cells behind it.
        Arguments as for `slope`; NaN for weights of another form than the two of the class's docstring.

        Of weights (c - `before`) f(`alpha`), all those behind have the factor c - `after`. If c - `after` is
        rounding, so is `sum_behind`."""
        dtype = after.dtype
        tried = (jnp.array(numbers, dtype) for numbers in ([0.5, 0.25, 0.75], [0, 0.25, 0.5]))
        alpha, before = jnp.meshgrid(*tried, indexing="ij")
        weight, change = jax.jvp(partial(self.weight, alpha), (before,), (jnp.ones_like(before),))
        hides = change[0, 0] != 0
        limit = jnp.where(hides, -weight[0, 0] / jnp.where(hides, change[0, 0], 1), jnp.inf)
        error, eps = weight - weight[:, :1] * (1 - before / limit), float(jnp.finfo(dtype).eps)
        holds = jnp.all(jnp.abs(error) <= 64 * eps * weight[:, :1]) & (weight[0, 0] > 0)
        remaining = jnp.where(holds, limit, jnp.nan) - after
        opaque = remaining <= 2 * eps
        return weight_bar - jnp.where(opaque, 0, sum_behind / jnp.where(opaque, 1, remaining))

    def transmittance(self, state: Composite) -> Scalar:
        """Transmittance of the cells so far; by default 1, for a mode without occlusion."""
        return jnp.ones_like(state.opacity)

    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        """Computes the pixel of a ray that is not transparent from Σ w c and Σ w, after the march.
        `classification`: of the renderer's transfer function, not of that by `marched`. JAX also
        differentiates it at sums of 0, where neither value nor derivative may be NaN."""
        return sums

    @property
    def reads_value(self) -> bool:
        return False

    @property
    def resolves_transparent(self) -> bool:
        """True if `resolved` has a derivative for transparent rays; by default False."""
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
        opacity = state.opacity if state.reweighted is None else state.reweighted
        rgba = jnp.stack([*state.color, opacity])
        if state.moment is None:
            return rgba, None
        visible = ~(opacity <= 0)  # also NaN
        # Divide both by a constant first, so that the denominator is 1: the derivative divides by its square,
        # which would underflow for a very small opacity.
        total = jax.lax.stop_gradient(jnp.where(visible, opacity, 1))
        mean = (state.moment / total) / jnp.where(visible, opacity / total, 1)
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

    def slope(self, alpha: Scalar, after: Scalar, weight_bar: Scalar, sum_behind: Scalar) -> Scalar:
        transmittance = 1 - after
        # below this transmittance `sum_behind` is only rounding, which a high extinction would amplify
        opaque = transmittance <= 2 * float(jnp.finfo(sum_behind.dtype).eps)
        return jnp.where(opaque, 0, transmittance * weight_bar - sum_behind)

    def transmittance(self, state: Composite) -> Scalar:
        return 1 - state.opacity


class OpticalDepths(Weighting):
    """A mode whose weights are the cells' optical depths, without occlusion. A subclass scales extinctions
    (`marched`) and sums (`resolved`), so that float32 resolves a cell's optical depth by its opacity."""

    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        return -jnp.log1p(-alpha)

    def slope(self, alpha: Scalar, after: Scalar, weight_bar: Scalar, sum_behind: Scalar) -> Scalar:
        return weight_bar

    @abstractmethod
    def resolved(self, classification: Classification, sums: Float[Array, " n"]) -> Float[Array, " m"]:
        """Computes the pixel from sums of optical depths."""


def joined(front: Composite, back: Composite) -> Composite:
    """Joins a front and a back part of a ray, marched independently under "over", which is associative."""
    return jax.tree.map(lambda a, b: a + (1 - front.opacity) * b, front, back)
