"""Which model has as few parameters as the data support? Chooses among nested models by held-out views."""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from .._util.checks import described, integer, number, require
from ..xla.trees import PyTree
from .candidates import Candidate
from .constraints import Free, size
from .driver import UNDETERMINED, Fit, Outcome, fit
from .held_out import HeldOut, ModelResidual, as_residual, cameras_of, check_apart, data_norm
from .residuals import ImageResidual, Residual, check_residual


RESOLUTION = 1e-4
"""Residuals below this part of the data's norm count as equal: -80 dB. Fits in float32 end between 1e-5 and
1e-7 of it, wherever they happen to stop, and renderings agree with their float64 reference within 2e-5."""


NEARLY = 1e-3
"""Part of a loss by which that of a larger model may exceed it: a start within 1/1000 of a bound is moved."""


class Evidence(NamedTuple):
    """What is known of one candidate.

    - `numbers`: of free parameters.
    - `fit`: to the training views.
    - `training_loss`: half the sum of squares of the residual of the training views.
    - `held_out_loss`, `standard_error`: mean over held-out views of the same, for each view alone.
    - `excess`, `excess_error`: held-out loss minus that of the best candidate, with the standard error of the
      difference.
    - `bic`: Bayesian information criterion, up to a constant that all candidates share.
    - `supported`: whether its held-out loss is not significantly worse than the best.
    """

    name: str
    numbers: int
    fit: Fit
    training_loss: float
    held_out_loss: float
    standard_error: float
    excess: float
    excess_error: float
    bic: float
    supported: bool

    @property
    def ended(self) -> str:
        """How its fit ended, in a word: `converged`, `stalled`, `max_steps` or `failed`."""
        result = self.fit.solution.result
        words = {
            "converged": Outcome.successful,
            "stalled": Outcome.stalled,
            "max_steps": Outcome.nonlinear_max_steps_reached,
        }
        return next((word for word, outcome in words.items() if bool(result == outcome)), "failed")

    @property
    def undetermined(self) -> int:
        """Number of directions that the training views do not determine."""
        return 0 if self.fit.uncertainty is None else len(self.fit.uncertainty.undetermined)


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
        least = min(row.bic for row in self.candidates)
        header = ("", "numbers", "training", "held out", "worse by", "BIC", "fit", "undetermined")
        rows = [header] + [
            (
                ("> " if at == self.chosen else "  ") + row.name,
                str(row.numbers),
                f"{row.training_loss:.4g}",
                f"{row.held_out_loss:.4g} ± {row.standard_error:.1g}",
                f"{row.excess:.2g} ± {row.excess_error:.1g}" if row.excess else "best",
                f"+{row.bic - least:.1f}" if row.bic > least else "least",
                row.ended,
                str(row.undetermined),
            )
            for at, row in enumerate(self.candidates)
        ]
        wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(
                cell.ljust(n) if at == 0 else cell.rjust(n)
                for at, (cell, n) in enumerate(zip(row, wide, strict=True))
            )
            for row in rows
        ]
        return "\n".join(lines + self._notes())

    def _notes(self) -> list[str]:
        """What the table does not say by itself."""
        rows, notes = self.candidates, []
        if self.chosen == len(rows) - 1 > 0:
            notes.append("The largest candidate is chosen: a larger one may be better still.")
        for smaller, row in pairwise(rows):
            if row.training_loss > (1 + NEARLY) * smaller.training_loss and not row.supported:
                notes.append(
                    f"{row.name} fits the training views worse than {smaller.name}: it does not hold that "
                    "model, or its fit ended elsewhere than at the minimum."
                )
        return notes


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
    The best one has the least held-out loss L. A candidate is supported if

        L - L_best ≤ `errors` · SE(L - L_best)      or      √(2 L) ≤ `resolution` · norm of the held-out data,

    and the supported one with the fewest parameters is chosen. With δ the difference of the two images and
    r the best residual, L - L_best = |δ|² / 2 + r · δ; its standard error is √ Σ (r · δ)², summed over blocks
    of pixels, or √ (mean r² |δ|²), whichever is larger. The second condition is for data without noise, where
    losses of all models that hold the truth differ only in where the solver stopped.

    **Arguments:**

    - `residual`: an `ImageResidual` of the training views; or `residual(views)`, a function from a list of
      views, of any kind, to what `fit` takes.
    - `candidates`: nested models, each with more free parameters than the one before, such as
      `nested_points` and `nested_materials` make.
    - `held_out`: views that none is fitted to: pairs (camera, image), or what the function takes.
    - `views`: the training views, for a function.
    - `errors`: standard errors of the difference up to which a candidate is not significantly worse, ≥ 0. If
      both models hold the truth, the larger one seems better by more than 2 in at most 2.3 % of trials.
      Fewer tend to larger models.
    - `resolution`: see above, ≥ 0; for a function, relative to the norm of the residual at the first start.
    - `block`: pixels along a side of the blocks. Noise is taken as independent between blocks and may be
      correlated within one: 1 for noise of single pixels, more for pictures that were smoothed or compressed.
    - `callback`: `callback(name, step, parameters, loss)`, of each fit.
    - `checkpoint`: a file name. Each fit has its own, `fit-1.ckpt`, `fit-2.ckpt` for `fit.ckpt`. The same
      call continues from there; fits that had ended are not repeated.
    - `options`: others of `fit`, such as `max_steps` and `progress`, for all candidates.

    **Returns:** a `Choice`, with the evidence for each candidate. See there how each fit ended: the losses of
    one that ran out of steps, or failed, may be larger than those of its model. Undetermined directions are
    counted there, in place of the warnings of `fit`.

    **BIC** = n ln(max(2 · loss, (`resolution` · norm)²)) + k ln n is given beside, from the training views
    alone, with n residuals and k parameters. It assumes n independent Gaussian residuals of one unknown
    variance, a fit at its optimum, and that all k directions are determined. Where errors of neighbouring
    pixels are correlated, n is too large, and BIC chooses too many parameters.

    **Where it is wrong.** The standard error is that of noise in these views; how views differ from others is
    not in it, so held-out views must show what later views will. Where no candidate holds the truth (images
    of another renderer, a wrong camera), r is not noise but correlated over more than a block, and too large
    a model may be chosen. The best of many candidates is best partly by chance: its loss is optimistic, and
    so are standard errors of the chosen fit, which take the model as given. A fit that ends in a wrong
    minimum counts against its model.

    **Raises:** `ValueError` for no candidates, candidates that do not grow or have no start, no held-out
    views, a view that is in both sets, and as `fit` does.
    """
    errors, resolution = _at_least_0("errors", errors), _at_least_0("resolution", resolution)
    block = integer("block", block, 1)
    if wrong := {"constraints", "where"} & set(options):
        raise ValueError(f"{' and '.join(sorted(wrong))} must be given with each Candidate, not to choose.")
    candidates = _list("candidates", candidates)
    start = _check(candidates)
    training, validation = _residuals(residual, views, _list("held_out", held_out), start)
    judge = HeldOut(validation, block)
    if judge.blocks < 2:
        raise ValueError(f"block must leave two blocks of the held-out views at least; got {block}.")

    fits: list[Fit] = []
    for at, candidate in enumerate(candidates):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=UNDETERMINED)
            found = fit(
                ModelResidual(training, candidate.expand),
                candidate.start if candidate.grow is None else candidate.grow(fits[-1].parameters),
                constraints=candidate.constraints,
                where=candidate.where,
                callback=None if callback is None else partial(callback, candidate.name),
                checkpoint=None if checkpoint is None else _numbered(Path(checkpoint), at + 1),
                **options,
            )
        fits.append(found)

    residuals = [judge.residual(f.parameters, c.expand) for c, f in zip(candidates, fits, strict=True)]
    at_start = judge.residual(candidates[0].start, candidates[0].expand)
    norms = (
        data_norm([training]) or math.sqrt(2 * fits[0].losses[0]),
        data_norm(validation) or math.sqrt(2 * judge.loss(at_start)[0]),
    )
    rows = _evidence(candidates, fits, residuals, judge, training.count(), norms, errors, resolution)
    chosen = [row.supported for row in rows].index(True)
    return Choice(rows, chosen, candidates[chosen].expand(rows[chosen].fit.parameters))


def _evidence(
    candidates: list[Candidate],
    fits: list[Fit],
    residuals: list[Float64[np.ndarray, " entries"]],
    judge: HeldOut,
    count: int,
    norms: tuple[float, float],
    errors: float,
    resolution: float,
) -> list[Evidence]:
    """The table, with the rule of `choose`. `norms`: of the data in training and held-out views."""
    of_training, of_held_out = (resolution * norm for norm in norms)
    losses = [judge.loss(residual) for residual in residuals]
    if not any(math.isfinite(loss) for loss, _ in losses):
        raise ValueError("held_out must have finite residuals for one candidate at least; got none.")
    best = residuals[int(np.nanargmin([loss for loss, _ in losses]))]
    rows = []
    for candidate, found, residual, of_row in zip(candidates, fits, residuals, losses, strict=True):
        numbers, (excess, excess_error) = size(found.solution.value), judge.excess(residual, best)
        within = excess <= errors * excess_error or math.sqrt(2 * of_row[0]) <= of_held_out
        squares = max(2 * found.loss, of_training**2, np.finfo(float).tiny)
        bic = count * math.log(squares) + numbers * math.log(count)
        rows.append(
            Evidence(candidate.name, numbers, found, found.loss, *of_row, excess, excess_error, bic, within)
        )
    return rows


def _at_least_0(name: str, value: Any) -> float:
    return float(require(number(name, value), lambda v: v >= 0, f"{name} must be at least 0; got {{got}}."))


def _list(name: str, given: Any) -> list[Any]:
    """`given` as a list that is not empty."""
    if not isinstance(given, list | tuple) or isinstance(given, Candidate):
        raise ValueError(f"{name} must be a list; got {described(given)}.")
    found = list(given)
    if not found:
        raise ValueError(f"{name} must hold at least one; got none.")
    return found


def _check(candidates: list[Any]) -> PyTree:
    """Check candidates before any is fitted, by growing each from the start of the one before.

    **Returns:** what the residual takes, at the first start."""
    start, numbers = None, 0
    for at, candidate in enumerate(candidates):
        if not isinstance(candidate, Candidate):
            raise ValueError(f"candidates[{at}] must be a Candidate; got {described(candidate)}.")
        if (candidate.start is None) == (candidate.grow is None) or (at == 0 and candidate.start is None):
            raise ValueError(
                f"candidates[{at}], {candidate.name!r}, must have "
                + ("a start, since none is before it." if at == 0 else "either a start or grow.")
            )
        start = candidate.start if candidate.grow is None else candidate.grow(start)
        _, free = Free.of(start, candidate.constraints, candidate.where)
        before, numbers = numbers, size(free)
        if numbers <= before:
            raise ValueError(
                "candidates must be in order, each with more free parameters than the one before; "
                f"{candidate.name!r} has {numbers}, and {candidates[at - 1].name!r} {before}."
            )
    names = [candidate.name for candidate in candidates]
    if len(set(names)) < len(names):
        raise ValueError(f"candidates must have different names; got {names}.")
    return candidates[0].expand(candidates[0].start)


def _residuals(
    residual: Any, views: Any, held_out: list[Any], start: PyTree
) -> tuple[Residual, list[Residual]]:
    """The residual of the training views, and that of each held-out view."""
    if isinstance(residual, ImageResidual):
        if views is not None:
            raise ValueError("views must not be given with an ImageResidual, which has views of its own.")
        check_apart([(camera, None) for camera in cameras_of(residual)], held_out)
        like = partial(
            ImageResidual,
            residual.scene,
            background=residual.background,
            compositing=residual.compositing,
        )
        return residual, [like([view]) for view in held_out]
    check_residual(residual)
    if views is None:
        raise ValueError(
            "views must be given with a function residual(views): those that candidates are fitted to."
        )
    training = _list("views", views)
    check_apart(training, held_out)
    return as_residual(residual(training), start), [as_residual(residual([v]), start) for v in held_out]


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}-{number}{path.suffix}")
