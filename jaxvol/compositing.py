"""How do the cells of a ray become a pixel? One after the other, front to back.

A compositing mode gives each cell a weight; the pixel is the sum of the cells' colours times their weights,
and of the weights themselves, which is its opacity.
"""

from abc import abstractmethod
from typing import Any, Literal, TypeAlias, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._util.checks import described
from ._util.vec3 import Scalar, Vec3


class Composite(eqx.Module):
    """The cells of a ray so far: Σ w, Σ w × colour and Σ w × depth past the entry, where w are the cells'
    weights. What is not asked for is None."""

    opacity: Scalar
    color: Vec3 | None
    moment: Scalar | None

    @classmethod
    def begin(cls, zero: Scalar, *, color: bool, moment: bool) -> "Composite":
        """Before the first cell; `zero`: of the shape and type of a ray's numbers."""
        return cls(zero, (zero, zero, zero) if color else None, zero if moment else None)

    def add(self, weight: Scalar, color: Vec3 | None = None, depth: Scalar | None = None) -> "Composite":
        """With one more cell; its colour and depth are left out where they are not given."""
        sums = moment = None
        if self.color is not None and color is not None:
            r, g, b = (sum_ + weight * part for sum_, part in zip(self.color, color, strict=True))
            sums = r, g, b
        if self.moment is not None and depth is not None:
            moment = self.moment + weight * depth
        return Composite(self.opacity + weight, sums, moment)

    def rgba(self) -> Float[Array, "4"]:
        """Premultiplied colour, and opacity."""
        assert self.color is not None
        return jnp.stack([*self.color, self.opacity])

    def mean_depth(self) -> Scalar:
        """Mean depth past the entry of what is visible, weighted by what each cell adds to the opacity;
        infinite where nothing is visible."""
        assert self.moment is not None
        # not `> 0`, which is false for NaN: NaN is to be passed on
        visible = ~(self.opacity <= 0)
        # Both are divided by the opacity first, so that the quotient's denominator is 1: its derivative
        # divides by the square of that, which for the opacity of a veil underflows to 0 in float32.
        whole = jax.lax.stop_gradient(jnp.where(visible, self.opacity, 1))
        mean = (self.moment / whole) / jnp.where(visible, self.opacity / whole, 1)
        return jnp.where(visible, mean, jnp.inf)


class Compositing(eqx.Module):
    """A compositing mode: a rule for weights, which depend on the cells' opacities alone, are at least 0, and
    sum to at most 1.

    All methods work elementwise, on the numbers of one ray or of many. Parameters are static fields: they
    have no gradient. A cell here is a piece of one where transforms divide cells.
    """

    @abstractmethod
    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        """Weight of the next cell, of opacity `alpha`, where the weights of the cells in front sum to
        `before`. It is 0 where `alpha` is, since engines leave such cells out."""

    @abstractmethod
    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        """Derivative of a loss by the optical depth τ of a cell, for the second march.

        **Arguments:**

        - `alpha`: opacity of the cell, 1 - exp(-τ), so that its own derivative is 1 - `alpha`.
        - `after`: sum of the weights up to and including this cell's.
        - `worth`: derivative of the loss by the cell's weight.
        - `behind`: sum over all cells behind this one of weight × worth.
        """

    def transmittance(self, opacity: Scalar) -> Scalar:
        """Of all cells so far, whose weights sum to `opacity`. `Transform.stop` decides by it, and shading is
        told it. By default 1: what is in front hides nothing."""
        return jnp.ones_like(opacity)


class Over(Compositing):
    """The operator "over": emission and absorption, front to back.

    A cell of opacity α and colour c, behind opacity A, has the weight w:

        w = (1 - A) α        C ← C + w c        A ← A + w

    so that the weights of a ray and the remaining transmittance 1 - A sum to 1. A is stored rather than the
    transmittance: in float32, subtracting thousands of small equal weights from a number near 1 would round
    the same way each time.

    Source: Porter and Duff 1984; Max 1995.
    """

    def weight(self, alpha: Scalar, before: Scalar) -> Scalar:
        return (1 - before) * alpha

    def slope(self, alpha: Scalar, after: Scalar, worth: Scalar, behind: Scalar) -> Scalar:
        """More of the cell, and less of all that lies behind it."""
        transmittance = self.transmittance(after)
        # Below this transmittance `behind` is nothing but the sums' rounding, which the extinction of an
        # opaque sample would amplify.
        nothing = 2 * float(jnp.finfo(behind.dtype).eps)
        return jnp.where(transmittance <= nothing, 0, transmittance * worth - behind)

    def transmittance(self, opacity: Scalar) -> Scalar:
        return 1 - opacity


Mode: TypeAlias = Literal["over"]
"""Names of modes."""

MODES: dict[Mode, type[Compositing]] = {"over": Over}


def compositing_of(given: Mode | Any) -> Compositing:
    """The mode of this name, or the mode itself.

    **Raises:** `ValueError`, naming the argument, for anything else, and for a mode whose fields are not all
    static."""
    if isinstance(given, Compositing):
        if jax.tree.leaves(given):
            raise ValueError(
                "compositing must have static fields only, eqx.field(static=True); "
                f"{described(given)} has others."
            )
        return given
    if isinstance(given, str) and given in get_args(Mode):
        return MODES[cast(Mode, given)]()
    names = " or ".join(f'"{name}"' for name in MODES)
    raise ValueError(f"compositing must be {names}, or a jaxvol Compositing; got {described(given)}.")
