"""Gauss–Newton steps from noisy samples of residual and Jacobian, averaged over steps.

A sample at yₖ is [Jₖ rₖ] by one half of the paths, and the same by the other. Products of different halves,
of the same or of different steps, have no bias: means over all such pairs estimate the curvature H = JᵀJ, the
gradient g = Jᵀr and the loss around the mean point ȳ, and so the minimum, ȳ - H⁻¹ g. Each step goes there. As
residuals are multiplied by Jacobians of many steps, whose noise is averaged, little more is left than the
noise of the mean residual.

The first steps, from far away, must be forgotten: steps fall into epochs, each twice as long as the one
before, and means are over this epoch and the last, which is half to three quarters of all steps. Without
noise, the first steps are Gauss–Newton's.

Unlike stochastic gradient descent, whose steps must become small at a rate that fits the curvature (Robbins
and Monro 1951; Polyak and Juditsky 1992), nothing needs to be chosen.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .constraints import FreeVariables
from .outcomes import Limits, Outcome
from .path_traced import Sample, SampledProblem
from .residuals import Triangles
from .uncertainty import spreads


LONGEST = 1.0, 0.5
"""A step moves no free variable by more than the first, or than this part of itself, whichever is more."""

FLOOR = 0.3
"""Smallest curvature in any direction by a single sample, relative to that with noise, which is larger: the
unbiased one may be 0 or negative. With the number of samples, it falls as their noise."""

FORGET = 2.0
"""How many times as long as the one before an epoch is."""

LEAST = 12
"""Steps that a fit takes at least: standard errors are known from 9 samples then."""

ENOUGH = 0.5
"""A fit has converged when the noise of its own paths is at most this fraction of the standard error that the
references leave: together, these are at most 12 % larger than the latter; and no step of those that are
averaged was shortened, since the minimum lay too far away."""


class Estimate(NamedTuple):
    """Of the minimum, from averages.

    Attributes:
        point: where the gradient is 0.
        covariance: of this point, due to the noise of the paths.
        loss: there.
        loss_error: standard error of the loss, likewise.
    """

    point: Float[Array, " free"]
    covariance: Float[Array, "free free"]
    loss: Float[Array, ""]
    loss_error: Float[Array, ""]


class Averages(eqx.Module):
    """Means over samples at several points."""

    steps: Float[Array, ""]
    cut: Float[Array, ""]
    """1 for a sample that a shortened step led to, else 0."""
    point: Float[Array, " free"]
    rows: Float[Array, "pixels channels columns"]
    """[J r]."""
    products: Float[Array, "columns columns"]
    """[J r]ᵀ [J r] of each half of the paths."""
    scatter: Float[Array, "columns columns"]
    """Of the scores of a step's mean residual, and of what it adds to the loss: sum over pixels of their
    variance due to its paths."""
    squares: Float[Array, ""]
    """Of the mean residual up to a step, noise included: their sum over pixels."""
    fourth: Float[Array, ""]
    """Sum over pixels of the squared variance of a step's mean residual, at most."""

    @classmethod
    def of(
        cls, point: Float[Array, " free"], cut: Array, sample: Sample, known: Array, others: Array
    ) -> "Averages":
        """Of one sample. `known`: the mean rows over `others` steps before."""
        columns = sample.rows.shape[-1]
        rows, apart = jnp.mean(sample.rows, axis=0), (sample.rows[0] - sample.rows[1])[..., -1:] / 2
        halves = sample.rows.reshape(2, -1, columns)
        products = jnp.mean(jnp.swapaxes(halves, 1, 2) @ halves, axis=0)
        mean = known + (rows - known) / (others + 1)
        scores = jnp.sum(mean * apart, axis=1)
        fourth = jnp.sum(jnp.sum(apart**2, axis=(1, 2)) ** 2)
        squares = jnp.sum(mean[..., -1] ** 2)
        one = jnp.ones((), rows.dtype)
        return cls(one, cut.astype(one.dtype), point, rows, products, scores.T @ scores, squares, fourth)

    def joined(self, other: "Averages") -> "Averages":
        """Over the samples of both."""
        steps = self.steps + other.steps
        share = other.steps / steps
        both = jax.tree.map(lambda a, b: a + (b - a) * share, self, other)
        return eqx.tree_at(lambda each: each.steps, both, steps)

    @property
    def estimate(self) -> Estimate:
        """Of the minimum, by a loss that is quadratic around it."""
        flat, halves = self.rows.reshape(-1, self.rows.shape[-1]), 2 * self.steps
        squares = flat.T @ flat
        # over all pairs of different halves of all steps
        pairs = (halves * squares - self.products) / (halves - 1)
        curvature, gradient = pairs[:-1, :-1], pairs[:-1, -1]
        size = jnp.diagonal(squares)[:-1]
        scale = jnp.sqrt(jnp.where(size > 0, size, 1))
        values, axes = jnp.linalg.eigh(curvature / jnp.outer(scale, scale))
        axes = axes / jnp.outer(scale, jnp.sqrt(jnp.maximum(values, FLOOR / jnp.sqrt(self.steps))))
        inverse = axes @ axes.T
        covariance = inverse @ self.scatter[:-1, :-1] @ inverse / self.steps
        loss = (pairs[-1, -1] - gradient @ inverse @ gradient) / 2
        # of a loss that is not noise, as much is uncertain as noise is correlated with it
        share = jnp.clip(2 * loss / jnp.maximum(self.squares, jnp.finfo(loss.dtype).tiny), 0, 1)
        error = jnp.sqrt(self.fourth / 2 / self.steps**2 + share * self.scatter[-1, -1] / self.steps)
        return Estimate(self.point - inverse @ gradient, covariance, loss, error)


class SampledState(eqx.Module):
    """State of such a fit.

    Attributes:
        y: where the next sample is taken.
        evaluated: where the last one was.
        cut: whether the step to `y` was shortened.
        step: number of samples so far.
        last: averages over the last epoch; of no steps at first.
        current: over this one.
        window: over both.
        loss: by the last sample.
        estimate: from both epochs.
    """

    y: FreeVariables
    evaluated: FreeVariables
    cut: Bool[Array, ""]
    step: Int[Array, ""]
    last: Averages
    current: Averages
    window: Averages
    loss: Float[Array, ""]
    estimate: Estimate


@eqx.filter_jit
def first_state(problem: SampledProblem | Any, y: FreeVariables) -> SampledState:
    """Before any step. `problem`: whatever has such a method `sample`."""
    (flat, _), no = ravel_pytree(y), jnp.zeros((), bool)
    sample = eqx.filter_eval_shape(problem.sample, y, jnp.zeros((), jnp.int32))
    averages = eqx.filter_eval_shape(lambda s: Averages.of(flat, no, s, s.rows[0], flat[0]), sample)
    none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), averages)
    zero, n = jnp.zeros((), flat.dtype), flat.size
    estimate = Estimate(flat, jnp.zeros((n, n), flat.dtype), zero, zero)
    return SampledState(y, y, no, jnp.zeros((), jnp.int32), none, none, none, zero, estimate)


@eqx.filter_jit
def next_state(problem: SampledProblem | Any, state: SampledState) -> SampledState:
    """After another sample."""
    sample = problem.sample(state.y, state.step)
    flat, unravel = ravel_pytree(state.y)
    known = state.window
    added = Averages.of(flat, state.cut, sample, known.rows, known.steps)
    current = state.current.joined(added)
    window = state.last.joined(current)
    estimate = window.estimate
    step, most = estimate.point - flat, jnp.maximum(LONGEST[0], LONGEST[1] * jnp.abs(flat))
    y, cut = unravel(flat + jnp.clip(step, -most, most)), jnp.any(jnp.abs(step) > most)
    ended, none = current.steps >= FORGET * state.last.steps, jax.tree.map(jnp.zeros_like, current)
    last = jax.tree.map(lambda new, old: jnp.where(ended, new, old), current, state.last)
    current = jax.tree.map(lambda new, old: jnp.where(ended, new, old), none, current)
    return SampledState(y, state.y, cut, state.step + 1, last, current, window, sample.loss, estimate)


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
        """At the result, by the samples that it follows from."""
        return float(self.state.estimate.loss)

    @property
    def loss_error(self) -> float:
        """Standard error of the loss, due to the noise of the paths."""
        return float(self.state.estimate.loss_error)

    @property
    def triangles(self) -> Triangles:
        """Of the mean residual and Jacobian of the same samples."""
        rows = np.asarray(self.state.window.rows)
        scores = np.sum(rows[..., :-1] * rows[..., -1:], axis=1)
        both = rows.reshape(-1, rows.shape[-1]), scores
        factors: Any = (np.linalg.qr(each, "r") for each in both)
        return Triangles(*(jnp.asarray(factor) for factor in factors))

    @property
    def own(self) -> Float[Array, "free free"]:
        """Covariance of the result that is due to the noise of the paths."""
        return self.state.estimate.covariance

    def step(self, solver: Any, problem: SampledProblem) -> "SampledRun":
        """After another sample. There is only one solver."""
        state = next_state(problem, self.state)
        loss = float(state.loss)
        # a loss may be finite where its derivative isn't
        if not np.all(np.isfinite(ravel_pytree(state.y)[0])):
            loss = math.nan
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

    @property
    def settled(self) -> bool:
        """Whether no step to a sample that is averaged, nor the last one, was shortened."""
        return not (bool(self.state.cut) or self.state.window.cut > 0)

    def ended(self, problem: SampledProblem, limits: Limits) -> Any:
        """The result if the fit has ended, else None."""
        if not math.isfinite(self.losses[-1]):
            return Outcome.nonfinite
        if self.settled and len(self.losses) >= LEAST and self.ratio(problem, limits) <= ENOUGH:
            return Outcome.successful
        return Outcome.nonlinear_max_steps_reached if len(self.losses) >= limits.max_steps else None

    def message(self, problem: SampledProblem, limits: Limits, result: Any) -> str | None:
        """How the fit ended, if there is more to say than usual."""
        if result == Outcome.nonfinite:
            return None
        ended = (
            "converged" if result == Outcome.successful else "reached the maximum number of steps, max_steps"
        )
        if not self.settled:
            return f"The fit {ended}: some of its last steps were shortened, since the answer is far off."
        ratio = self.ratio(problem, limits)
        return (
            f"The fit {ended}: noise of its own paths adds {ratio:.2g} times the standard error that the "
            f"references leave ({ENOUGH} is enough)."
        )
