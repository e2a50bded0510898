"""How are parameters found that make a residual small? By a solver of Optimistix, step by step."""

import math
import numbers
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from .._util.checks import integer, output_file
from . import checkpoints
from .constraints import Free, Where
from .damping import LevenbergMarquardt
from .residuals import OwnResidual, Problem, Residual, check_residual, tile_entries
from .uncertainty import Uncertainty, uncertainty


Solver: TypeAlias = Literal["levenberg_marquardt", "gauss_newton", "bfgs", "adam"]

LEARNING_RATE = 0.03
"""Of `"adam"`, in free numbers, which are of order 1."""


class Outcome(optx.RESULTS):  # pyright: ignore
    """How a fit ended: Optimistix's results, and one more."""

    stalled = (
        "No step lowered the loss any more by more than rtol: a minimum, as far as the float type can tell, "
        "or a place where the derivative does not say how the loss changes."
    )


class Fit(eqx.Module):
    """What a fit found.

    - `parameters`: the best ones seen, as the tree that was given.
    - `solution`: Optimistix's: `value` (the free numbers), `result`, `state` and `stats`.
    - `losses`: half the sum of squared residuals at the solver's point after each step.
    - `uncertainty`: `covariance`, `names`, `standard_errors` and `undetermined` directions, from a
      least-squares solver; else None.
    """

    parameters: PyTree
    solution: optx.Solution
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
        if self.solution.result == Outcome.nonlinear_max_steps_reached:  # Optimistix fears for other problems
            return "The fit took the maximum number of steps, max_steps, before it converged."
        return Outcome[self.solution.result]


def fit(
    residual: Residual | Callable[[Any], PyTree] | Any,
    parameters: PyTree,
    *,
    solver: Solver | optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | Any = "levenberg_marquardt",
    constraints: PyTree = None,
    where: Where | None = None,
    rtol: float = 1e-4,
    atol: float = 1e-6,
    max_steps: int | Any = 100,
    patience: int | Any | None = None,
    max_jacobian: int | Any = 2**30,
    callback: Callable[[int, PyTree, float], Any] | None = None,
    progress: bool = False,
    checkpoint: str | PathLike[str] | None = None,
    checkpoint_seconds: float = 60.0,
) -> Fit:
    """Parameters that make a residual small: half the sum of its squares is the loss.

    **Arguments:**

    - `residual`: an `ImageResidual`, or a function from parameters to arrays. A function that renders
      must do so by `adjoint="forward"` for the first two solvers, by `"replay"` for the others.
    - `parameters`: where to start: any tree, such as a `TransferFunction`, a `Camera` or a dict. Its
      float arrays are fitted.
    - `solver`:
        - `"levenberg_marquardt"`, `"gauss_newton"`: least squares, by forward Jacobians. The first
          is the one to try first, up to some hundred parameters.
        - `"bfgs"`: the gradient alone, and a matrix of parameters × parameters.
        - `"adam"`: gradient descent through Optax (`pip install "jaxvol[fit]"`), for large arrays.
        - any least-squares solver or minimiser of Optimistix, or a transformation of Optax; `rtol` and
          `atol` are then the solver's own where it has them.
    - `constraints`: a tree like the parameters, or the beginning of one, with a bijection at each end: None
      for what is usual, `Fixed()`, `Unconstrained()`, `Positive()`, `UnitInterval()`, `Pose(camera)`. Usual
      are, for a transfer function, positive extinction, colours in [0, 1] and fixed values; for a
      camera, its pose; for a volume, unconstrained data where they are float; for a material, a positive mean
      free path, and all else fixed; a march stays fixed; any other float array is unconstrained.
    - `where`: the parts that are free, `where(parameters)` as for `equinox.tree_at`: all else stays
      fixed. `lambda transfer: transfer.extinction`, or a tuple of parts.
    - `rtol`, `atol`: a fit has converged when in a step neither the free numbers nor the residual change by
      more than this.
    - `max_steps`: the most steps. Each is an evaluation with derivative, also where the step is rejected.
    - `patience`: steps in which the loss does not fall by more than `rtol`, relatively, after which a fit
      has stalled: 10, or 100 for Optax, by default.
    - `max_jacobian`: bytes. With a least-squares solver, only as many rows of the Jacobian are held at once
      as fit (m rows of n parameters need 4 m (n + 1) bytes), and no more than those of one image. The
      result does not depend on it, but for rounding.
    - `callback`: `callback(step, parameters, loss)` after each step but the first, which looks at the start.
    - `progress`: shows a progress bar (`pip install "jaxvol[fit]"`).
    - `checkpoint`: a file to which the state is written every `checkpoint_seconds`, at the end, and when the
      fit is interrupted after its first step (Ctrl-C; `KeyboardInterrupt` is raised again, and says so).
      Whether it can be written is tried first. If it exists, the fit goes on from there, and ends with the
      same parameters, to the bit, as if it had never stopped (on the same machine). A damaged file is told
      by a warning, and the one before it used.

    **Returns:** a `Fit`. A solver that fails, stalls or runs out of steps is told by `Fit.success`,
    `Fit.message` and `Fit.solution.result`; the parameters are then the best ones that were seen. Directions
    that the residual does not determine are named in a warning.

    **Raises:** `ValueError` for arguments that do not fit together, parameters that are not finite or
    out of bounds, a residual that is not finite at the start, a checkpoint of another fit, and one that
    cannot be written;
    `ImportError` where Optax or the progress bar is asked for and missing.
    """
    for name, value in (("rtol", rtol), ("atol", atol), ("checkpoint_seconds", checkpoint_seconds)):
        if not (isinstance(value, numbers.Real) and math.isfinite(value) and value >= 0):
            raise ValueError(f"{name} must be a finite number of at least 0; got {value!r}.")
    check_residual(residual)
    file = None if checkpoint is None else output_file("checkpoint", checkpoint)
    max_steps, max_jacobian = integer("max_steps", max_steps, 1), integer("max_jacobian", max_jacobian, 1)
    solver, patient = _solver(solver, rtol, atol)
    patience = patient if patience is None else integer("patience", patience, 1)
    free, y = Free.of(parameters, constraints, where)
    if not isinstance(residual, Residual):
        residual = OwnResidual.of(residual, free.forward(y))
    least_squares = isinstance(solver, optx.AbstractLeastSquaresSolver)
    problem = Problem(residual, free, tile_entries(residual, y, max_jacobian, least_squares))

    run = _Run.begin(solver, problem, y)
    keeper = None if file is None else _Keeper(file, _about(solver, problem, run))
    if keeper is not None:
        run = keeper.resumed(run)
    try:
        with _bar(progress, max_steps) as show:
            while run.ended(max_steps, patience, rtol) is None:
                run = run.step(solver, problem)
                show(run)
                if callback is not None:
                    callback(len(run.losses), problem.free.forward(run.seen), run.losses[-1])
                if keeper is not None:
                    keeper.save(run, checkpoint_seconds)
    except KeyboardInterrupt as stop:
        if keeper is not None:
            keeper.save(run)
            stop.add_note(
                f"fit: stopped after {len(run.losses)} steps, which {file} holds; the same call goes on from "
                "there."
            )
        raise
    if keeper is not None:
        keeper.save(run)
    return _told(run, problem, run.ended(max_steps, patience, rtol), max_steps)


def _solver(solver: Any, rtol: float, atol: float) -> tuple[Any, int]:
    """The solver, and the patience that it wants."""
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
            import optax
        except ImportError as fault:
            raise ImportError('solver="adam" needs Optax: pip install "jaxvol[fit]".') from fault
        optim = optax.adam(LEARNING_RATE) if solver == "adam" else solver
        return optx.OptaxMinimiser(optim, rtol, atol), 100
    raise ValueError(
        f"solver must be one of {', '.join(get_args(Solver))}, or a solver of Optimistix or Optax; "
        f"got {solver!r}."
    )


class _Run(eqx.Module):
    """Where a fit is: everything that the next step depends on."""

    y: tuple
    state: Any
    seen: tuple
    """The solver's point, of which the loss is known."""
    best: tuple
    triangle: Array | None
    """At the best point."""
    done: Array
    result: Any
    losses: list[float] = eqx.field(static=True)

    @classmethod
    def begin(cls, solver: Any, problem: Problem, y: tuple) -> "_Run":
        """After the first step, which finds the loss at the start."""
        state = _begun(solver, problem, y)
        nothing = jnp.zeros((), bool)
        run = cls(y, state, y, y, None, nothing, optx.RESULTS.successful, [])
        run = run.step(solver, problem)
        if not math.isfinite(run.losses[0]):
            raise ValueError(
                f"residual must be finite at the parameters that the fit starts from; half the sum of its "
                f"squares is {run.losses[0]}."
            )
        return run

    def step(self, solver: Any, problem: Problem) -> "_Run":
        y, state, (loss, seen, triangle), done, result = _advanced(solver, problem, self.y, self.state)
        loss = float(loss)
        better = loss < min(self.losses, default=math.inf)
        best, triangle = (seen, triangle) if better else (self.best, self.triangle)
        return _Run(y, state, seen, best, triangle, done, result, [*self.losses, loss])

    def ended(self, max_steps: int, patience: int, rtol: float) -> Any:
        """The result, once the fit has ended."""
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

    def arrays(self) -> checkpoints.Arrays:
        leaves = jax.tree.leaves(eqx.filter(self, eqx.is_array))
        return {
            **{f"a{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)},
            "losses": np.asarray(self.losses),
        }

    def with_arrays(self, arrays: checkpoints.Arrays) -> "_Run":
        dynamic, static = eqx.partition(self, eqx.is_array)
        leaves, structure = jax.tree.flatten(dynamic)
        leaves = [jnp.asarray(arrays[f"a{i}"]) for i in range(len(leaves))]
        run = eqx.combine(jax.tree.unflatten(structure, leaves), static)
        return replace(run, losses=arrays["losses"].tolist())


def _squares(y: tuple, problem: Problem) -> tuple[Array, tuple[Array, tuple, Array]]:
    """What a least-squares solver makes small; beside it the loss, where it was taken, and the triangle."""
    triangle = problem.condensed(y)
    return triangle[:, -1], (jnp.sum(triangle[:, -1] ** 2) / 2, y, triangle)


def _loss(y: tuple, problem: Problem) -> tuple[Array, tuple[Array, tuple, None]]:
    """What a minimiser makes small; the same beside it."""
    loss = problem.loss(y)
    return loss, (loss, y, None)


def _function(solver: Any) -> Callable[..., Any]:
    return _squares if isinstance(solver, optx.AbstractLeastSquaresSolver) else _loss


@eqx.filter_jit
def _begun(solver: Any, problem: Problem, y: tuple) -> Any:
    function = _function(solver)
    with _lenient():
        out, aux = eqx.filter_eval_shape(function, y, problem)
        return solver.init(function, y, problem, {}, out, aux, frozenset())


@eqx.filter_jit
def _advanced(solver: Any, problem: Problem, y: tuple, state: Any) -> Any:
    function = _function(solver)
    with _lenient():
        y, state, before = solver.step(function, y, problem, {}, state, frozenset())
        done, result = solver.terminate(function, y, problem, {}, state, frozenset())
    # solvers that try points tell of the one they stood at before; they keep what they know of the new one
    return y, state, getattr(state, "aux", before), done, result


@contextmanager
def _lenient() -> Iterator[None]:
    """Solvers count on JAX's promotion of types and ranks, also where a user has forbidden it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


class _Keeper:
    """Who writes checkpoints, and knows which step was written when."""

    def __init__(self, file: Path, about: dict[str, Any]):
        self.file, self.about = file, about
        self.step, self.time = 0, time.monotonic()

    def resumed(self, run: _Run) -> _Run:
        """The run that was saved; this one, where none was."""
        arrays = checkpoints.load(self.file, self.about)
        if arrays is None:
            return run
        run = run.with_arrays(arrays)
        self.step = len(run.losses)
        return run

    def save(self, run: _Run, seconds: float = 0) -> None:
        """Save the run, unless it is as it was, or so many seconds have not yet passed."""
        if len(run.losses) > self.step and time.monotonic() - self.time >= seconds:
            checkpoints.save(self.file, run.arrays(), self.about)
            self.step, self.time = len(run.losses), time.monotonic()


def _about(solver: Any, problem: Problem, run: _Run) -> dict[str, Any]:
    """What tells one fit from another."""
    free = problem.free
    kinds = [type(b).__name__ for b in free.bijections]
    return {
        "solver": type(solver).__name__,
        "parameters": [f"{place}: {kind}" for place, kind in zip(free.places, kinds, strict=True)],
        "state": [f"{x.dtype}{list(x.shape)}" for x in jax.tree.leaves(eqx.filter(run, eqx.is_array))],
        "number of residuals": problem.residual.count(),
        "loss at the start": run.losses[0],
    }


def _told(run: _Run, problem: Problem, result: Any, max_steps: int) -> Fit:
    known = None
    if run.triangle is not None:
        residual, triangle = problem.residual, np.asarray(run.triangle)
        known = uncertainty(triangle, residual.count(), problem.free, run.best, residual.scale())
        if known.undetermined:
            moved = "; ".join(", ".join(names[:6]) or "none" for names in known.undetermined[:6])
            warnings.warn(
                f"{len(known.undetermined)} of {run.triangle.shape[0] - 1} directions are not determined by "
                f"the residual; most moved by them: {moved}.",
                stacklevel=3,
            )
    stats = {"num_steps": len(run.losses), "max_steps": max_steps}
    solution = optx.Solution(run.best, result, None, stats, run.state)
    return Fit(problem.free.forward(run.best), solution, np.asarray(run.losses), known)


@contextmanager
def _bar(progress: bool, max_steps: int) -> Iterator[Callable[[_Run], None]]:
    """A progress bar, and how to move it."""
    if not progress:
        yield lambda run: None
        return
    try:
        from tqdm import tqdm
    except ImportError as fault:
        raise ImportError('progress=True needs tqdm: pip install "jaxvol[fit]".') from fault
    with tqdm(total=max_steps, desc="fit", unit="step") as bar:

        def show(run: _Run) -> None:
            bar.n = len(run.losses)
            bar.set_postfix(loss=f"{run.losses[-1]:.3e}")

        yield show
