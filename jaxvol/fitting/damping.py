"""Levenberg–Marquardt steps damped by λ Σ Dᵢ² dᵢ² with Dᵢ² = (JᵀJ)ᵢᵢ (Marquardt 1963), whatever the units:
Optimistix's step, damped by λ |d|², in the parameters D d. Unscaled, fits stall where residuals are small."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..xla.trees import PyTree


FLOOR = 0.1
"""Smallest Dᵢ relative to the largest, or a parameter with almost no effect would run away."""


class ScaledDescent(optx.DampedNewtonDescent[Any]):
    """The step d that minimises |J d + r|² + λ |D d|², with λ = 1 / step size."""

    def step(self, step_size: Float[Array, ""], state: PyTree) -> tuple[PyTree, optx.RESULTS]:
        info = state.f_info
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), info.jac.in_structure())
        scale = jnp.linalg.norm(info.jac.as_matrix(), axis=0)
        scale = jnp.maximum(scale, FLOOR * jnp.max(scale))
        unit = ravel_pytree(zeros)[1](1 / jnp.where(scale > 0, scale, 1))
        jac = info.jac @ lx.DiagonalLinearOperator(unit)
        scaled = self.query(zeros, optx.FunctionInfo.ResidualJac(info.residual, jac), state)
        step, result = super().step(step_size, scaled)
        return jax.tree.map(jnp.multiply, unit, step), result


class LevenbergMarquardt(optx.AbstractGaussNewton[Any, Any, Any]):
    """`optimistix.LevenbergMarquardt` with Marquardt's scaling, and a step that grows after any fair step."""

    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm
    descent: optx.AbstractDescent[Any, Any, Any] = ScaledDescent(lx.QR())
    search: optx.AbstractSearch[Any, Any, Any, Any] = optx.ClassicalTrustRegion(high_cutoff=0.75)
    verbose: Callable[..., None] = lambda **_: None
