"""How far does a Levenberg–Marquardt step go? As far in each parameter as the Jacobian says something of it.

Optimistix damps by λ |d|², which depends on the units of the residual and of every parameter: where
residuals are small, as those of images are, steps are damped to a standstill. Marquardt (1963) damps by
λ Σ Dᵢ² dᵢ² with Dᵢ² = (JᵀJ)ᵢᵢ, which no unit changes. It is Optimistix's step in the parameters D d.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree


FLOOR = 0.1
"""Least Dᵢ, as part of the greatest: a parameter of which next to nothing shows must not run away. (A
transfer function is recovered from two images of a head to rounding at 0.1, to a wrong minimum at 0.001.)"""


class ScaledDescent(optx.AbstractDescent):
    """The step d that makes |J d + r|² + λ |D d|² least, with λ = 1 / step size."""

    damped: optx.DampedNewtonDescent = optx.DampedNewtonDescent(lx.QR())

    def init(self, y: PyTree, f_info_struct: Any) -> Any:
        return self.damped.init(y, f_info_struct)

    def query(self, y: PyTree, f_info: Any, state: Any) -> Any:
        return self.damped.query(y, f_info, state)

    def step(self, step_size: Float[Array, ""], state: Any) -> tuple[PyTree, optx.RESULTS]:
        known = state.f_info
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), known.jac.in_structure())
        scale = jnp.linalg.norm(known.jac.as_matrix(), axis=0)
        scale = jnp.maximum(scale, FLOOR * jnp.max(scale))
        unit = ravel_pytree(zeros)[1](1 / jnp.where(scale > 0, scale, 1))
        jac = known.jac @ lx.DiagonalLinearOperator(unit)
        scaled = self.damped.query(zeros, optx.FunctionInfo.ResidualJac(known.residual, jac), state)
        step, result = self.damped.step(step_size, scaled)
        return jax.tree.map(jnp.multiply, unit, step), result


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """`optimistix.LevenbergMarquardt` with Marquardt's scaling, and a step that grows after any fair step."""

    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm
    descent: optx.AbstractDescent = ScaledDescent()
    search: optx.AbstractSearch = optx.ClassicalTrustRegion(high_cutoff=0.75)
    verbose: Callable[..., None] = lambda **_: None
