"""Uncertainty of fitted parameters: covariance from the triangles of a least-squares fit.

To first order, a fit errs by (JᵀJ)⁻¹ Jᵀ e if the references err by e. So its covariance is
(JᵀJ)⁻¹ Jᵀ cov(e) J (JᵀJ)⁻¹, with JᵀJ = RᵀR. For noise that is independent from pixel to pixel, Jᵀ cov(e) J is
estimated by Σ gₚ gₚᵀ · m / (m - n), with the scores gₚ = Σ Jᵢ rᵢ over the entries of pixel p, whatever the
variance of each entry, and however the colours of a pixel are correlated: the "sandwich" (Huber 1967; White
1980; for clusters, Liang and Zeger 1986). Here m counts the entries that depend on a parameter: a fit makes
their residuals smaller than the noise, and no others. If all entries are independent and of equal variance
σ², estimated by Σ r² / (m - n) over all entries, the covariance is σ² (JᵀJ)⁻¹. The covariance of the
parameters follows from the Jacobian of the bijections.
"""

import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .constraints import Free, FreeVariables
from .noise import Noise
from .residuals import Triangles


SHARE = 0.5
"""Minimum share of a parameter that is named for a direction, relative to the largest share in it."""

TOUCHED = 0.01
"""Share in an undetermined direction of length 1 beyond which a parameter's variance is infinite."""

MISFIT = "The model does not fit"
"""Beginning of the warning of a misfit, for callers that filter it."""


class Uncertainty(NamedTuple):
    """Uncertainty of fitted parameters that is due to noise of the references, and of the paths of a
    `PathTracedResidual` (which counts twice, so that errors are at most 1.4 times too large).

    If the model cannot reproduce the references, the parameters are biased, and neither covariance includes
    the bias. A misfit whose norm is k times the standard deviation of (equal) noise may shift a parameter by
    up to k standard errors. So a misfit of k = (2 m)^¼, too small to show in χ² of m entries, may matter.

    Attributes:
        covariance: covariance in the order of `names`, for noise that is independent from pixel to pixel,
            of any variance in each ("sandwich", Huber–White). Where parameters are many, it is too small: in
            fits of 125 voxels and 4 extinctions to three views of 24² pixels, standard errors were 0.9 of the
            true ones, and those by `covariance_of_equal_noise` 0.99. If a direction that the residual does
            not determine changes a parameter, its variance is infinite and its covariances are NaN.
        names: names of the numbers, such as `.extinction[3]`.
        undetermined: for each undetermined direction, the parameters that it changes most.
        covariance_of_equal_noise: covariance if all entries of the residual have independent noise of equal
            variance; too small where only some pixels are noisy, and these determine the parameters.
        reduced_chi_squared: ratio of the mean squares of the residual and of the noise, Σ r² / Σ σ² ·
            m / (m - n), with m entries of σ > 0 and n parameters: about 1 if the model fits. Pixels without
            noise, such as the background of a path-traced image, don't count. None if the noise of the
            references, and so any misfit, is unknown.
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
    """Effect of noise of the references on the free variables.

    Attributes:
        unequal: F, with covariance F Fᵀ, for noise of any variance in each pixel.
        equal: F for noise of equal variance in all entries.
        undetermined: directions, of length 1, that the residual does not determine, in rows.
    """

    unequal: Float[np.ndarray, "free numbers"]
    equal: Float[np.ndarray, "free determined"]
    undetermined: Float[np.ndarray, "directions free"]


def spreads(triangles: Triangles, count: int, scale: float) -> Spreads:
    """Spreads by the triangles of `count` entries. `scale`: norm of the data."""
    factor, scores, informed = (np.asarray(triangle, np.float64) for triangle in triangles)
    n = scores.shape[1]
    _, singular, directions = np.linalg.svd(factor[:n, :n])
    # a singular value within rounding of the largest one, or of the data, determines nothing
    determined = singular > n * np.finfo(triangles.residual.dtype).eps * singular.max(initial=scale)
    inverse = directions[determined].T / singular[determined]
    freedom = max(count - n, 1)
    unequal = (inverse / singular[determined]) @ (directions[determined] @ scores.T)
    equal = inverse * np.sqrt(np.sum(factor[:, -1] ** 2) / freedom)
    shrunk = max(informed - np.count_nonzero(determined), 1) / max(informed, 1)
    return Spreads(unequal / np.sqrt(shrunk), equal, directions[~determined])


def uncertainty(
    triangles: Triangles,
    count: int,
    free: Free,
    at: FreeVariables,
    scale: float,
    chi_squared: float | None,
    path_covariance: Float[Array, "free free"] | None = None,
) -> Uncertainty:
    """Uncertainty of `free.forward(at)`. `path_covariance`: part due to noise of the fit's paths."""
    jac = np.asarray(_jacobian(free, at), np.float64)
    unequal, equal, undetermined = spreads(triangles, count, scale)
    if path_covariance is not None:
        reach = np.asarray(ravel_pytree(free.reach(at))[0], np.float64)
        hidden = np.diag(np.asarray(path_covariance, np.float64)) > reach**2
        undetermined = np.concatenate([undetermined, np.eye(jac.shape[1])[hidden]])
    names = free.names(at)
    # relative to the norm of a parameter's row: where a bijection is nearly flat, the effect is small, yet
    # the parameter is undetermined
    norm = np.linalg.norm(jac, axis=1, keepdims=True)
    share = np.abs((jac / np.where(norm > 0, norm, 1)) @ undetermined.T)
    moved = [[names[i] for i in np.flatnonzero(row >= SHARE * row.max())] for row in share.T]
    touched = np.any(share > TOUCHED, axis=1)
    by_paths = 0.0 if path_covariance is None else jac @ np.asarray(path_covariance, np.float64) @ jac.T

    def covariance(spread: np.ndarray) -> np.ndarray:
        if count <= jac.shape[1]:  # no entries are left to estimate variances from
            return np.full((len(jac),) * 2, np.inf)
        matrix = (jac @ spread) @ (jac @ spread).T + by_paths
        matrix[touched] = matrix[:, touched] = np.nan
        matrix[touched, touched] = np.inf
        return matrix

    return Uncertainty(covariance(unequal), names, moved, covariance(equal), chi_squared)


@eqx.filter_jit
def _jacobian(free: Free, at: FreeVariables) -> Float[Array, "numbers free"]:
    """Derivatives of the fitted parts of the parameters."""
    flat, unravel = ravel_pytree(at)
    return jax.jacfwd(lambda flat: ravel_pytree(free.moved(unravel(flat)))[0])(flat)


def warn_of_misfit(noise: Noise, chi_squared: float, message: str | None) -> None:
    """Warn if noise does not explain the residual. `message`: outcome of a fit that did not converge."""
    if not chi_squared > noise.largest_by_chance:
        return
    because = "" if message is None else f", or the fit is not at its minimum ({message})"
    warnings.warn(
        f"{MISFIT} the references{because}: the residual is {chi_squared**0.5:.3g} times as large as "
        f"noise (reduced chi-squared {chi_squared:.4g}; of noise alone below {noise.largest_by_chance:.3g}). "
        "Standard errors do not cover the bias that this causes.",
        stacklevel=4,  # the caller of `fit`
    )
