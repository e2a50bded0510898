"""Fits by path-traced images: Gauss–Newton steps from noisy samples of residual and Jacobian, averaged.

A sample at yₖ is [Jₖ rₖ] by one half of the paths, and the same by the other. Products of different halves,
of the same or of different steps, have no bias: means over all such pairs estimate the curvature H = JᵀJ, the
gradient g = Jᵀr and the loss around the mean point ȳ, and so the minimum, ȳ - H⁻¹ g. Each step goes there. As
residuals are multiplied by Jacobians of many steps, whose noise is averaged, little more is left than the
noise of the mean residual.

The first steps, from far away, must be forgotten: steps fall into epochs, each twice as long as the one
before, and means are over this epoch and the last, which is half to three quarters of all steps. Unlike in
stochastic gradient descent (Robbins and Monro 1951; Polyak and Juditsky 1992), no rate needs to be chosen.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import Arrayable, described, integer
from ..path_tracing import path_trace
from ..ray import check_arguments
from ..scene.camera import Camera
from .constraints import Free, FreeVariables, size
from .noise import Noise
from .outcomes import Limits, Outcome
from .references import References
from .residuals import Triangles, check_scene, jacobian
from .uncertainty import spreads


HELD = 8
"""Jacobians that are held at once: by two halves of the paths, means over two epochs and both, and copies."""

LONGEST = 1.0, 0.5
"""A step moves no free variable by more than the first, or than this part of itself, whichever is more."""

FLOOR = 0.3
"""Least curvature by one sample, over that with noise, as the unbiased one may be 0 or negative."""

FORGET = 2.0
"""How many times as long as the one before an epoch is."""

LEAST = 12
"""Steps that a fit takes at least: standard errors are known from 9 samples then."""

ENOUGH = 0.5
"""A fit converges when its paths' noise is at most this part of the references' standard error."""


class PathTracedResidual(eqx.Module):
    """Path-traced images minus reference images, as the residual of a fit; with other random numbers in each
    step.

    Its square is larger than that of the mean image's residual, by the noise of the paths, which depends on
    the parameters, and so does its gradient. `fit` therefore takes all products between halves of the paths,
    which are independent, and the losses that it reports of single steps may be negative.

    What is free must be differentiable by the path tracer: see `path_trace`.

    Args:
        scene: `scene(parameters, camera)` returns what to trace for the parameters and a view's camera:
            `(volume, transfer, camera, lights, materials)`, and the anisotropy as a sixth entry, as
            `path_trace` takes them. The camera must be of the view's size.
        views: pairs (camera, image), at least one: see `ImageResidual`. An image has three channels. Where it
            is path-traced, it must be by another key.
        background: linear RGB behind the volume.
        paths: for each pixel and step, even. How near a fit comes depends on paths times steps. From far
            away, few paths and many steps take less time.
        key: seed of all random numbers, an integer.
        noise: standard deviation of the noise of the references: see `ImageResidual`.

    Raises:
        ValueError: for arguments out of these ranges, and as `ImageResidual`.
    """

    scene: Callable[[Any, Camera], tuple[Any, ...]]
    references: References
    key: Int[Array, ""]
    paths: int = eqx.field(static=True)

    def __init__(
        self,
        scene: Callable[[Any, Camera], tuple[Any, ...]] | Any,
        views: Iterable[tuple[Camera, Arrayable]] | Any,
        background: Arrayable = (1.0, 1.0, 1.0),
        *,
        paths: int | Any = 16,
        key: int | Any = 0,
        noise: Arrayable | Sequence[Arrayable | None] | None = None,
    ):
        check_scene(scene)
        self.scene = cast(Any, scene)
        self.references = References.of(views, background, noise)
        for _, images in self.references.groups:
            if images.shape[-1] != 3:
                raise ValueError(f"images must have 3 channels to be path-traced; got {images.shape[-1]}.")
        self.paths = integer("paths", paths, 2)
        if self.paths % 2:
            raise ValueError(f"paths must be even, for two independent halves; got {self.paths}.")
        self.key = jnp.asarray(integer("key", key, 0, 2**31 - 1), jnp.int32)

    def halves(self, parameters: Any, view: Camera, key: Any) -> Float[Array, "2 height width 3"]:
        """Images by the two halves of the paths."""
        result: Any = self.scene(parameters, view)
        order = "(volume, transfer, camera, lights, materials, anisotropy)"
        if not isinstance(result, tuple) or len(result) not in (5, 6):
            raise ValueError(f"scene must return {order}, the last if it is not 0; got {described(result)}.")
        volume, transfer, camera, lights, materials, anisotropy = cast(Any, (*result, 0.0)[:6])
        check_arguments(order, volume=volume, transfer=transfer, camera=camera)
        if camera.size != view.size:
            raise ValueError(f"scene must return a camera of its view's size {view.size}; got {camera.size}.")
        how: Any = {"materials": materials, "anisotropy": anisotropy, "paths": self.paths, "key": key}
        traced = path_trace(volume, transfer, camera, lights, groups=2, **how)
        return traced.images(self.references.background)


class SampledProblem(eqx.Module):
    """A path-traced residual as a function of the free variables."""

    residual: PathTracedResidual
    free: Free

    @classmethod
    def of(cls, residual: PathTracedResidual, free: Free, y: FreeVariables, most: int) -> "SampledProblem":
        """Checks that the Jacobians that a step holds fit into `most` bytes."""
        needed = HELD * 4 * residual.references.count * (size(y) + 1)
        if needed > most:
            raise ValueError(
                f"max_jacobian leaves no room for the Jacobian of {size(y)} parameters and all views, which "
                f"takes {needed} bytes as paths are averaged; got {most}. Raise it, or fit fewer parameters."
            )
        return cls(residual, free)

    @property
    def count(self) -> int:
        """Number of entries."""
        return self.residual.references.count

    @property
    def noise(self) -> Noise | None:
        """Noise of the references."""
        return self.residual.references.noise

    @property
    def scale(self) -> float:
        """Norm of the references."""
        return self.residual.references.scale()

    def sample(self, at: FreeVariables, step: Int[Array, ""]) -> Float[Array, "2 pixels 3 numbers"]:
        """[J r] of each half of the paths at a point, by the random numbers of a step."""
        flat, unravel = ravel_pytree(at)
        key = jax.random.fold_in(jax.random.key(self.residual.key), step)
        weight, number, rows = 1 / math.sqrt(self.count), 0, []
        for cameras, images in self.residual.references.groups:
            numbers = jnp.arange(number, number + len(images), dtype=jnp.uint32)
            number += len(images)

            def of_view(view: Any) -> Array:
                camera, image, number = view
                of_step = jax.random.fold_in(key, number)

                def residual(flat: Array) -> Array:
                    halves = self.residual.halves(self.free.forward(unravel(flat)), camera, of_step)
                    return ((halves - image[None]) * weight).reshape(-1, 3)

                return jacobian(residual, flat)

            found = jax.lax.map(of_view, (cameras, images, numbers))
            of_half = found.reshape(len(images), 2, -1, 3, flat.size + 1)
            rows.append(jnp.swapaxes(of_half, 0, 1).reshape(2, -1, 3, flat.size + 1))
        return jnp.concatenate(rows, axis=1)


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
    """Of the scores of a step's mean residual: sum over pixels of their variance due to its paths."""

    @classmethod
    def of(cls, point: Array, cut: Array, sample: Array, known: Array, others: Array) -> "Averages":
        """Of one sample. `known`: the mean rows over `others` steps before."""
        columns = sample.shape[-1]
        rows, apart = jnp.mean(sample, axis=0), (sample[0] - sample[1])[..., -1:] / 2
        halves = sample.reshape(2, -1, columns)
        products = jnp.mean(jnp.swapaxes(halves, 1, 2) @ halves, axis=0)
        scores = jnp.sum((known + (rows - known) / (others + 1)) * apart, axis=1)
        one = jnp.ones((), rows.dtype)
        return cls(one, cut.astype(one.dtype), point, rows, products, scores.T @ scores)

    def joined(self, other: "Averages") -> "Averages":
        """Over the samples of both."""
        steps = self.steps + other.steps
        both = jax.tree.map(lambda a, b: a + (b - a) * (other.steps / steps), self, other)
        return replace(both, steps=steps)

    @property
    def minimum(self) -> tuple[Float[Array, " free"], Float[Array, "free free"], Float[Array, ""]]:
        """Minimum of a quadratic model of the loss: the point, its covariance by the paths, the loss."""
        flat, halves = self.rows.reshape(-1, self.rows.shape[-1]), 2 * self.steps
        squares = flat.T @ flat
        # over all pairs of different halves of all steps
        pairs = (halves * squares - self.products) / (halves - 1)
        curvature, gradient = pairs[:-1, :-1], pairs[:-1, -1]
        norm = jnp.diagonal(squares)[:-1]
        scale = jnp.sqrt(jnp.where(norm > 0, norm, 1))
        values, axes = jnp.linalg.eigh(curvature / jnp.outer(scale, scale))
        axes = axes / jnp.outer(scale, jnp.sqrt(jnp.maximum(values, FLOOR / jnp.sqrt(self.steps))))
        inverse = axes @ axes.T
        covariance = inverse @ self.scatter[:-1, :-1] @ inverse / self.steps
        loss = (pairs[-1, -1] - gradient @ inverse @ gradient) / 2
        return self.point - inverse @ gradient, covariance, loss


class SampledRun(eqx.Module):
    """State of a fit by samples.

    Attributes:
        best: the result so far, where the next sample is taken.
        evaluated: where the last one was.
        cut: whether the step to `best` was shortened.
        count: number of samples so far.
        last: averages over the last epoch; of no steps at first.
        current: over this one.
        window: over both.
        sampled: the loss by the last sample, half the sum of squares, unbiased.
        loss: at the minimum, by both epochs.
        own: covariance of the result that is due to the noise of the paths.
    """

    best: FreeVariables
    evaluated: FreeVariables
    cut: Bool[Array, ""]
    count: Int[Array, ""]
    last: Averages
    current: Averages
    window: Averages
    sampled: Float[Array, ""]
    loss: Float[Array, ""]
    own: Float[Array, "free free"]

    @classmethod
    def of(cls, problem: SampledProblem | Any, y: FreeVariables) -> "SampledRun":
        """The state before any step. `problem`: anything with such a method `sample`."""
        (flat, _), no = ravel_pytree(y), jnp.zeros((), bool)
        sample = eqx.filter_eval_shape(problem.sample, y, jnp.zeros((), jnp.int32))
        averages = eqx.filter_eval_shape(lambda s: Averages.of(flat, no, s, s[0], flat[0]), sample)
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), averages)
        zero, own = jnp.zeros((), flat.dtype), jnp.zeros((flat.size, flat.size), flat.dtype)
        return cls(y, y, no, jnp.zeros((), jnp.int32), none, none, none, zero, zero, own)

    @eqx.filter_jit
    def advanced(self, problem: SampledProblem | Any) -> "SampledRun":
        """The state after another sample."""
        sample, known = problem.sample(self.best, self.count), self.window
        flat, unravel = ravel_pytree(self.best)
        current = self.current.joined(Averages.of(flat, self.cut, sample, known.rows, known.steps))
        window = self.last.joined(current)
        point, own, loss = window.minimum
        step, most = point - flat, jnp.maximum(LONGEST[0], LONGEST[1] * jnp.abs(flat))
        y, cut = unravel(flat + jnp.clip(step, -most, most)), jnp.any(jnp.abs(step) > most)
        ended, none = current.steps >= FORGET * self.last.steps, jax.tree.map(jnp.zeros_like, current)
        last = jax.tree.map(lambda new, old: jnp.where(ended, new, old), current, self.last)
        current = jax.tree.map(lambda new, old: jnp.where(ended, new, old), none, current)
        sampled = jnp.vdot(*sample[..., -1]) / 2
        return SampledRun(y, self.best, cut, self.count + 1, last, current, window, sampled, loss, own)

    def step(self, solver: Any, problem: SampledProblem) -> tuple["SampledRun", float]:
        """The last state that is finite, and the loss of another sample. There is only one solver."""
        run = self.advanced(problem)
        # a loss may be finite where its derivative isn't
        finite = np.all(np.isfinite(ravel_pytree(run.best)[0])) and np.isfinite(run.sampled)
        return (run, float(run.sampled)) if finite else (self, math.nan)

    @property
    def triangles(self) -> Triangles:
        """Triangles of the mean residual and Jacobian of the averaged samples."""
        rows = np.asarray(self.window.rows)
        scores = np.sum(rows[..., :-1] * rows[..., -1:], axis=1)
        both = rows.reshape(-1, rows.shape[-1]), scores
        factors: Any = (np.linalg.qr(each, "r") for each in both)
        return Triangles(*(jnp.asarray(factor) for factor in factors))

    @property
    def settled(self) -> bool:
        """Whether no step to a sample that is averaged, nor the last one, was shortened."""
        return not (bool(self.cut) or self.window.cut > 0)

    def ratio(self, problem: SampledProblem, limits: Limits) -> float:
        """Largest ratio of standard errors, by paths over by references, beyond the tolerances."""
        flat = np.asarray(ravel_pytree(self.best)[0], np.float64)
        own = np.sqrt(np.maximum(np.diag(np.asarray(self.own, np.float64)), 0))
        each = spreads(self.triangles, problem.count, problem.scale).each
        left = np.maximum(np.sqrt(np.sum(each**2, axis=1)), np.finfo(float).tiny)
        loose = own > limits.atol + limits.rtol * np.abs(flat)
        return float(np.max((own / left)[loose], initial=0))

    def ended(self, problem: SampledProblem, losses: list[float], limits: Limits) -> Any:
        """The result if the fit has ended, else None."""
        if not math.isfinite(losses[-1]):
            return Outcome.nonfinite
        if self.settled and len(losses) >= LEAST and self.ratio(problem, limits) <= ENOUGH:
            return Outcome.successful
        return Outcome.nonlinear_max_steps_reached if len(losses) >= limits.max_steps else None

    def message(self, problem: SampledProblem, limits: Limits, result: Any) -> str | None:
        """How the fit ended, if there is more to say than usual."""
        if result == Outcome.nonfinite:
            return None
        converged = result == Outcome.successful
        ended = "converged" if converged else "reached the maximum number of steps, max_steps"
        if not self.settled:
            return f"The fit {ended}: some of its last steps were shortened, since the answer is far off."
        return (
            f"The fit {ended}: noise of its own paths adds {self.ratio(problem, limits):.2g} times the "
            f"standard error that the references leave ({ENOUGH} is enough)."
        )
