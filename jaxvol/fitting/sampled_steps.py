"""Gauss–Newton steps from noisy samples of residual and Jacobian, averaged over steps.

Near the minimum y*, the gradient at yₖ is gₖ = H (yₖ - y*) + noise. So y* = E[ȳ - H⁻¹ ḡ] for means over any
steps: each step goes there, with the means over the last steps, so that noise falls with their number. The
first steps, from far away, must be forgotten: steps fall into epochs, each twice as long as the one before,
and means are over this epoch and the last, which is half to three quarters of all steps. Without noise, the
first steps are Gauss–Newton's.

Unlike stochastic gradient descent, whose steps must become small at a rate that fits the curvature (Robbins
and Monro 1951; Polyak and Juditsky 1992), nothing needs to be chosen.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .constraints import FreeVariables
from .outcomes import Limits, Outcome
from .path_traced import Sample, SampledProblem
from .residuals import Triangles


LONGEST = 1.0
"""A step moves no free variable, which are of order 1, by more than this."""

FLOOR = 0.1
"""Smallest curvature, relative to that with noise, which is larger: while few samples are averaged, the
unbiased one may be 0 or negative."""


LEAST = 12
"""Steps that a fit takes at least: standard errors are known from 7 to 9 samples then."""

ENOUGH = 0.5
"""A fit has converged when the noise of its own paths is at most this fraction of the standard error that the
references leave: together, these are at most 12 % larger than the latter."""


class Averages(eqx.Module):
    """Means over samples at several points."""

    steps: Float[Array, ""]
    both: Float[Array, " both"]
    """Point and gradient, one behind the other."""
    moments: Float[Array, "both both"]
    """Sums of products of their deviations from the mean."""
    curvature: Float[Array, "free free"]
    squares: Float[Array, " free"]
    loss: Float[Array, ""]
    rows: Float[Array, "pixels channels numbers"]
    """[J r]."""

    @classmethod
    def of(cls, point: Float[Array, " free"], sample: Sample) -> "Averages":
        """Of one sample."""
        both = jnp.concatenate([point, sample.gradient])
        moments = jnp.zeros((both.size, both.size), both.dtype)
        rest = sample.curvature, sample.squares, sample.loss, jnp.mean(sample.rows, axis=0)
        return cls(jnp.ones((), both.dtype), both, moments, *rest)

    def joined(self, other: "Averages") -> "Averages":
        """Over the samples of both (Chan, Golub and LeVeque 1983)."""
        steps = self.steps + other.steps
        share = other.steps / steps
        means = jax.tree.map(lambda a, b: a + (b - a) * share, self, other)
        apart = other.both - self.both
        moments = self.moments + other.moments + jnp.outer(apart, apart) * (self.steps * share)
        return eqx.tree_at(lambda each: (each.steps, each.moments), means, (steps, moments))

    @property
    def solution(self) -> tuple[Float[Array, " free"], Float[Array, "free free"]]:
        """Where the mean gradient is 0, and its covariance due to the noise of paths."""
        scale = jnp.sqrt(jnp.where(self.squares > 0, self.squares, 1))
        values, axes = jnp.linalg.eigh(self.curvature / scale / scale[:, None])
        half = axes / jnp.sqrt(jnp.maximum(values, FLOOR)) / scale[:, None]
        inverse = half @ half.T
        n = len(inverse)
        point = self.both[:n] - inverse @ self.both[n:]
        each = jnp.concatenate([jnp.eye(n, dtype=inverse.dtype), -inverse], axis=1)
        freedom = self.steps * (self.steps - 1)
        covariance = each @ self.moments @ each.T / jnp.maximum(freedom, 1)
        return point, jnp.where(freedom > 0, covariance, jnp.inf)

    @property
    def triangles(self) -> Triangles:
        """Of the mean residual and Jacobian."""
        scores = jnp.sum(self.rows[..., :-1] * self.rows[..., -1:], axis=1)
        both = self.rows.reshape(-1, self.rows.shape[-1]), scores
        squares = (jnp.zeros((each.shape[1],) * 2, each.dtype) for each in both)  # there may be few pixels
        pairs = zip(squares, both, strict=True)
        return Triangles(*(jnp.linalg.qr(jnp.concatenate(pair), mode="r") for pair in pairs))


class SampledState(eqx.Module):
    """State of such a fit.

    Attributes:
        y: where the next sample is taken.
        evaluated: where the last one was.
        step: number of samples so far.
        last: averages over the last epoch; of no steps at first.
        current: over this one.
        loss: by the last sample.
        mean_loss: over both epochs; with the triangles and the covariance there.
    """

    y: FreeVariables
    evaluated: FreeVariables
    step: Any
    last: Averages
    current: Averages
    loss: Float[Array, ""]
    mean_loss: Float[Array, ""]
    triangles: Triangles
    covariance: Float[Array, "free free"]


@eqx.filter_jit
def first_state(problem: SampledProblem, y: FreeVariables) -> SampledState:
    """Before any step."""
    flat, _ = ravel_pytree(y)
    sample = eqx.filter_eval_shape(problem.sample, y, jnp.zeros((), jnp.int32))
    averages = eqx.filter_eval_shape(Averages.of, flat, sample)
    none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), averages)
    zero, n = jnp.zeros((), flat.dtype), flat.size
    triangles = Triangles(*(jnp.zeros((size, size), flat.dtype) for size in (n + 1, n)))
    covariance = jnp.full((n, n), jnp.inf, flat.dtype)
    return SampledState(y, y, jnp.zeros((), jnp.int32), none, none, zero, zero, triangles, covariance)


@eqx.filter_jit
def next_state(problem: SampledProblem, state: SampledState) -> SampledState:
    """After another sample."""
    sample = problem.sample(state.y, state.step)
    flat, unravel = ravel_pytree(state.y)
    current = state.current.joined(Averages.of(flat, sample))
    window = state.last.joined(current)
    to, covariance = window.solution
    y = unravel(flat + jnp.clip(to - flat, -LONGEST, LONGEST))
    ended, none = current.steps >= 2 * state.last.steps, jax.tree.map(jnp.zeros_like, current)
    last = jax.tree.map(lambda new, old: jnp.where(ended, new, old), current, state.last)
    current = jax.tree.map(lambda new, old: jnp.where(ended, new, old), none, current)
    found = sample.loss, window.loss, window.triangles, covariance
    return SampledState(y, state.y, state.step + 1, last, current, *found)


class SampledRun(eqx.Module):
    """A fit by samples, in the form of any other run."""

    state: SampledState
    losses: list[float] = eqx.field(static=True)

    @classmethod
    def of(cls, problem: SampledProblem, y: FreeVariables) -> "SampledRun":
        """Before any step."""
        return cls(first_state(problem, y), [])

    @property
    def evaluated(self) -> FreeVariables:
        """The point whose loss is known."""
        return self.state.evaluated

    @property
    def best(self) -> FreeVariables:
        """The result so far."""
        return self.state.y

    @property
    def loss(self) -> float:
        """Of the samples that it is the result of."""
        return float(self.state.mean_loss)

    @property
    def triangles(self) -> Triangles:
        """Of the same samples."""
        return self.state.triangles

    @property
    def own(self) -> Float[Array, "free free"]:
        """Covariance of the result that is due to the noise of the paths."""
        return self.state.covariance

    def step(self, solver: Any, problem: SampledProblem) -> "SampledRun":
        """After another sample. There is only one solver."""
        state = next_state(problem, self.state)
        loss = float(state.loss)
        # the last result that was finite
        return SampledRun(state if math.isfinite(loss) else self.state, [*self.losses, loss])

    def ratio(self, problem: SampledProblem, limits: Limits) -> float:
        """Largest ratio of the standard error that is due to the paths to that which the references leave, of
        all free variables for which the first one is larger than the tolerances."""
        flat = np.asarray(ravel_pytree(self.best)[0], np.float64)
        own = np.sqrt(np.maximum(np.diag(np.asarray(self.own, np.float64)), 0))
        each = spreads(self.triangles, problem.count, problem.scale).each
        left = np.maximum(np.sqrt(np.sum(each**2, axis=1)), np.finfo(float).tiny)
        loose = own > limits.atol + limits.rtol * np.abs(flat)
        return float(np.max((own / left)[loose], initial=0))

    def ended(self, problem: SampledProblem, limits: Limits) -> Any:
        """The result if the fit has ended, else None."""
        if not math.isfinite(self.losses[-1]):
            return Outcome.nonfinite
        if len(self.losses) >= LEAST and self.ratio(problem, limits) <= ENOUGH:
            return Outcome.successful
        return Outcome.nonlinear_max_steps_reached if len(self.losses) >= limits.max_steps else None

    def message(self, problem: SampledProblem, limits: Limits, result: Any) -> str | None:
        """How the fit ended, if there is more to say than usual."""
        if result == Outcome.nonfinite:
            return None
        ended = (
            "converged" if result == Outcome.successful else "reached the maximum number of steps, max_steps"
        )
        ratio = self.ratio(problem, limits)
        return (
            f"The fit {ended}: noise of its own paths adds {ratio:.2g} times the standard error that the "
            "references leave."
        )
