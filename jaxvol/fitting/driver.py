"""Fits parameters by minimising a residual, step by step, with a solver of Optimistix."""

import math
import numbers
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._util.checks import integer, output_file
from ..xla.trees import PyTree
from . import checkpoints
from .constraints import Free, FreeVariables, Where
from .damping import LevenbergMarquardt
from .residuals import OwnResidual, Problem, Residual, check_residual, tile_entries
from .uncertainty import Uncertainty, uncertainty


Solver: TypeAlias = Literal["levenberg_marquardt", "gauss_newton", "bfgs", "adam"]

OptimistixSolver: TypeAlias = (
    optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | optx.AbstractMinimiser[Any, Any, Any]
)

UNDETERMINED = ".*directions are not determined"
"""Pattern of the warning that names such directions, for those who tell it otherwise."""

LEARNING_RATE = 0.03
"""Learning rate of `"adam"`, in free variables, which are of order 1."""

SELDOM = 9
"""Times as long as a checkpoint took, until the next one."""


class Outcome(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How a fit ended: Optimistix's results, and `stalled`."""

    stalled = (
        "No step lowered the loss by more than rtol any more: either a minimum, to the precision of the "
        "float type, or a point where the derivative does not predict how the loss changes."
    )


class Fit(eqx.Module):
    """Result of a fit.

    - `parameters`: the best ones found, as a tree like the starting parameters.
    - `solution`: Optimistix's, with `value` (the free variables), `result`, `state` and `stats`.
    - `losses`: half the sum of squared residuals at the solver's point after each step.
    - `uncertainty`: `covariance`, `names`, `standard_errors` and `undetermined` directions, for a
      least-squares solver; else None.
    """

    parameters: PyTree
    solution: optx.Solution[Any, Any]
    losses: Float[np.ndarray, " steps"]
    uncertainty: Uncertainty | None

    @property
    def loss(self) -> float:
        """Half the sum of squared residuals at `parameters`."""
        return float(np.nanmin(self.losses))

    @property
    def success(self) -> bool:
        """Whether the solver converged to its tolerances."""
        return bool(self.solution.result == Outcome.successful)

    @property
    def message(self) -> str:
        """How the fit ended, in words."""
        if self.success:
            return "The solver converged."
        # Optimistix's text for this names causes that do not apply to fits
        if self.solution.result == Outcome.nonlinear_max_steps_reached:
            return "The fit reached the maximum number of steps, max_steps, before it converged."
        return Outcome[self.solution.result]


def fit(
    residual: Residual | Callable[[Any], PyTree] | Any,
    parameters: PyTree,
    *,
    solver: Solver | OptimistixSolver | Any = "levenberg_marquardt",
    constraints: PyTree = None,
    where: Where | None = None,
    rtol: float = 1e-4,
    atol: float = 1e-6,
    max_steps: int | Any = 100,
    patience: int | Any | None = None,
    max_jacobian: int | Any = 2**30,
    callback: Callable[[int, PyTree, float], Any] | None = None,
    checkpoint: str | PathLike[str] | None = None,
) -> Fit:
    """Fit parameters to make a residual small: the loss is half the sum of its squares.

    **Arguments:**

    - `residual`: an `ImageResidual`, or a function from parameters to arrays. A function that renders
      must use `adjoint="forward"` for the first two solvers and `"replay"` for the others.
    - `parameters`: the starting point: any tree, such as a `TransferFunction`, a `Camera` or a dict. Its
      float arrays are fitted.
    - `solver`:
        - `"levenberg_marquardt"`, `"gauss_newton"`: least squares, with forward-mode Jacobians. Start
          with the first, up to a few hundred parameters.
        - `"bfgs"`: needs only the gradient, and a matrix of parameters × parameters.
        - `"adam"`: gradient descent with Optax (`pip install "jaxvol[fit]"`), for large arrays.
        - any least-squares solver or minimiser of Optimistix, or a transformation of Optax; `rtol` and
          `atol` are then the solver's own where it has them.
    - `constraints`: a tree like the parameters, or a prefix of one, with a bijection at each leaf: None for
      the default, `Fixed()`, `Unconstrained()`, `Positive()`, `UnitInterval()`, `Pose(camera)`,
      `ProbeGeometry(probe)`. The defaults are, for a transfer function, positive extinction, colours in
      [0, 1] and fixed values; for a camera, its pose; for a `ToroidalMap`, its geometry; for a volume,
      unconstrained data if they are float; for a material, a positive mean free path, and all else fixed;
      for a march, all fixed; any other float array is unconstrained.
    - `where`: the free parts, `where(parameters)` as for `equinox.tree_at`; everything else stays fixed. For
      example `lambda transfer: transfer.extinction`, or a tuple of parts.
    - `rtol`, `atol`: a fit has converged when neither the free variables nor the residual change by more
      than this in a step.
    - `max_steps`: maximum number of steps. Each evaluates residual and derivative, even if it is rejected.
    - `patience`: number of steps after which a fit has stalled if the loss has not fallen by more than
      `rtol`, relatively; by default 10, or 100 for Optax.
    - `max_jacobian`: bytes. A least-squares solver holds only as many rows of the Jacobian at once as fit
      (m rows of n parameters need 4 m (n + 1) bytes), and no more than those of one image.
    - `callback`: `callback(step, parameters, loss)` after each step but the first, which evaluates the start.
    - `checkpoint`: a file to which the state is written after steps, as often as takes a tenth of the time,
      and when the fit ends or is interrupted. If it exists, the fit continues from it and ends with the same
      parameters, bit for bit, as an uninterrupted fit (on the same machine).

    **Returns:** a `Fit`. If the solver fails, stalls or runs out of steps, `Fit.success`, `Fit.message` and
    `Fit.solution.result` say so, and the parameters are the best ones found. A warning names directions that
    the residual does not determine.

    A fit whose rays are opaque from their first cell on may end in a wrong minimum. Where fits fail, and
    where not: `experiments/stability.py`, "fits of what images do not show", "fits from opaque starts",
    "fits under noise".

    **Raises:** `ValueError` for incompatible arguments, parameters that are not finite or out of bounds, a
    residual that is not finite at the start, a checkpoint that is damaged or of another fit, and one that
    cannot be written; `ImportError` if Optax is requested but not installed.
    """
    for name, value in (("rtol", rtol), ("atol", atol)):
        if not (isinstance(value, numbers.Real) and math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be a finite number of at least 0; got {value!r}.")
    check_residual(residual)
    file = None if checkpoint is None else output_file("checkpoint", checkpoint)
    max_steps, max_jacobian = integer("max_steps", max_steps, 1), integer("max_jacobian", max_jacobian, 1)
    solver, default_patience = _solver(solver, rtol, atol)
    patience = default_patience if patience is None else integer("patience", patience, 1)
    free, y = Free.of(parameters, constraints, where)
    if not isinstance(residual, Residual):
        residual = OwnResidual.of(residual, free.forward(y))
    least_squares = isinstance(solver, optx.AbstractLeastSquaresSolver)
    problem = Problem(residual, free, tile_entries(residual, y, max_jacobian, least_squares))

    state, done = _init_state(solver, problem, y), jnp.zeros((), bool)
    run = _Run(y, state, y, y, None, done, optx.RESULTS.successful, [])
    run = run.step(solver, problem)
    if not math.isfinite(run.losses[0]):
        raise ValueError(
            "residual must be finite at the parameters that the fit starts from; half the sum of its squares "
            f"is {run.losses[0]}."
        )
    kinds = [type(bijection).__name__ for bijection in free.bijections]
    about = {
        "solver": type(solver).__name__,
        "parameters": [f"{path}: {kind}" for path, kind in zip(free.paths, kinds, strict=True)],
        "number of residuals": residual.count(),
        "loss at the start": run.losses[0],
    }
    if file is not None and (found := checkpoints.load(file, run, about)) is not None:
        run = replace(found[0], losses=found[1]["losses"])
    due = 0.0
    try:
        while (result := run.ended(max_steps, patience, rtol)) is None:
            run = run.step(solver, problem)
            if callback is not None:
                callback(len(run.losses), free.forward(run.evaluated), run.losses[-1])
            if file is not None and (begun := time.monotonic()) >= due:
                checkpoints.save(file, run, {**about, "losses": run.losses})
                due = time.monotonic() + SELDOM * (time.monotonic() - begun)
    finally:
        if file is not None:
            checkpoints.save(file, run, {**about, "losses": run.losses})
    return _report(run, problem, result, max_steps)


def _solver(solver: Any, rtol: float, atol: float) -> tuple[Any, int]:
    """The solver, and its default patience."""
    if isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        return solver, 100 if isinstance(solver, optx.OptaxMinimiser) else 10
    if solver == "levenberg_marquardt":
        return LevenbergMarquardt(rtol, atol), 10
    if solver == "gauss_newton":
        return optx.GaussNewton(rtol, atol), 10
    if solver == "bfgs":
        return optx.BFGS(rtol, atol), 10
    if solver == "adam" or (hasattr(solver, "init") and hasattr(solver, "update")):
        try:
            import optax  # pyright: ignore[reportMissingImports]
        except ImportError as fault:
            raise ImportError('solver="adam" needs Optax: pip install "jaxvol[fit]".') from fault
        optim = optax.adam(LEARNING_RATE) if solver == "adam" else solver
        return optx.OptaxMinimiser(optim, rtol, atol), 100
    raise ValueError(
        f"solver must be one of {', '.join(get_args(Solver))}, or a solver of Optimistix or Optax; "
        f"got {solver!r}."
    )


class _Run(eqx.Module):
    """State of a fit: everything that the next step depends on."""

    y: FreeVariables
    state: Any
    evaluated: FreeVariables
    """The solver's point whose loss is known."""
    best: FreeVariables
    triangle: Array | None
    """At the best point."""
    done: Array
    result: Any
    losses: list[float] = eqx.field(static=True)

    def step(self, solver: Any, problem: Problem) -> "_Run":
        y, state, (loss, evaluated, triangle), done, result = _advance(solver, problem, self.y, self.state)
        loss = float(loss)
        better = loss < min(self.losses, default=math.inf)
        best, triangle = (evaluated, triangle) if better else (self.best, self.triangle)
        return _Run(y, state, evaluated, best, triangle, done, result, [*self.losses, loss])

    def ended(self, max_steps: int, patience: int, rtol: float) -> Any:
        """The result if the fit has ended, else None."""
        finite = all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(self.y))
        if not finite or not math.isfinite(self.losses[-1]):
            return Outcome.nonfinite
        if self.done or self.result != optx.RESULTS.successful:
            return Outcome.promote(self.result)
        earlier, late = self.losses[:-patience], self.losses[-patience:]
        if earlier and min(late) >= (1 - rtol) * min(earlier):
            return Outcome.stalled
        if len(self.losses) >= max_steps:
            return Outcome.nonlinear_max_steps_reached
        return None


def _squares(y: FreeVariables, problem: Problem) -> tuple[Array, tuple[Array, FreeVariables, Array]]:
    """Residual for a least-squares solver, with auxiliary output: the loss, its point, and the triangle."""
    triangle = problem.condensed(y)
    return triangle[:, -1], (jnp.sum(triangle[:, -1] ** 2) / 2, y, triangle)


def _loss(y: FreeVariables, problem: Problem) -> tuple[Array, tuple[Array, FreeVariables, None]]:
    """Objective of a minimiser, with the same auxiliary output but no triangle."""
    loss = problem.loss(y)
    return loss, (loss, y, None)


def _function(solver: Any) -> Callable[..., Any]:
    return _squares if isinstance(solver, optx.AbstractLeastSquaresSolver) else _loss


@eqx.filter_jit
def _init_state(solver: Any, problem: Problem, y: FreeVariables) -> Any:
    function = _function(solver)
    with _allow_promotion():
        out, aux = eqx.filter_eval_shape(function, y, problem)
        return solver.init(function, y, problem, {}, out, aux, frozenset())


@eqx.filter_jit
def _advance(solver: Any, problem: Problem, y: FreeVariables, state: Any) -> Any:
    function = _function(solver)
    with _allow_promotion():
        y, state, previous_aux = solver.step(function, y, problem, {}, state, frozenset())
        done, result = solver.terminate(function, y, problem, {}, state, frozenset())
    # `previous_aux` is that of the previous point in solvers with trial points; their state has the new one's
    return y, state, getattr(state, "aux", previous_aux), done, result


@contextmanager
def _allow_promotion() -> Iterator[None]:
    """Allow JAX's promotion of types and ranks, which solvers need, even if the user has forbidden it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _report(run: _Run, problem: Problem, result: Any, max_steps: int) -> Fit:
    estimate = None
    if run.triangle is not None:
        residual, triangle = problem.residual, np.asarray(run.triangle)
        estimate = uncertainty(triangle, residual.count(), problem.free, run.best, residual.scale())
        if estimate.undetermined:
            moved = "; ".join(", ".join(names[:6]) or "none" for names in estimate.undetermined[:6])
            warnings.warn(
                f"{len(estimate.undetermined)} of {run.triangle.shape[0] - 1} directions are not determined "
                f"by the residual; parameters they change most: {moved}.",
                stacklevel=3,
            )
    stats = {"num_steps": len(run.losses), "max_steps": max_steps}
    solution = optx.Solution(run.best, result, None, stats, run.state)
    return Fit(problem.free.forward(run.best), solution, np.asarray(run.losses), estimate)
