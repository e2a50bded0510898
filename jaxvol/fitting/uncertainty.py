"""How well do the images determine the parameters? Covariance from the triangle of a least-squares fit.

If residuals are independent and of equal variance σ², estimated by Σ r² / (m - n), the covariance of the free
variables around the truth is σ² (JᵀJ)⁻¹ to first order, with JᵀJ = RᵀR; that of the parameters follows from
the Jacobian of the bijections.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from .constraints import Free, FreeVariables


SHARE = 0.5
"""A parameter is named for a direction if its share in it is at least this fraction of the largest."""

TOUCHED = 0.01
"""A variance is infinite if the parameter's share in an undetermined direction of length 1 exceeds this."""


class Uncertainty(NamedTuple):
    """Uncertainty of fitted parameters.

    Attributes:
        covariance: in the order of `names`. If a direction that the residual does not determine changes a
            parameter, its variance is infinite and its covariances are NaN.
        names: such as `.extinction[3]`.
        undetermined: for each such direction, the parameters that it changes most.
    """

    covariance: Float[np.ndarray, "parameters parameters"]
    names: list[str]
    undetermined: list[list[str]]

    @property
    def standard_errors(self) -> dict[str, float]:
        """Square roots of the variances, by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def uncertainty(
    triangle: Float[np.ndarray, "n n"], count: int, free: Free, at: FreeVariables, scale: float = 0.0
) -> Uncertainty:
    """Uncertainty of the parameters `free.forward(at)`, from the triangle [R c; 0 ρ] there, the number of
    residuals, and the norm `scale` of the compared data.

    A direction is undetermined if its singular value is below n ε times the largest one, or times that norm,
    with ε of the float type: within rounding, the residual does not depend on it."""
    n = triangle.shape[0] - 1
    flat, unravel = ravel_pytree(at)
    jac = np.asarray(jax.jacfwd(lambda flat: ravel_pytree(free.moved(unravel(flat)))[0])(flat), np.float64)
    factor = np.asarray(triangle, np.float64)
    # with as many parameters as residuals, none are left to estimate the variance from
    variance = np.sum(factor[:, -1] ** 2) / (count - n) if count > n else np.inf
    _, singular, directions = np.linalg.svd(factor[:n, :n])
    determined = singular > n * np.finfo(triangle.dtype).eps * singular.max(initial=scale)
    effects = jac @ directions.T  # of each direction, on the parameters
    spread = effects[:, determined] / singular[determined]
    covariance = variance * (spread @ spread.T) if np.isfinite(variance) else np.full((len(jac),) * 2, np.inf)
    names = free.names(at)
    # relative to the norm of a parameter's row: where a bijection is nearly flat, the effect is small, yet
    # the parameter is undetermined
    norm = np.linalg.norm(jac, axis=1, keepdims=True)
    share = np.abs((jac / np.where(norm > 0, norm, 1)) @ directions[~determined].T)
    undetermined = [[names[i] for i in np.flatnonzero(row >= SHARE * row.max())] for row in share.T]
    touched = np.any(share > TOUCHED, axis=1)
    covariance[touched] = covariance[:, touched] = np.nan
    covariance[touched, touched] = np.inf
    return Uncertainty(covariance, names, undetermined)
