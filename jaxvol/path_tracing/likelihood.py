"""Derivatives of detached sampling: paths are drawn as if the parameters were constants, and the probability
p of each decision enters as the weight p / q, where the constant q equals p. The mean over paths is then the
image as a function of the parameters.

Where the extinction is 0, nothing collides, although the derivative is not 0; near 0 or a majorant, p / q has
a derivative of unbounded variance. So paths for derivatives are drawn by another `Sampling`.

Sources: Vicini, Speierer and Jakob, "Path Replay Backpropagation", 2021; Nimier-David et al., "Unbiased
Inverse Volume Rendering with Differential Trackers", 2022.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._util.vec3 import Scalar


class Sampling(NamedTuple):
    """Sampling of collisions.

    Attributes:
        margin: factor of the majorants.
        collisions: minimum mean number of collisions along the volume's diagonal, also in empty space.
        importance: minimum factor of a path's importance at a collision, however dark the collision is. None:
            a path's importance is its throughput, so that it ends where it carries no light.
    """

    margin: float
    collisions: float
    importance: float | None


OF_IMAGES = Sampling(1, 0, None)

# With the margin m, the derivative of the logarithm of a path's probability has a variance proportional to
# m / (m - 1), and takes m times as many candidates: m = 2 minimises the work.
OF_DERIVATIVES = Sampling(2, 0.5, 0.25)


@jax.custom_jvp
def likelihood(probability: Scalar) -> Scalar:
    """1, with the derivative of `probability / q`, where the constant q equals the probability."""
    # JAX 0.10 fails to compile a batch of this where the derivative has a batch axis and the value none
    one = jnp.ones_like(probability)
    return jnp.where(probability > 0, one, one)


@likelihood.defjvp
def _(primals: tuple[Scalar], tangents: tuple[Scalar]) -> tuple[Scalar, Scalar]:
    ((p,), (tangent,)) = primals, tangents
    ratio = likelihood(p)
    return ratio, ratio * tangent / jnp.maximum(p, jnp.finfo(p.dtype).tiny)


@jax.custom_jvp
def jumping(number: Scalar, jump: Bool[Array, "..."]) -> Scalar:
    """The number, with the derivative NaN where it is at a jump and changes."""
    return number


@jumping.defjvp
def _(primals: tuple[Scalar, Array], tangents: tuple[Scalar, Any]) -> tuple[Scalar, Scalar]:
    (number, jump), (tangent, _) = primals, tangents
    return jumping(number, jump), jnp.where(jump & (tangent != 0), jnp.nan, tangent)


@jax.custom_vjp
def jumping_in_reverse(number: Scalar, jump: Bool[Array, "..."]) -> Scalar:
    """The number, with the cotangent NaN where it is at a jump and the loss depends on it."""
    return number


jumping_in_reverse.defvjp(
    lambda number, jump: (number, jump),
    lambda jump, bar: (jnp.where(jump & (bar != 0), jnp.nan, bar), None),
)
