"""Which free variables describe a swept probe? A bijection, so that `fit` finds its geometry from images."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import described, require
from ..march.transforms import ToroidalMap
from .bijections import MARGIN, Bijection, Positive


class Fitted(NamedTuple):
    """What of a probe is fitted, and named in its uncertainty."""

    a: Float[Array, ""]
    b: Float[Array, ""]
    beta_range: Float[Array, "2"]
    sigma_range: Float[Array, "2"]
    last_gamma: Float[Array, ""]


class ProbeGeometry(Bijection):
    """The geometry of a swept probe: `a`, `b`, both ranges of angles, and the last depth of a `ToroidalMap`.

    The first depth, `gamma_range[0]`, stays that of `start`: adding a length to `b` while subtracting it from
    both ends of `gamma_range` moves nothing. Images determine the seven others if their cameras are known in
    world units, the scene has edges in all directions, and its ends are in view. From cameras known up to
    scale, `a`, `b` and `last_gamma` are, too; where the camera's position is free, so is the probe's.
    `Fit.uncertainty` says what is not determined.

    The free variables, of order 1, are the distances of the first sample from the apex and from the motor
    axis (of the outermost beam, the nearest one), the length of a beam, and the logarithms of the ratios in
    which a range of angles divides [0, π]. So every step is a valid probe: no sample lies behind the apex or
    the motor axis, ranges increase, and angles stay within [0, π]. A start within 1/1000 of a limit (π, the
    size of the probe) is moved to that distance from it.

    Args:
        start: Sets the typical lengths, and the first depth.

    Raises:
        ValueError: For what is not a `ToroidalMap`, for one that begins at another depth, and for one with
            samples behind the motor axis.
    """

    whole: bool = eqx.field(static=True, default=True, init=False)
    start: ToroidalMap

    def __init__(self, start: ToroidalMap | Any):
        if not isinstance(start, ToroidalMap):
            raise ValueError(f"start must be a ToroidalMap; got {described(start)}.")
        self.start = start

    def forward(self, free: dict[str, Any]) -> ToroidalMap:
        start = jax.lax.stop_gradient(self.start)
        near, axis, span = (self._length.forward(free[name]) for name in ("near", "axis", "span"))
        beta, sigma = (_range_of(free[name]) for name in ("beta", "sigma"))
        first = start.gamma_range[0]
        gamma = jnp.stack([first, first + span])
        fields = jnp.zeros_like(near), near - first, beta, sigma, gamma
        probe = eqx.tree_at(
            lambda p: (p.a, p.b, p.beta_range, p.sigma_range, p.gamma_range), self.start, fields
        )
        return eqx.tree_at(lambda p: p.a, probe, axis - probe.nearest_to_axis)

    def inverse(self, value: ToroidalMap | Any, name: str = "value") -> dict[str, Any]:
        if not isinstance(value, ToroidalMap):
            raise ValueError(f"{name} must be a ToroidalMap; got {described(value)}.")
        first, found = float(self.start.gamma_range[0]), float(value.gamma_range[0])
        if not np.isclose(found, first, atol=1e-5 * float(self._size)):
            raise ValueError(
                f"{name} must begin at the same depth as the start, gamma_range[0] = {first}; got {found}. "
                "Add the difference to b."
            )
        nearest = require(
            value.nearest_to_axis,
            lambda axis, size: axis >= -1e-6 * size,
            f"{name} must not have samples behind the motor axis to be fitted: its outermost beams begin at "
            "{got} from it. Raise a, or narrow sigma_range.",
            self._size,
        )
        near, axis = value.b + value.gamma_range[0], jnp.maximum(nearest, 0)
        lengths = {"near": near, "axis": axis, "span": value.gamma_range[1] - value.gamma_range[0]}
        free = {key: self._length.inverse(length, f"{name}, {key}") for key, length in lengths.items()}
        return free | {"beta": _ratios(value.beta_range), "sigma": _ratios(value.sigma_range)}

    def moved(self, value: ToroidalMap) -> Fitted:
        return Fitted(value.a, value.b, value.beta_range, value.sigma_range, value.gamma_range[1])

    @property
    def _size(self) -> Float[Array, ""]:
        return jax.lax.stop_gradient(self.start.b + self.start.gamma_range[1])

    @property
    def _length(self) -> Positive:
        return Positive(self._size)


def _ratios(angles: Float[Array, "2"]) -> Float[Array, "2"]:
    """Logarithms of what lies below and above a range of angles, in parts of the range."""
    gaps = jnp.stack([angles[0], angles[1] - angles[0], jnp.pi - angles[1]])
    gaps = jnp.maximum(gaps, MARGIN * jnp.pi)
    return jnp.log(gaps[::2] / gaps[1])


def _range_of(ratios: Float[Array, "2"]) -> Float[Array, "2"]:
    gaps = jnp.pi * jax.nn.softmax(jnp.stack([ratios[0], jnp.zeros_like(ratios[0]), ratios[1]]))
    return jnp.stack([gaps[0], gaps[0] + gaps[1]])
