"""How well do the images determine the parameters? Covariance from the triangles of a least-squares fit.

To first order, a fit errs by (JᵀJ)⁻¹ Jᵀ e if the references err by e. So its covariance is
(JᵀJ)⁻¹ Jᵀ cov(e) J (JᵀJ)⁻¹, with JᵀJ = RᵀR. For noise that is independent from pixel to pixel, Jᵀ cov(e) J is
estimated by Σ gₚ gₚᵀ · m / (m - n), with the scores gₚ = Σ Jᵢ rᵢ over the entries of pixel p, whatever the
variance of each entry, and however the colours of a pixel are correlated: the "sandwich" (Huber 1967; White
1980; for clusters, Liang and Zeger 1986). If all entries are independent and of equal variance σ², estimated
by Σ r² / (m - n), the covariance is σ² (JᵀJ)⁻¹. The covariance of the parameters follows from the Jacobian of
the bijections.
"""

import warnings
from typing import NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .constraints import Free, FreeVariables
from .noise import Noise
from .residuals import Triangles


SHARE = 0.5
"""A parameter is named for a direction if its share in it is at least this fraction of the largest."""

TOUCHED = 0.01
"""A variance is infinite if the parameter's share in an undetermined direction of length 1 exceeds this."""


MISFIT = "The model does not fit"
"""How the warning of a misfit begins, for those who tell it otherwise."""


class Uncertainty(NamedTuple):
    """Uncertainty of fitted parameters that is due to noise of the references, and of the paths of a
    `PathTracedResidual` (which counts twice, so that errors are at most 1.4 times too large).

    If the model cannot make the references, the parameters are biased, and neither covariance knows by how
    much. A misfit whose norm is k times the standard deviation of (equal) noise may shift a parameter by up
    to k standard errors. So what is too small to show in χ² of m entries, a k of (2 m)^¼, may still do harm.

    Attributes:
        covariance: in the order of `names`, for noise that is independent from pixel to pixel, whatever its
            variance in each ("sandwich", Huber–White). If a direction that the residual does not determine
            changes a parameter, its variance is infinite and its covariances are NaN.
        names: such as `.extinction[3]`.
        undetermined: for each such direction, the parameters that it changes most.
        covariance_of_equal_noise: if all entries of the residual have independent noise of equal variance;
            otherwise wrong: too small where only some pixels are noisy, and these show the parameters.
        reduced_chi_squared: how many times larger the mean square of the residual is than the noise,
            Σ r² / Σ σ² · m / (m - n) with m entries of σ > 0 and n parameters, so that pixels without noise,
            such as the background of a path-traced image, don't count: about 1 if the model fits. None if the
            noise of the references is unknown, and then nothing is known about misfit, either.
    """

    covariance: Float[np.ndarray, "parameters parameters"]
    names: list[str]
    undetermined: list[list[str]]
    covariance_of_equal_noise: Float[np.ndarray, "parameters parameters"]
    reduced_chi_squared: float | None

    @property
    def standard_errors(self) -> dict[str, float]:
        """Square roots of the variances in `covariance`, by name; of a single number, the name is empty."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


class Spreads(NamedTuple):
    """How noise of the references moves the free variables.

    Attributes:
        each: F, with covariance F Fᵀ, for noise of any variance in each pixel.
        equal: for noise of equal variance in all entries.
        undetermined: directions, of length 1, that the residual does not determine, in rows.
    """

    each: Float[np.ndarray, "free numbers"]
    equal: Float[np.ndarray, "free determined"]
    undetermined: Float[np.ndarray, "directions free"]


def spreads(triangles: Triangles, count: int, scale: float) -> Spreads:
    """Spreads, where `scale` is the norm of the data. A direction is undetermined within rounding: its
    singular value is below n ε times the largest one, or times that norm."""
    factor, scores = (np.asarray(triangle, np.float64) for triangle in triangles)
    n = scores.shape[1]
    _, singular, directions = np.linalg.svd(factor[:n, :n])
    determined = singular > n * np.finfo(triangles.residual.dtype).eps * singular.max(initial=scale)
    inverse = directions[determined].T / singular[determined]
    left = max(count - n, 1)
    each = (inverse / singular[determined]) @ (directions[determined] @ scores.T) * np.sqrt(count / left)
    equal = inverse * np.sqrt(np.sum(factor[:, -1] ** 2) / left)
    return Spreads(each, equal, directions[~determined])


def uncertainty(
    triangles: Triangles,
    count: int,
    free: Free,
    at: FreeVariables,
    scale: float,
    chi_squared: float | None,
    own: Float[Array, "free free"] | None = None,
) -> Uncertainty:
    """Uncertainty of `free.forward(at)`. `own`: the fit's covariance, if it is random."""
    flat, unravel = ravel_pytree(at)
    jac = np.asarray(jax.jacfwd(lambda flat: ravel_pytree(free.moved(unravel(flat)))[0])(flat), np.float64)
    each, equal, undetermined = spreads(triangles, count, scale)
    names = free.names(at)
    # relative to the norm of a parameter's row: where a bijection is nearly flat, the effect is small, yet
    # the parameter is undetermined
    norm = np.linalg.norm(jac, axis=1, keepdims=True)
    share = np.abs((jac / np.where(norm > 0, norm, 1)) @ undetermined.T)
    moved = [[names[i] for i in np.flatnonzero(row >= SHARE * row.max())] for row in share.T]
    touched = np.any(share > TOUCHED, axis=1)
    more = 0.0 if own is None else jac @ np.asarray(own, np.float64) @ jac.T

    def covariance(spread: np.ndarray) -> np.ndarray:
        if count <= flat.size:  # no entries are left to estimate variances from
            return np.full((len(jac),) * 2, np.inf)
        found = (jac @ spread) @ (jac @ spread).T + more
        found[touched] = found[:, touched] = np.nan
        found[touched, touched] = np.inf
        return found

    return Uncertainty(covariance(each), names, moved, covariance(equal), chi_squared)


def warn_of_misfit(noise: Noise, chi_squared: float, message: str | None) -> None:
    """Warn if noise does not explain the residual. `message`: how the fit ended, if it did not converge."""
    if not chi_squared > noise.largest_by_chance:
        return
    because = "" if message is None else f", or the fit is not at its minimum ({message})"
    warnings.warn(
        f"{MISFIT} the references{because}: the residual is {chi_squared**0.5:.3g} times as large as "
        f"noise (reduced chi-squared {chi_squared:.4g}; of noise alone below {noise.largest_by_chance:.3g}). "
        "Standard errors do not cover the bias that this causes.",
        stacklevel=4,  # whoever calls `fit`
    )
