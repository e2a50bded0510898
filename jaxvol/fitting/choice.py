"""Which model has as few parameters as the data support? Chooses among nested models by held-out views.

Noise enters a held-out loss L = |r|² / 2 through every pixel. Of two models, the noise is the same: with r
the residual of one and r + δ that of the other, the losses differ by |δ|² / 2 + r · δ, where δ, the
difference of the two images, is free of noise. Only r · δ is uncertain. If r is noise of mean 0, its standard
error is √ Σ (r · δ)², summed over blocks between which the noise is independent, whatever its variance; or
√ (mean r² |δ|²), if it is independent and of equal variance in all entries. The first is known badly if δ
is confined to few blocks, the second is wrong where variances differ: the larger one is used.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from .._util.checks import described, integer
from ..xla.trees import PyTree
from .candidates import Candidate
from .constraints import Free, size
from .driver import UNDETERMINED, Fit, fit
from .residuals import ImageResidual, OwnResidual, Residual, cameras_of, check_residual, not_negative


RESOLUTION = 1e-4
"""Residuals below this part of the data's norm count as equal: -80 dB. Fits in float32 end between 1e-5 and
1e-7 of it, wherever they happen to stop, and renderings agree with their float64 reference within 2e-5."""


class Evidence(NamedTuple):
    """What is known of one candidate.

    - `numbers`: of free parameters. `determined`: how many directions of these the training views determine.
    - `fit`: to the training views.
    - `held_out_loss`: mean over held-out views of half the sum of squares of the residual of each.
    - `standard_error`: of its difference from that of the best candidate; 0 for the best one.
    - `bic`: Bayesian information criterion, up to a constant that all candidates share.
    """

    name: str
    numbers: int
    determined: int
    fit: Fit
    held_out_loss: float
    standard_error: float
    bic: float


class Choice(NamedTuple):
    """Result of `choose`; `print(choice)` shows it as a table.

    - `candidates`: what is known of each, in the order given.
    - `chosen`: index of the chosen one.
    - `parameters`: the chosen fit's, as the residual takes them (`Candidate.expand`).
    """

    candidates: list[Evidence]
    chosen: int
    parameters: PyTree

    @property
    def name(self) -> str:
        """Name of the chosen candidate."""
        return self.candidates[self.chosen].name

    @property
    def fit(self) -> Fit:
        """The chosen fit."""
        return self.candidates[self.chosen].fit

    @property
    def by_bic(self) -> str:
        """Name of the candidate of the least BIC, which needs no held-out views: a second opinion."""
        return min(self.candidates, key=lambda row: row.bic).name

    def __str__(self) -> str:
        best = min(row.held_out_loss for row in self.candidates)
        least = min(row.bic for row in self.candidates)
        wide = max(len(row.name) for row in self.candidates)
        titles = "numbers", "determined", "training", "held out", "worse by", "BIC", "fit"
        lines = [f"  {'':{wide}}" + "".join(f"{title:>16}" for title in titles)]
        for at, row in enumerate(self.candidates):
            cells = (
                row.numbers,
                row.determined,
                f"{row.fit.loss:.4g}",
                f"{row.held_out_loss:.4g}",
                f"{row.held_out_loss - best:.2g} ± {row.standard_error:.1g}",
                f"+{row.bic - least:.1f}",
                "converged" if row.fit.success else "not converged",
            )
            mark = ">" if at == self.chosen else " "
            lines.append(f"{mark} {row.name:{wide}}" + "".join(f"{cell!s:>16}" for cell in cells))
        return "\n".join(lines)


def choose(
    residual: ImageResidual | Callable[[Sequence[Any]], Any] | Any,
    candidates: Sequence[Candidate] | Any,
    held_out: Sequence[Any] | Any,
    *,
    views: Sequence[Any] | Any | None = None,
    errors: float | Any = 2.0,
    resolution: float | Any = RESOLUTION,
    block: int | Any = 4,
    callback: Callable[[str, int, PyTree, float], Any] | None = None,
    checkpoint: str | PathLike[str] | None = None,
    **options: Any,
) -> Choice:
    """Fit nested models and choose the smallest that agrees with held-out views as well as the best does.

        models = jv.nested_points(jv.flat_grey(volume, 2), (2, 4, 8, 16))
        choice = jv.choose(jv.ImageResidual(scene, views[:4]), models, held_out=views[4:])
        print(choice)

    Each candidate is fitted to the training views by `fit`, in order, and evaluated on the held-out views.
    The best one has the least held-out loss L. The first candidate is chosen, which has the fewest
    parameters, with

        L - L_best ≤ `errors` · SE(L - L_best)      or      √(2 L) ≤ `resolution` · norm of the data.

    The standard error is that of noise, which all candidates share. The second condition is for data without
    noise, where the losses of all models that hold the truth differ only in where the solver stopped.

    **Arguments:**

    - `residual`: an `ImageResidual` of the training views; or `residual(views)`, a function from a list of
      views, of any kind, to what `fit` takes.
    - `candidates`: nested models, each with more free parameters than the one before, such as
      `nested_points` and `nested_materials` make.
    - `held_out`: views that none is fitted to: pairs (camera, image), or what the function takes.
    - `views`: the training views, for a function.
    - `errors`: standard errors of the difference up to which a candidate is not significantly worse, ≥ 0. If
      both models hold the truth, the larger one seems better by more than 2 in at most 2.3 % of trials.
    - `resolution`: see above, ≥ 0. The data are the training images; for a function, the norm is that of its
      residual at the first start.
    - `block`: pixels along a side of blocks within which noise may be correlated: 1 for noise of single
      pixels, more for pictures that were smoothed or compressed.
    - `callback`: `callback(name, step, parameters, loss)`, of each fit.
    - `checkpoint`: a file name. Each fit has its own: `fit-1.ckpt`, `fit-2.ckpt` for `fit.ckpt`.
    - `options`: others of `fit`, such as `max_steps`, for all candidates.

    **Returns:** a `Choice`, with the evidence for each candidate. If the largest is chosen, a larger one may
    be better still. Undetermined directions are counted there, in place of the warnings of `fit`.

    **BIC** = n ln(max(2 · loss, (`resolution` · norm)²)) + k ln n is given beside, from the training views
    alone, with n residuals and k parameters. It assumes n independent Gaussian residuals of one unknown
    variance, a fit at its optimum, and that all k directions are determined. Where errors of neighbouring
    pixels are correlated, n is too large, and BIC chooses too many parameters.

    **Where it is wrong.** How views differ from others is not in the standard error, so held-out views must
    show what later views will. Where no candidate holds the truth (images of another renderer, a wrong
    camera), the residual is not noise, and too large a model may be chosen. A fit that ends in a wrong
    minimum, or runs out of steps, counts against its model.

    **Raises:** `ValueError` for no candidates, candidates that do not grow or have no start, no held-out
    views, a view that is in both sets, and as `fit` does.
    """
    errors, resolution = (
        float(not_negative(name, value)) for name, value in (("errors", errors), ("resolution", resolution))
    )
    block = integer("block", block, 1)
    if wrong := {"constraints", "where"} & set(options):
        raise ValueError(f"{' and '.join(sorted(wrong))} must be given with each Candidate, not to choose.")
    candidates, held_out = _list("candidates", candidates), _list("held_out", held_out)
    _check(candidates)
    training, validation = _residuals(residual, views, held_out)

    fits: list[Fit] = []
    unseen: list[Float64[np.ndarray, " entries"]] = []
    count, scale, blocks = 0, 0.0, _blocks(validation, block)
    for at, candidate in enumerate(candidates):
        file = None if checkpoint is None else Path(checkpoint)
        start = candidate.start if candidate.grow is None else candidate.grow(fits[-1].parameters)
        own = _of_model(training, candidate, start)
        count, scale = own.count(), own.scale()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=UNDETERMINED)
            found = fit(
                own,
                start,
                constraints=candidate.constraints,
                where=candidate.where,
                callback=None if callback is None else partial(callback, candidate.name),
                checkpoint=None if file is None else file.with_name(f"{file.stem}-{at + 1}{file.suffix}"),
                **options,
            )
        fits.append(found)
        each = [_of_model(view, candidate, found.parameters) for view in validation]
        entries = [np.asarray(_entries(view, found.parameters), np.float64) for view in each]
        unseen.append(np.concatenate(entries) / math.sqrt(len(each)))

    losses = [float(np.sum(entries**2)) / 2 for entries in unseen]
    if not any(map(math.isfinite, losses)):
        raise ValueError("held_out must have finite residuals for one candidate at least; got none.")
    best = int(np.nanargmin(losses))
    norm = scale or math.sqrt(2 * fits[0].losses[0])
    floor = (resolution * norm) ** 2
    rows, chosen = [], best
    for at, (candidate, found, loss) in enumerate(zip(candidates, fits, losses, strict=True)):
        error = standard_error(unseen[at], unseen[best], blocks)
        if loss - losses[best] <= errors * error or 2 * loss <= floor:
            chosen = min(chosen, at)
        free = size(found.solution.value)
        undetermined = found.uncertainty.undetermined if found.uncertainty else []
        squares = max(2 * found.loss, floor, np.finfo(float).tiny)
        bic = count * math.log(squares) + free * math.log(count)
        rows.append(Evidence(candidate.name, free, free - len(undetermined), found, loss, error, bic))
    return Choice(rows, chosen, candidates[chosen].expand(fits[chosen].parameters))


def standard_error(
    residual: Float64[np.ndarray, " entries"],
    best: Float64[np.ndarray, " entries"],
    blocks: Int[np.ndarray, " entries"] | None,
) -> float:
    """Of the difference of a loss from that of the best residual. `blocks`: of each entry; by default each is
    a block of its own."""
    change = residual - best
    uncertain = best * change if blocks is None else np.bincount(blocks, best * change)
    return math.sqrt(max(float(np.sum(uncertain**2)), float(np.mean(best**2) * np.sum(change**2))))


class _Expanded(eqx.Module):
    """A function of what a candidate's parameters expand to, as one of these parameters."""

    function: Callable[..., Any]
    expand: Callable[[PyTree], PyTree]

    def __call__(self, parameters: PyTree, *more: Any) -> Any:
        return self.function(self.expand(parameters), *more)


def _of_model(residual: Any, candidate: Candidate, parameters: PyTree) -> Residual:
    """The residual as one of a candidate's own parameters."""
    if isinstance(residual, ImageResidual):
        return eqx.tree_at(lambda r: r.scene, residual, replace_fn=lambda f: _Expanded(f, candidate.expand))
    return OwnResidual.of(_Expanded(residual, candidate.expand), parameters)


@eqx.filter_jit
def _entries(residual: Residual, parameters: PyTree) -> Float[Array, " entries"]:
    (tiles,) = residual.tiles(residual.count())
    return jax.lax.map(lambda item: tiles.residual(parameters, item, "replay"), tiles.items).reshape(-1)


def _blocks(views: list[Any], block: int) -> Int[np.ndarray, " entries"] | None:
    """Which square of pixels each entry of images belongs to, with all channels; None for other residuals."""
    found, first = list[np.ndarray](), 0
    for view in views:
        if not isinstance(view, ImageResidual):
            return None
        _, height, width, channels = view.groups[0].images.shape
        rows, columns = np.arange(height) // block, np.arange(width) // block
        found.append(first + np.repeat(rows[:, None] * (columns[-1] + 1) + columns, channels))
        first = int(found[-1].max()) + 1
    if first < 2:
        raise ValueError(f"block must leave two blocks of the held-out views at least; got {block}.")
    return np.concatenate(found)


def _list(name: str, given: Any) -> list[Any]:
    if not isinstance(given, list | tuple) or isinstance(given, Candidate) or not given:
        raise ValueError(f"{name} must be a list of at least one; got {described(given)}.")
    return list(given)


def _check(candidates: list[Any]) -> None:
    """Check candidates before any is fitted, by growing each from the start of the one before."""
    start, numbers = None, 0
    for at, candidate in enumerate(candidates):
        if not isinstance(candidate, Candidate):
            raise ValueError(f"candidates[{at}] must be a Candidate; got {described(candidate)}.")
        if (candidate.start is None) == (candidate.grow is None) or (at == 0 and candidate.start is None):
            have = "a start, since none is before it" if at == 0 else "either a start or grow"
            raise ValueError(f"candidates[{at}], {candidate.name!r}, must have {have}.")
        start = candidate.start if candidate.grow is None else candidate.grow(start)
        _, free = Free.of(start, candidate.constraints, candidate.where)
        before, numbers = numbers, size(free)
        if numbers <= before:
            raise ValueError(
                "candidates must be in order, each with more free parameters than the one before; "
                f"{candidate.name!r} has {numbers}, and {candidates[at - 1].name!r} {before}."
            )


def _residuals(residual: Any, views: Any, held_out: list[Any]) -> tuple[Any, list[Any]]:
    """The residual of the training views, and that of each held-out view."""
    if isinstance(residual, ImageResidual):
        if views is not None:
            raise ValueError("views must not be given with an ImageResidual, which has views of its own.")
        how = {"background": residual.background, "compositing": residual.compositing}
        training, validation = residual, [ImageResidual(residual.scene, [view], **how) for view in held_out]
        # another picture by the same camera tells nothing of other views
        fitted, unseen = cameras_of(training), [cameras_of(view)[0] for view in validation]
    else:
        check_residual(residual)
        if views is None:
            raise ValueError("views must be given with a function residual(views): those that are fitted.")
        fitted, unseen = _list("views", views), held_out
        training, validation = residual(fitted), [residual([view]) for view in unseen]
    for at, view in enumerate(unseen):
        for other, seen in enumerate(fitted):
            if eqx.tree_equal(view, seen):
                raise ValueError(
                    f"held_out[{at}] must not be among the views that are fitted; it is the same as number "
                    f"{other} of these. Hold out views of other cameras."
                )
    return training, validation
