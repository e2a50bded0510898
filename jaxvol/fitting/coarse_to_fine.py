"""Fits from starts that are off by more than the size of features: images blurred at first, sharp at last."""

from collections.abc import Sequence
from typing import Any

from .._util.checks import Arrayable, described
from ..xla.trees import PyTree
from .driver import Fit, fit
from .residuals import ImageResidual


BLURS = (1 / 8, 1 / 32, None)


def fit_coarse_to_fine(
    residual: ImageResidual | Any,
    parameters: PyTree,
    *,
    blurs: Sequence[Arrayable | None] | Any = BLURS,
    **options: Any,
) -> list[Fit]:
    """Fit parameters to images blurred less and less, each time from where the last fit ended.

    A derivative describes only features that move by less than their own size. In blurred images features are
    large, so that a pose or a geometry is found from farther away; sharp images at last make it exact. Steps
    must be of a voxel or shorter: under longer ones, fine texture is sampled too sparsely, and fits stall
    (`experiments/results/README.md`, "The geometry of a probe").

    **Arguments:**

    - `residual`: an `ImageResidual`. Its own `blur` is not used.
    - `parameters`: the starting point.
    - `blurs`: of each fit, in order, as `ImageResidual`'s. End with None: only the standard errors of an
      unblurred fit are right.
    - `options`: those of `fit`, for all of them, but for `checkpoint`. A `patience` of 4 saves steps.

    **Returns:** the fits, in order. The last one's `parameters` and `uncertainty` are the result.

    **Raises:** `ValueError` for no blurs, for what is not an `ImageResidual`, for `checkpoint`, and as `fit`.
    """
    if not isinstance(residual, ImageResidual):
        raise ValueError(f"residual must be an ImageResidual, to be blurred; got {described(residual)}.")
    if len(blurs) == 0:
        raise ValueError("blurs must hold at least one, such as None; got none.")
    if "checkpoint" in options:
        raise ValueError("checkpoint is of one fit: call fit with ImageResidual(..., blur=) for each stage.")
    fits: list[Fit] = []
    for blur in blurs:
        fits.append(fit(residual.blurred(blur), parameters, **options))
        parameters = fits[-1].parameters
    return fits
