"""Random walks in an unbounded medium, by which `form="transport"` carries light.

The light scattered at a point x of a homogeneous medium towards the camera is, in expectation,

    ω E(x) / 4π + ω Σ_k ω^k E(y_k) / 4π          ω: albedo; E: irradiance at a point

where y_1, y_2, … are the vertices of a random walk from x with exponential flights of mean λ, whose
directions are uniform, and which ends where it leaves the medium.
"""

import math
from collections.abc import Sequence
from typing import SupportsIndex

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .._util.checks import integer
from .._util.vec3 import golden_spiral, turned
from ..xla.platform import is_traced
from .materials import Material
from .phase import sample_phase


def unit_walks(
    key: PRNGKeyArray, count: int, walks: int, levels: int
) -> tuple[Float[Array, "count walks levels 3"], Float[Array, "count walks levels"]]:
    """Directions and lengths, in mean free paths, of flights of random walks. The first directions of a set
    of `walks` are spread evenly. Lengths and turns are stratified: means over random ones would be off by
    1/√number."""
    number = count * walks
    rotate, shuffle, jitter = jax.random.split(key, 3)
    q, r = jnp.linalg.qr(jax.random.normal(rotate, (count, 3, 3)))
    q = q * jnp.sign(jnp.diagonal(r, axis1=1, axis2=2))[:, None]
    spread = jnp.asarray(golden_spiral(walks), q.dtype)
    first = jnp.sum(spread[None, :, None] * q[:, None], axis=-1).reshape(number, 3)
    ranks = jnp.broadcast_to(jnp.arange(number, dtype=q.dtype), (levels, 3, number))
    ranks = jax.random.permutation(shuffle, ranks, axis=-1, independent=True)
    u = (ranks + jax.random.uniform(jitter, (levels, 3, number), q.dtype)) / number
    u = jnp.minimum(u, 1 - jnp.finfo(u.dtype).epsneg)  # rounding makes it 1, and the flight infinite

    def flight(
        direction: Float[Array, "number 3"], u: Float[Array, "3 number"]
    ) -> tuple[Float[Array, "number 3"], tuple[Array, Array]]:
        turn = sample_phase(jnp.zeros((), q.dtype), u[1], u[2])
        x, y, z = direction.T
        scattered = jnp.stack(turned(turn, (x, y, z)), axis=-1)
        scattered = scattered / jnp.linalg.norm(scattered, axis=-1, keepdims=True)
        return scattered, (direction, -jnp.log1p(-u[0]))

    _, (directions, lengths) = jax.lax.scan(flight, first, u)
    shape = levels, count, walks
    return (
        jnp.moveaxis(directions.reshape(*shape, 3), 0, 2),
        jnp.moveaxis(lengths.reshape(shape), 0, 2),
    )


def scatterings(
    materials: Sequence[Material], threshold: float, levels: SupportsIndex | Sequence[SupportsIndex] | None
) -> int:
    """Scatterings of a walk: `levels`, by default until less than `threshold` of the light is left in every
    material. **Raises** `ValueError` without `levels` for a traced opacity, and an opacity of 0."""
    if levels is not None:
        return integer("levels", levels, 1)
    if is_traced([material.opacity for material in materials]):
        raise ValueError(
            "levels must be given where opacity is traced: the length of walks depends on it. If only the "
            "mean free path is fitted, let that be the parameter, and make the Material of it in the scene."
        )
    lowest = min(float(material.opacity) for material in materials)
    if lowest == 0:
        raise ValueError("levels must be given for a material of opacity 0, in which no light is absorbed.")
    return 1 if lowest == 1 else max(1, math.ceil(math.log(threshold) / math.log(1 - lowest)))
