"""How do the cells of a ray become a pixel? One after the other, front to back."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._util.vec3 import Scalar, Vec3


class Over(eqx.Module):
    """The cells so far, composited by the operator "over".

    A cell of opacity α and colour c, behind opacity A, has the weight w:

        w = (1 - A) α        C ← C + w c        A ← A + w

    so that the weights of a ray and the remaining transmittance 1 - A sum to 1. A is stored rather than the
    transmittance: in float32, subtracting thousands of small equal weights from a number near 1 would round
    the same way each time. `moment` is Σ w × depth past the entry. What is not asked for is None.

    Source: Porter and Duff 1984; Max 1995.
    """

    opacity: Scalar
    color: Vec3 | None
    moment: Scalar | None

    @classmethod
    def begin(cls, zero: Scalar, *, color: bool, moment: bool) -> "Over":
        """Before the first cell; `zero`: of the shape and type of a ray's numbers."""
        return cls(zero, (zero, zero, zero) if color else None, zero if moment else None)

    @property
    def transmittance(self) -> Scalar:
        """Of all cells so far."""
        return 1 - self.opacity

    def weight(self, alpha: Scalar) -> Scalar:
        """Weight of the next cell, of this opacity."""
        return (1 - self.opacity) * alpha

    def add(self, weight: Scalar, color: Vec3 | None = None, depth: Scalar | None = None) -> "Over":
        """With one more cell, of this weight, colour and depth past the entry; colour and depth where
        given."""
        sums = moment = None
        if self.color is not None and color is not None:
            r, g, b = (sum_ + weight * part for sum_, part in zip(self.color, color, strict=True))
            sums = r, g, b
        if self.moment is not None and depth is not None:
            moment = self.moment + weight * depth
        return Over(self.opacity + weight, sums, moment)

    def rgba(self) -> Float[Array, "4"]:
        """Premultiplied colour, and opacity."""
        assert self.color is not None
        return jnp.stack([*self.color, self.opacity])

    def mean_depth(self) -> Scalar:
        """Mean depth past the entry of what is visible, weighted by what each cell adds to the opacity;
        infinite where nothing is visible."""
        assert self.moment is not None
        # not `> 0`, which is false for NaN: NaN is to be passed on
        seen = ~(self.opacity <= 0)
        # Both are divided by the opacity first, so that the quotient's denominator is 1: its derivative
        # divides by the square of that, which for the opacity of a veil underflows to 0 in float32.
        whole = jax.lax.stop_gradient(jnp.where(seen, self.opacity, 1))
        mean = (self.moment / whole) / jnp.where(seen, self.opacity / whole, 1)
        return jnp.where(seen, mean, jnp.inf)


def pull_over(worth: Scalar, transmittance: Scalar, behind: Scalar) -> Scalar:
    """Derivative of a loss by the optical depth of a cell: more of the cell, and less of all that lies behind
    it.

    **Arguments:**

    - `worth`: derivative of the loss by the cell's weight.
    - `transmittance`: of all cells up to and including this one.
    - `behind`: sum over all cells behind this one of weight × worth.
    """
    # Below this transmittance `behind` is nothing but the sums' rounding, which the extinction of an opaque
    # sample would amplify.
    nothing = 2 * float(jnp.finfo(behind.dtype).eps)
    return jnp.where(transmittance <= nothing, 0, transmittance * worth - behind)
