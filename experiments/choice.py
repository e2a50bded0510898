"""Which model has as few parameters as the data support? Chooses among nested models by held-out views.

Noise enters a held-out loss L = |r|² / 2 through every pixel. Of two models the noise is the same: with r the
residual of one and r + δ that of the other, the losses differ by |δ|² / 2 + r · δ, where δ, the difference of
the two images, is free of noise. Only r · δ is uncertain. If r is noise of mean 0, its standard error is
√ Σ (r · δ)², summed over blocks between which the noise is independent, whatever its variance; or
√ (mean r² |δ|²), if it is independent and of equal variance in all entries. The first is known badly if δ
is confined to few blocks, the second is wrong where variances differ: the larger one is used.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

import jaxvol as jv
from jaxvol import Fit, ImageResidual, fit
from jaxvol.fitting.constraints import Free, Where, size
from jaxvol.fitting.driver import UNDETERMINED
from jaxvol.fitting.uncertainty import MISFIT
from jaxvol.xla.trees import PyTree


RESOLUTION = 1e-4
"""Residuals below this fraction of the data's norm count as equal."""


def refined(transfer: jv.TransferFunction, points: int) -> jv.TransferFunction:
    """The same transfer function with more control points: each new one goes where the gap is widest, and
    those of one gap divide it evenly, so that even points stay even from n to 2n - 1."""
    values = np.asarray(transfer.values)
    gaps = np.diff(values.astype(float))
    pieces = np.ones(len(gaps), int)
    for _ in range(points - len(values)):
        pieces[np.argmax(gaps / pieces)] += 1

    def divided(rows: Any) -> np.ndarray:
        rows = np.asarray(rows)
        each = zip(pairwise(rows), pieces, strict=True)
        return np.concatenate([*(np.linspace(a, b, n, endpoint=False) for (a, b), n in each), rows[-1:]])

    rows = divided(values), divided(transfer.colors), divided(transfer.extinction)
    return jv.TransferFunction(*rows, per_voxel=transfer.per_voxel)


class Candidate(NamedTuple):
    """A model that `choose` may choose.

    Attributes:
        name: in the table of results.
        start: the parameters that its fit starts from, as for `fit`; or
        grow: `grow(found)` makes them from the fitted parameters of the candidate before. Give one of the
            two.
        expand: `expand(parameters)` is what the residual takes; by default the parameters themselves.
        constraints: as for `fit`, of the model's own parameters.
        where: as for `fit`, of the model's own parameters.
    """

    name: str
    start: PyTree = None
    grow: Callable[[PyTree], PyTree] | None = None
    expand: Callable[[PyTree], PyTree] = lambda parameters: parameters
    constraints: PyTree = None
    where: Where | None = None


def nested_points(
    start: jv.TransferFunction, points: Sequence[int] = (2, 4, 8, 16), **fields: Any
) -> list[Candidate]:
    """Candidates that are transfer functions of increasing numbers of control points, each of which keeps
    those of the one before. `start`: as the first fit starts, but for its number of points. `fields`: of each
    `Candidate`."""
    first = Candidate(f"{points[0]} points", refined(start, points[0]), **fields)
    larger = (Candidate(f"{n} points", grow=partial(refined, points=n), **fields) for n in points[1:])
    return [first, *larger]


class Evidence(NamedTuple):
    """What is known of one candidate.

    Attributes:
        name: that of the candidate.
        numbers: number of free parameters.
        determined: how many directions of these the training views determine.
        fit: to the training views.
        held_out_loss: mean over held-out views of half the sum of squares of the residual of each.
        standard_error: of its difference from that of the best candidate; 0 for the best one.
    """

    name: str
    numbers: int
    determined: int
    fit: Fit
    held_out_loss: float
    standard_error: float


class Choice(NamedTuple):
    """Result of `choose`; `print(choice)` shows it as a table.

    Attributes:
        candidates: what is known of each, in the order given.
        chosen: index of the chosen one.
        parameters: the chosen fit's, as the residual takes them (`Candidate.expand`).
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

    def __str__(self) -> str:
        best = min(row.held_out_loss for row in self.candidates)
        wide = max(len(row.name) for row in self.candidates)
        titles = "numbers", "determined", "training", "held out", "worse by", "fit"
        lines = [f"  {'':{wide}}" + "".join(f"{title:>16}" for title in titles)]
        for at, row in enumerate(self.candidates):
            worse = f"{row.held_out_loss - best:.2g} ± {row.standard_error:.1g}"
            losses = f"{row.fit.loss:.4g}", f"{row.held_out_loss:.4g}", worse
            ended = "converged" if row.fit.success else "not converged"
            cells = "".join(f"{cell!s:>16}" for cell in (row.numbers, row.determined, *losses, ended))
            lines.append(f"{'>' if at == self.chosen else ' '} {row.name:{wide}}{cells}")
        return "\n".join(lines)


def choose(
    residual: Callable[[list[Any]], Any],
    candidates: Sequence[Candidate],
    held_out: Sequence[Any],
    *,
    views: Sequence[Any],
    errors: float = 2.0,
    block: int = 4,
    **options: Any,
) -> Choice:
    """Fit nested models and choose the smallest that agrees with held-out views as well as the best does.

        models = nested_points(jv.flat_grey(volume, 2), (2, 4, 8, 16))
        residual = lambda some: jv.ImageResidual(scene, some)
        choice = choose(residual, models, views=views[:4], held_out=views[4:])
        print(choice)

    Each candidate is fitted to the training views, and evaluated on the held-out views. The best one has the
    least held-out loss L. The first one is chosen with

        L - L_best ≤ `errors` · SE(L - L_best)      or      √(2 L) ≤ 1e-4 · norm of the data.

    The standard error is that of noise, which all candidates share. The second condition is for data without
    noise: fits in float32 end between 1e-5 and 1e-7 of the norm, wherever they happen to stop. The data are
    the training images; for a function, the norm is that of its residual at the first start.

    How views differ from others is not in the standard error: held-out views must show what later views will.
    Where no candidate holds the truth (images of another renderer, a wrong camera), the residual is not
    noise, and too large a model may be chosen. A fit that ends in a wrong minimum counts against its model.

    Args:
        residual: `residual(views)`, from a list of views, of any kind, to what `fit` takes.
        candidates: nested models, each with more free parameters than the one before, such as
            `nested_points` makes.
        held_out: views that none is fitted to.
        views: the training views.
        errors: standard errors of the difference up to which a candidate is not significantly worse, ≥ 0. If
            both models hold the truth, the larger one seems better by more than 2 in at most 2.3 % of trials.
        block: pixels along a side of blocks within which noise may be correlated: 1 for noise of single
            pixels, more for pictures that were smoothed or compressed.
        options: others of `fit`, such as `max_steps`, for all candidates.

    Returns:
        A `Choice`, with the evidence for each candidate. If the largest is chosen, a larger one may be better
        still. Undetermined directions are counted there, in place of the warnings of `fit`; whether a model
        fits is in `fit.uncertainty.reduced_chi_squared`.

    Raises:
        ValueError: for candidates that do not grow, a view that is in both sets, and as `fit` does.
    """
    if any(eqx.tree_equal(view, other) for view in held_out for other in views):
        raise ValueError("held_out must not be among the views that are fitted; one of them is.")
    _check(candidates)
    training: Any = residual(list(views))
    validation: list[Any] = [residual([view]) for view in held_out]

    fits: list[Fit] = []
    found: list[list[np.ndarray]] = []
    for candidate in candidates:
        start = candidate.start if candidate.grow is None else candidate.grow(fits[-1].parameters)
        how = {**options, "constraints": candidate.constraints, "where": candidate.where}
        with warnings.catch_warnings():
            for message in (UNDETERMINED, MISFIT):
                warnings.filterwarnings("ignore", message=message)
            fits.append(fit(_of_model(training, candidate), start, **how))
        entries = (_entries(_of_model(view, candidate), fits[-1].parameters) for view in validation)
        found.append([np.asarray(each, np.float64) for each in entries])

    losses = [sum(float(np.sum(each**2)) for each in of_views) / 2 / len(of_views) for of_views in found]
    best, images = int(np.nanargmin(losses)), isinstance(training, ImageResidual)
    count = sum(view.references.count for view in validation) if images else None
    norm = training.references.scale() if images else math.sqrt(2 * fits[0].losses[0])
    rows, chosen = [], best
    for at, (candidate, own, loss) in enumerate(zip(candidates, fits, losses, strict=True)):
        error = standard_error(found[at], found[best], block, count)
        if loss - losses[best] <= errors * error or 2 * loss <= (RESOLUTION * norm) ** 2:
            chosen = min(chosen, at)
        numbers = size(own.solution.value)
        undetermined = own.uncertainty.undetermined if own.uncertainty else []
        rows.append(Evidence(candidate.name, numbers, numbers - len(undetermined), own, loss, error))
    return Choice(rows, chosen, candidates[chosen].expand(fits[chosen].parameters))


def standard_error(
    residuals: list[np.ndarray], best: list[np.ndarray], block: int, count: int | None = None
) -> float:
    """Of the difference of a mean loss from that of the best. Residuals of views are (entries,), or (height,
    width, channels), where noise may be correlated within blocks. `count`: of entries, if not all count."""
    of_blocks = []
    for residual, least in zip(residuals, best, strict=True):
        products = least * (residual - least)
        if products.ndim == 3:
            for axis in (0, 1):
                products = np.add.reduceat(products, range(0, products.shape[axis], block), axis)
            products = products.sum(axis=-1)
        of_blocks.append(products.ravel())
    flat, least = (np.concatenate([view.ravel() for view in views]) for views in (residuals, best))
    equal = np.sum(least**2) / (count or least.size) * np.sum((flat - least) ** 2)
    return math.sqrt(max(np.sum(np.concatenate(of_blocks) ** 2), equal)) / len(best)


class _Expanded(eqx.Module):
    """A function of what a candidate's parameters expand to, as one of these parameters."""

    function: Callable[..., Any]
    expand: Callable[[PyTree], PyTree]

    def __call__(self, parameters: PyTree, *more: Any) -> Any:
        return self.function(self.expand(parameters), *more)


def _of_model(residual: Any, candidate: Candidate) -> Any:
    """The residual as one of a candidate's own parameters."""
    if not isinstance(residual, ImageResidual):
        return _Expanded(residual, candidate.expand)
    return eqx.tree_at(lambda r: r.scene, residual, replace_fn=lambda f: _Expanded(f, candidate.expand))


@eqx.filter_jit
def _entries(residual: Any, parameters: PyTree) -> Array:
    """Of one view; (height, width, channels) of an image."""
    if not isinstance(residual, ImageResidual):
        return ravel_pytree(residual(parameters))[0]
    ((function, items),) = residual.tiles(residual.references.size())
    entries = jax.lax.map(lambda item: function(parameters, item, "replay"), items)
    return entries.reshape(residual.references.groups[0][1].shape[1:])


def _check(candidates: Sequence[Candidate]) -> None:
    """Checks that candidates grow before any is fitted, from the start of the one before."""
    start, numbers = None, 0
    for candidate in candidates:
        start = candidate.start if candidate.grow is None else candidate.grow(start)
        before, numbers = numbers, size(Free.of(start, candidate.constraints, candidate.where)[1])
        if numbers <= before:
            raise ValueError(
                "candidates must be in order, each with more free parameters than the one before; "
                f"{candidate.name!r} has {numbers} after {before}."
            )
