"""Fits parameters by minimising a residual with a solver of Optimistix. The solver is stepped here, rather
than by `optimistix.least_squares`, for callbacks, checkpoints, interruption and the best point."""

import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any, TypeAlias, cast

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from .._util.checks import all_finite, flag, integer, not_negative, output_file
from .._util.progress import progress
from ..xla.trees import PyTree, strong
from . import checkpoints
from .constraints import Free, FreeVariables, Where, size
from .damping import LevenbergMarquardt
from .outcomes import Limits, Outcome as Outcome
from .path_traced import PathTracedResidual, SampledProblem, SampledRun
from .residuals import ImageResidual, Problem, Triangles, check_residual
from .uncertainty import Uncertainty, uncertainty, warn_of_misfit


UNDETERMINED = ".*directions are not determined"
"""Pattern of the warning that names such directions, for callers that filter it."""

LEARNING_RATE = 0.03
"""Learning rate of `"adam"`, in free variables, which are of order 1."""

NEAR = 0.03
"""Distance from the minimum, in standard errors, at which a least-squares fit has converged."""

CHECKPOINTS = 1 / 10
"""Fraction of the time that a fit spends on writing checkpoints."""

Solver: TypeAlias = (
    optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | optx.AbstractMinimiser[Any, Any, Any]
)

GradientTransformation: TypeAlias = tuple[Callable[..., Any], Callable[..., Any]]
"""Pair of `init` and `update`: the type of Optax, which may not be installed."""


class Fit(eqx.Module):
    """Result of a fit.

    Attributes:
        parameters: the best parameters so far, as a tree like the starting parameters.
        solution: Optimistix's `Solution`: `value` (the free variables), `result`, `state` and `stats`.
        losses: half the sum of squared residuals at the solver's point after each step; for a
            `PathTracedResidual`, samples of it, which may be negative.
        uncertainty: an `Uncertainty`, for a least-squares solver; else None.
    """

    parameters: PyTree
    solution: optx.Solution[Any, Any]
    losses: Float[np.ndarray, " steps"]
    uncertainty: Uncertainty | None

    @property
    def loss(self) -> float:
        """Half the sum of squared residuals at `parameters`."""
        return self.solution.stats["loss"]

    @property
    def success(self) -> bool:
        """True if the solver converged to its tolerances."""
        return bool(self.solution.result == Outcome.successful)

    @property
    def message(self) -> str:
        """Outcome of the fit, in words."""
        if self.solution.stats["message"] is not None:
            return self.solution.stats["message"]
        if self.success:
            return "The solver converged."
        if self.solution.result == Outcome.nonlinear_max_steps_reached:
            return "The fit reached the maximum number of steps, max_steps, before it converged."
        return Outcome[self.solution.result]


def fit(
    residual: ImageResidual | PathTracedResidual | Callable[[Any], PyTree] | Any,
    parameters: PyTree,
    *,
    solver: str | Solver | GradientTransformation | None = None,
    constraints: PyTree = None,
    where: Where | None = None,
    rtol: float = 1e-4,
    atol: float = 1e-6,
    max_steps: int = 100,
    patience: int | None = None,
    max_jacobian: int = 2**30,
    callback: Callable[[int, PyTree, float], Any] | None = None,
    checkpoint: str | PathLike[str] | None = None,
    quiet: bool = False,
) -> Fit:
    """Fit parameters to make a residual small: the loss is half the sum of its squares.

    A fit whose rays are opaque from their first cell on may end in a wrong minimum. Where it fails:
    `experiments/stability.py`, "fits of what images do not show", "fits from opaque starts",
    "fits under noise".

    Args:
        residual: an `ImageResidual`, a `PathTracedResidual`, or a function from parameters to arrays. A
            function that renders must use `adjoint="forward"` for a least-squares solver and `"replay"` for
            the others.
        parameters: the starting point: any tree, such as a `TransferFunction`, a `Camera` or a dict. Its
            float arrays are fitted.
        solver: `"levenberg_marquardt"` (the default) or `"gauss_newton"`: least squares, up to a few hundred
            parameters; start with Levenberg–Marquardt. `"bfgs"` needs only the gradient, and a matrix of
            parameters × parameters. `"adam"`: gradient descent with Optax (`pip install "jaxvol[fit]"`), for
            large arrays. Or a solver of Optimistix, with its own tolerances; or a gradient transformation of
            Optax. None for a `PathTracedResidual`, whose solver takes Gauss–Newton steps from means over the
            last half to three quarters of all steps.
        constraints: a tree like the parameters, or a prefix of one, with a bijection at each leaf: `Fixed()`,
            `Unconstrained()`, `Positive()`, `UnitInterval()`, `Pose(camera)`, `ProbeGeometry(probe)`, or None
            for the default. By default, a transfer function has positive extinction, colours in [0, 1] and
            fixed values; a camera its pose; a `ToroidalMap` its geometry; a volume the arrays of its field if
            it has any, or else its data if they are float; a material a positive mean free path; a march is
            fixed; any other float array is unconstrained.
        where: free parameters, `where(parameters)` as for `equinox.tree_at`; all others stay fixed. For
            example `lambda transfer: transfer.extinction`, or a function that returns a tuple.
        rtol: relative tolerance. A fit has converged when neither the free variables nor the residual change
            in a step by more than `atol + rtol * size`, or, by least squares, within 3 % of a standard error
            of the minimum; with a `PathTracedResidual`, when the standard error
            due to its paths is within this limit, or at most half of that due to noise of the references.
        atol: absolute tolerance: see `rtol`.
        max_steps: maximum number of steps. Each evaluates residual and derivative, even if it is rejected.
        patience: number of steps after which a fit has stalled if the loss has not fallen by a fraction of
            more than `rtol`; by default 10, or 100 for Optax. Unused for a `PathTracedResidual`.
        max_jacobian: bytes. A least-squares solver holds only as many rows of the Jacobian at once as fit
            (m rows of n parameters need 4 m (n + 1) bytes), and no more than those of one image.
        callback: `callback(step, parameters, loss)` after each step but the first, which evaluates the start.
        checkpoint: a file for the state, which is written between steps, in a tenth of the time, and when the
            fit ends or is interrupted. If the file exists, the fit continues from it, with the same bits as
            without interruption (on the same machine).
        quiet: whether no progress is shown. By default, a terminal or a notebook shows the step, its loss and
            what is being compiled.

    Returns:
        A `Fit`. If the solver fails, stalls or runs out of steps, `Fit.success` and `Fit.message` say so, and
        the parameters are the best so far. A warning names directions that the residual does not determine:
        of a `PathTracedResidual`, also parameters that noise of its paths hides, by a standard error beyond
        the longest step, such as a factor of e for numbers that are `Positive` and below the scale. If the
        noise of an `ImageResidual` is known, another warning says if the model does not fit: noise exceeds
        its limit once in 741 fits, even if neighbouring pixels are correlated. Standard errors don't cover
        the bias of such a fit. A fit of a `PathTracedResidual` only reports χ².

    Raises:
        ValueError: for incompatible arguments, parameters that are not finite or out of bounds, a residual
            that is not finite at the start, and a checkpoint that is damaged or of another fit.
        ImportError: if Optax is requested but not installed.
    """
    quiet = flag("quiet", quiet)
    not_negative("rtol", rtol)
    not_negative("atol", atol)
    if not isinstance(residual, PathTracedResidual):
        check_residual(residual)
    file = None if checkpoint is None else output_file("checkpoint", checkpoint)
    max_steps, max_jacobian = integer("max_steps", max_steps, 1), integer("max_jacobian", max_jacobian, 1)
    method, default_patience = _solver(solver, residual, rtol, atol)
    patience = default_patience if patience is None else integer("patience", patience, 1)
    limits = Limits(max_steps, patience, rtol, atol)
    free, y = Free.of(parameters, constraints, where)
    problem: Any
    if isinstance(residual, PathTracedResidual):
        problem = SampledProblem.of(residual, free, y, max_jacobian)
        run: Any = SampledRun.of(problem, y)
    else:
        least_squares = isinstance(method, optx.AbstractLeastSquaresSolver)
        problem = Problem.of(residual, free, y, max_jacobian, least_squares)
        run = _Run.of(method, problem, y)
    with progress("fitting", max_steps, quiet=quiet) as show:
        run, loss = run.step(method, problem)
        losses = [loss]
        show(f"loss {loss:.3g}")
        if not math.isfinite(loss):
            start = "at the parameters that the fit starts from"
            raise ValueError(f"residual must be finite {start}; loss {loss}.")
        bounds = zip(free.paths, free.bijections, strict=True)
        description = {
            "solver": method if isinstance(method, str) else type(method).__name__,
            "parameters": [f"{path}: {type(bijection).__name__}" for path, bijection in bounds],
            "number of residuals": problem.count,
            "loss at the start": f"{loss:.3g}",  # other machines round differently
        }
        if file is not None and (saved := checkpoints.load(file, run, description)) is not None:
            run, losses = saved[0], saved[1]["losses"]
        due = 0.0
        try:
            while (result := run.ended(problem, losses, limits)) is None:
                run, loss = run.step(method, problem)
                losses.append(loss)
                show(f"loss {loss:.3g}")
                if callback is not None:
                    callback(len(losses), free.forward(run.evaluated), loss)
                if file is not None and (begun := time.monotonic()) >= due:
                    checkpoints.save(file, run, {**description, "losses": losses})
                    due = time.monotonic() + (time.monotonic() - begun) / CHECKPOINTS
        finally:
            if file is not None:
                checkpoints.save(file, run, {**description, "losses": losses})
    return _report(run, problem, losses, limits, result)


def _solver(solver: Any, residual: Any, rtol: float, atol: float) -> tuple[Any, int]:
    """The solver, and its default patience."""
    if isinstance(residual, PathTracedResidual):
        if solver is not None:
            raise ValueError(f"solver must be None for a PathTracedResidual, which has one; got {solver!r}.")
        return "means of Gauss-Newton steps", 1
    solver = "levenberg_marquardt" if solver is None else solver
    if isinstance(solver, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        return solver, 100 if isinstance(solver, optx.OptaxMinimiser) else 10
    known = {"levenberg_marquardt": LevenbergMarquardt, "gauss_newton": optx.GaussNewton, "bfgs": optx.BFGS}
    if isinstance(solver, str) and solver in known:
        return known[solver](rtol, atol), 10
    if solver == "adam" or (hasattr(solver, "init") and hasattr(solver, "update")):
        try:
            import optax  # pyright: ignore[reportMissingImports]
        except ImportError as fault:
            raise ImportError('solver="adam" needs Optax: pip install "jaxvol[fit]".') from fault
        optim = optax.adam(LEARNING_RATE) if solver == "adam" else solver
        return optx.OptaxMinimiser(optim, rtol, atol), 100
    names = ", ".join((*known, "adam"))
    raise ValueError(f"solver must be one of {names}, or a solver of Optimistix or Optax; got {solver!r}.")


class _Run(eqx.Module):
    """State of a fit between steps."""

    y: FreeVariables
    state: Any
    evaluated: FreeVariables
    """The solver's point whose loss is known."""
    best: FreeVariables
    loss: Float[np.ndarray, ""]
    """Loss at the best point."""
    triangles: Triangles | None
    """Triangles at the best point."""
    done: Bool[Array | np.ndarray, ""]
    result: Any

    @classmethod
    def of(cls, solver: Solver, problem: Problem, y: FreeVariables) -> "_Run":
        """The state before any step."""
        state, done = _init_state(solver, problem, y), np.zeros((), bool)
        return cls(y, state, y, y, np.asarray(np.inf), None, done, Outcome.successful)

    def step(self, solver: Solver, problem: Problem) -> tuple["_Run", float]:
        """The state after a step, and the loss at the solver's point."""
        y, state, (loss, evaluated, triangles), done, result = _advance(solver, problem, self.y, self.state)
        loss = np.asarray(loss, np.float64)
        known = (evaluated, loss, triangles) if loss < self.loss else (self.best, self.loss, self.triangles)
        return _Run(y, state, evaluated, *known, done, result), float(loss)

    def ended(self, problem: Problem, losses: list[float], limits: Limits) -> Any:
        """The result if the fit has ended, else None."""
        if not math.isfinite(losses[-1]):
            return Outcome.nonfinite
        if self.done or self.result != Outcome.successful:
            return self.result
        if self.triangles is not None and self._offset(problem) <= NEAR:
            return Outcome.successful
        earlier, late = losses[: -limits.patience], losses[-limits.patience :]
        if earlier and min(late) >= (1 - limits.rtol) * min(earlier):
            return Outcome.stalled
        if len(losses) >= limits.max_steps:
            return Outcome.nonlinear_max_steps_reached
        return None

    def _offset(self, problem: Problem) -> float:
        """Distance of the best point from the minimum of the linear model: in standard errors, root mean
        square over all directions. Source: the relative offset of Bates and Watts 1981."""
        *reducible, remainder = np.asarray(cast(Triangles, self.triangles).residual, np.float64)[:, -1]
        freedom = problem.count - len(reducible)
        if freedom <= 0 or remainder == 0:
            return math.inf
        return math.sqrt(np.mean(np.square(reducible)) / (remainder**2 / freedom))


@eqx.filter_jit
def _init_state(solver: Solver, problem: Problem, y: FreeVariables) -> Any:
    with allow_promotion():
        f_struct, aux_struct = eqx.filter_eval_shape(problem, y)
        return strong(solver.init(problem, y, None, {}, f_struct, aux_struct, frozenset()))


@eqx.filter_jit
def _advance(solver: Solver, problem: Problem, y: FreeVariables, state: Any) -> Any:
    with allow_promotion():
        y, state, previous_aux = solver.step(problem, y, None, {}, state, frozenset())
        done, result = solver.terminate(problem, y, None, {}, state, frozenset())
    result = Outcome.where(all_finite(y), Outcome.promote(result), cast(Any, Outcome.nonfinite))
    # solvers with trial points return `aux` of the previous point; their state has that of the new one
    return strong((y, state, getattr(state, "aux", previous_aux), done, result))


@contextmanager
def allow_promotion() -> Iterator[None]:
    """Allow JAX's promotion of types and ranks, which solvers need, even if the user has forbidden it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _report(run: _Run | SampledRun, problem: Any, losses: list[float], limits: Limits, result: Any) -> Fit:
    """Result of a run: parameters, uncertainty and warnings."""
    estimate, chi_squared, loss = None, None, float(run.loss)
    message = path_covariance = None
    if isinstance(run, SampledRun):
        message, path_covariance = run.message(problem, limits, result), run.path_covariance
    if problem.noise is not None:  # χ² is of Σ r²; the loss is half the mean square
        chi_squared = problem.noise.reduced_chi_squared(2 * problem.count * loss, size(run.best))
    if run.triangles is not None:
        estimate = uncertainty(
            run.triangles, problem.count, problem.free, run.best, problem.scale, chi_squared, path_covariance
        )
        if estimate.undetermined:
            moved = "; ".join(", ".join(names[:6]) or "none" for names in estimate.undetermined[:6])
            warnings.warn(
                f"{len(estimate.undetermined)} of {size(run.best)} directions are not determined "
                f"by the residual; parameters they change most: {moved}.",
                stacklevel=3,
            )
    stats = {"num_steps": len(losses), "max_steps": limits.max_steps, "loss": loss, "message": message}
    solution = optx.Solution(run.best, result, None, stats, getattr(run, "state", run))
    report = Fit(problem.free.forward(run.best), solution, np.asarray(losses), estimate)
    if problem.noise is not None and chi_squared is not None and path_covariance is None:
        warn_of_misfit(problem.noise, chi_squared, None if report.success else report.message)
    return report
