"""How well do the images determine the parameters? Covariance from the triangle of a least-squares fit.

With residuals that are independent and of one variance σ², the free numbers scatter with σ² (JᵀJ)⁻¹ around
the truth, to first order, and σ² is estimated by Σ r² / (m - n). JᵀJ = RᵀR is inverted through the singular
values of R; the parameters' own covariance follows by the Jacobian of the bijections.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from .constraints import Free


SHARE = 0.5
"""A parameter is named for a direction if it has at least this share of what the foremost one has in it."""

TOUCHED = 0.01
"""A variance is infinite where an undetermined direction of length 1 has more than this of a parameter."""


class Uncertainty(NamedTuple):
    """What is known of fitted parameters.

    - `covariance`: in the order of `names`. Where a direction that the residual does not determine moves a
      parameter, its variance is infinite and its covariances are NaN.
    - `names`: such as `.extinction[3]`.
    - `undetermined`: for each such direction, the parameters that it moves most.
    """

    covariance: Float[np.ndarray, "parameters parameters"]
    names: list[str]
    undetermined: list[list[str]]

    @property
    def standard_errors(self) -> dict[str, float]:
        """Square root of the variance, by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def uncertainty(
    triangle: Float[np.ndarray, "numbers numbers"], count: int, free: Free, at: tuple, scale: float = 0.0
) -> Uncertainty:
    """Of parameters `free.forward(at)`, from the triangle R c; 0 ρ at them, the number of residuals, and the
    norm of what is compared.

    A direction is undetermined if its singular value is below n ε times the largest one, or times that norm,
    with ε of the float type: within rounding, nothing is known of it."""
    n = triangle.shape[0] - 1
    flat, unravel = ravel_pytree(at)
    bend = np.asarray(jax.jacfwd(lambda flat: ravel_pytree(free.moved(unravel(flat)))[0])(flat), np.float64)
    factor = np.asarray(triangle, np.float64)
    # with as many parameters as residuals nothing is left to estimate the variance from
    variance = np.sum(factor[:, -1] ** 2) / (count - n) if count > n else np.inf
    _, singular, directions = np.linalg.svd(factor[:n, :n])
    known = singular > n * np.finfo(triangle.dtype).eps * singular.max(initial=scale)
    moves = bend @ directions.T  # what each direction does to the parameters
    spread = moves[:, known] / singular[known]
    covariance = (
        variance * (spread @ spread.T) if np.isfinite(variance) else np.full((len(bend),) * 2, np.inf)
    )
    names = free.names(at)
    # what a direction moves, each parameter in units of how fast the free numbers move it: where a bijection
    # is nearly flat, they move it little, and yet it is they that are not determined
    pace = np.linalg.norm(bend, axis=1, keepdims=True)
    share = np.abs((bend / np.where(pace > 0, pace, 1)) @ directions[~known].T)
    undetermined = [
        [name for name, part in zip(names, column, strict=True) if part >= SHARE * column.max()]
        for column in share.T
    ]
    touched = np.any(share > TOUCHED, axis=1)
    covariance[touched] = covariance[:, touched] = np.nan
    covariance[touched, touched] = np.inf
    return Uncertainty(covariance, names, undetermined)
