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

    so that the weights of a ray and the transmittance 1 - A that is left sum to 1. It is A that is kept: in
    float32, taking thousands of small equal weights from a transmittance near 1 would round the same way each
    time. `moment` is Σ w × depth past the entry. What is not asked for is None.

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
        """Of all cells so far together."""
        return 1 - self.opacity

    def weight(self, alpha: Scalar) -> Scalar:
        """Of a next cell of this opacity."""
        return (1 - self.opacity) * alpha

    def add(self, weight: Scalar, color: Vec3 | None = None, depth: Scalar | None = None) -> "Over":
        """With one more cell of this weight, colour and depth past the entry; without what of these is not
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
        """The mean depth of what is seen, past the entry, weighted by how much each cell adds to the opacity;
        infinite where nothing is."""
        assert self.moment is not None
        # of NaN neither more nor less than 0 is true, and it is handed on
        seen = ~(self.opacity <= 0)
        # Of moment and opacity as parts of the opacity, which is so divided by 1: the derivative of a
        # quotient divides by the square, and that of the opacity of a veil is 0 in float32.
        whole = jax.lax.stop_gradient(jnp.where(seen, self.opacity, 1))
        mean = (self.moment / whole) / jnp.where(seen, self.opacity / whole, 1)
        return jnp.where(seen, mean, jnp.inf)


def pull_over(worth: Scalar, transmittance: Scalar, behind: Scalar) -> Scalar:
    """How a loss changes with the optical depth of a cell: there is more of the cell, and less of all that
    lies behind it.

    **Arguments:**

    - `worth`: what a unit of the cell's weight is worth to the loss.
    - `transmittance`: of all cells up to this one, and of this one.
    - `behind`: what all cells behind this one are worth, with their weights.
    """
    # With no more than this left, what lies behind is lost in the rounding of the sums, which an opaque
    # sample's extinction would blow up.
    nothing = 2 * float(jnp.finfo(behind.dtype).eps)
    return jnp.where(transmittance <= nothing, 0, transmittance * worth - behind)
