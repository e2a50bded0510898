"""Derivatives of detached sampling: paths are drawn as if the parameters were constants, and each probability
p of what was drawn enters as the weight p / q, q its constant. The mean over paths is then the image as a
function of the parameters.

Where the extinction is 0, nothing collides, although the derivative is not 0; near 0 or a majorant, p / q has
a derivative of unbounded variance. So derivatives have paths by a `Sampling` of their own.

Sources: Vicini, Speierer and Jakob, "Path Replay Backpropagation", 2021; Nimier-David et al., "Unbiased
Inverse Volume Rendering with Differential Trackers", 2022.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._util.vec3 import Scalar


class Sampling(NamedTuple):
    """How collisions are drawn.

    Attributes:
        margin: factor of the majorants.
        collisions: a path collides at least so often along the volume's diagonal, also in empty space.
        importance: least factor of a path's importance at a collision, however dark it is. None: a path's
            importance is its throughput, so that it ends where it carries no light.
    """

    margin: float
    collisions: float
    importance: float | None


OF_IMAGES = Sampling(1, 0, None)

# With the margin m, the derivative of the logarithm of a path's probability has a variance proportional to
# m / (m - 1), and takes m times as many candidates: least work for m = 2.
OF_DERIVATIVES = Sampling(2, 0.5, 0.25)


@jax.custom_jvp
def likelihood(probability: Scalar) -> Scalar:
    """1, with the derivative of `probability / q`, of a probability and the constant q equal to it."""
    # JAX 0.10 fails to compile a batch of this where the derivative has a batch axis and the value none
    one = jnp.ones_like(probability)
    return jnp.where(probability > 0, one, one)


@likelihood.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[Scalar, Scalar]:
    ((p,), (tangent,)) = primals, tangents
    ratio = likelihood(p)
    return ratio, ratio * tangent / jnp.maximum(p, jnp.finfo(p.dtype).tiny)


@jax.custom_jvp
def jumping(number: Scalar, where: Bool[Array, "..."]) -> Scalar:
    """The number itself; `where` it is at a jump, any change of it has the derivative NaN."""
    return number


@jumping.defjvp
def _(primals: tuple[Scalar, Array], tangents: tuple[Scalar, Any]) -> tuple[Scalar, Scalar]:
    (number, where), (tangent, _) = primals, tangents
    return jumping(number, where), jnp.where(where & (tangent != 0), jnp.nan, tangent)
