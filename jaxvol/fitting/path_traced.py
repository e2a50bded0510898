"""Fits by path-traced images: Gauss–Newton steps from averaged noisy samples of residual and Jacobian.

A sample at yₖ is [Jₖ rₖ] by either half of the paths. Products of different halves, of the same or of
different steps, have no bias: means over all such pairs estimate the curvature H = JᵀJ, the gradient g = Jᵀr
and the loss around the mean point ȳ, and so the minimum, ȳ - H⁻¹ g, to which the next step goes. Since noise
of the Jacobians is averaged over many steps, the error is little more than noise of the mean residual.

The first steps, from far away, must be forgotten: an epoch has twice as many steps as the epoch before, and
means are over the last two epochs, half to three quarters of all steps. Unlike stochastic gradient descent
(Robbins and Monro 1951; Polyak and Juditsky 1992), this has no learning rate.
"""

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import Arrayable, all_finite, described, integer
from ..path_tracing import path_trace
from ..ray import check_arguments
from ..scene.camera import Camera
from ..xla.trees import PyTree
from .constraints import Free, FreeVariables, size
from .noise import Noise
from .outcomes import Limits, Outcome
from .references import References
from .residuals import SceneFunction, Triangles, check_scene, jacobian
from .uncertainty import spreads


HELD = 8
"""Number of Jacobians in memory: by two halves of the paths, means over two epochs and both, and copies."""

FLOOR = 0.3
"""Minimum curvature by one sample, relative to that with noise: the unbiased one may be 0 or negative."""

FORGET = 2.0
"""Ratio of the lengths of an epoch and the epoch before."""

MIN_STEPS = 12
"""Minimum number of steps of a fit: standard errors are then known from 9 samples."""

NUMEROUS = 256
"""Number of parameters from which a fit warns of the time that forward mode takes."""

ENOUGH = 0.5
"""Maximum ratio of standard errors, by noise of the paths over by noise of the references, at convergence."""


class PathTracedResidual(eqx.Module):
    """Residual of a fit by path-traced images: images minus reference images, new random images in each step.

    The expected square of this residual exceeds that of the mean image's by the noise of the paths, which
    biases loss and gradient. `fit` therefore takes all products between halves of the paths, which are
    independent, and the losses that it reports of single steps may be negative.

    The path tracer must have derivatives with respect to all free parameters: see `path_trace`. A fit takes
    the Jacobian, in forward mode: for many parameters, such as voxels, minimise the product of residuals that
    `path_trace` describes, by `jax.grad`.

    Args:
        scene: `scene(parameters, camera)` returns the arguments of `path_trace` for the parameters and a
            view's camera: `(volume, transfer, camera, lights, materials)`, and optionally the anisotropy. The
            camera must be of the view's size.
        views: pairs (camera, image), at least one: see `ImageResidual`. An image has three channels. A
            path-traced image must be by another key.
        background: linear RGB behind the volume.
        paths: number of paths for each pixel and step, even. The error of a fit depends on paths times steps.
            From far away, few paths and many steps take less time.
        key: seed of all random numbers, an integer.
        noise: standard deviation of the noise of the references: see `ImageResidual`.

    Raises:
        ValueError: for arguments out of range, and as `ImageResidual`.
    """

    scene: SceneFunction
    references: References
    key: Int[Array, ""]
    paths: int = eqx.field(static=True)

    def __init__(
        self,
        scene: SceneFunction | Any,
        views: Iterable[tuple[Camera, Arrayable]] | Any,
        background: Arrayable = (1.0, 1.0, 1.0),
        *,
        paths: int = 16,
        key: int = 0,
        noise: Arrayable | Sequence[Arrayable | None] | None = None,
    ):
        check_scene(scene)
        self.scene = scene
        self.references = References.of(views, background, noise)
        for _, images in self.references.groups:
            if images.shape[-1] != 3:
                raise ValueError(f"images must have 3 channels to be path-traced; got {images.shape[-1]}.")
        self.paths = integer("paths", paths, 2)
        if self.paths % 2:
            raise ValueError(f"paths must be even, for two independent halves; got {self.paths}.")
        self.key = jnp.asarray(integer("key", key, 0, 2**31 - 1), jnp.int32)

    def halves(self, parameters: PyTree, view: Camera, key: Array) -> Float[Array, "2 height width 3"]:
        """Images by the two halves of the paths."""
        result: Any = self.scene(parameters, view)
        order = "(volume, transfer, camera, lights, materials, anisotropy)"
        if not isinstance(result, tuple) or len(result) not in (5, 6):
            raise ValueError(f"scene must return {order}, the last if it is not 0; got {described(result)}.")
        volume, transfer, camera, lights, materials, anisotropy = cast(Any, (*result, 0.0)[:6])
        check_arguments(order, volume=volume, transfer=transfer, camera=camera)
        if camera.size != view.size:
            raise ValueError(f"scene must return a camera of its view's size {view.size}; got {camera.size}.")
        options: Any = {"materials": materials, "anisotropy": anisotropy, "paths": self.paths, "key": key}
        traced = path_trace(volume, transfer, camera, lights, groups=2, **options)
        return traced.images(self.references.background)


class SampledProblem(eqx.Module):
    """A path-traced residual as a function of the free variables."""

    residual: PathTracedResidual
    free: Free

    @classmethod
    def of(cls, residual: PathTracedResidual, free: Free, y: FreeVariables, limit: int) -> "SampledProblem":
        """The problem, if the Jacobians of a step fit into `limit` bytes."""
        needed = HELD * 4 * residual.references.count * (size(y) + 1)
        if needed > limit:
            raise ValueError(
                f"max_jacobian leaves no room for the Jacobian of {size(y)} parameters and all views, which "
                f"takes {needed} bytes as paths are averaged; got {limit}. Raise it, or fit fewer parameters."
            )
        if size(y) > NUMEROUS:
            warnings.warn(
                f"{size(y)} parameters are differentiated one by one, in forward mode; for so many, such as "
                "voxels, take jax.grad of path_trace and an optimiser of gradients.",
                stacklevel=4,
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

    def reach(self, at: FreeVariables) -> FreeVariables:
        """Maximum change of the free variables in a step."""
        return self.free.reach(at)

    def sample(self, at: FreeVariables, step: Int[Array, ""]) -> Float[Array, "2 pixels 3 numbers"]:
        """[J r] of both halves of the paths at a point, by the random numbers of a step."""
        flat, unravel = ravel_pytree(at)
        key = jax.random.fold_in(jax.random.key(self.residual.key), step)
        weight, number, rows = 1 / math.sqrt(self.count), 0, []
        for cameras, images in self.residual.references.groups:
            numbers = jnp.arange(number, number + len(images), dtype=jnp.uint32)
            number += len(images)

            def view_rows(view: tuple[Camera, Array, Array]) -> Array:
                camera, image, number = view
                view_key = jax.random.fold_in(key, number)

                def residual(flat: Array) -> Array:
                    halves = self.residual.halves(self.free.forward(unravel(flat)), camera, view_key)
                    return ((halves - image[None]) * weight).reshape(-1, 3)

                return jacobian(residual, flat)

            halves = jax.lax.map(view_rows, (cameras, images, numbers))
            halves = halves.reshape(len(images), 2, -1, 3, flat.size + 1)
            rows.append(jnp.swapaxes(halves, 0, 1).reshape(2, -1, 3, flat.size + 1))
        return jnp.concatenate(rows, axis=1)


class Averages(eqx.Module):
    """Means over samples at several points."""

    steps: Float[Array, ""]
    cut: Float[Array, ""]
    """Fraction of samples that a shortened step led to."""
    point: Float[Array, " free"]
    rows: Float[Array, "pixels channels columns"]
    """[J r]."""
    products: Float[Array, "columns columns"]
    """[J r]ᵀ [J r] of a half of the paths."""
    scatter: Float[Array, "columns columns"]
    """Covariance of the scores of a step's mean residual, due to its paths: sum over pixels."""

    @classmethod
    def of(cls, point: Array, cut: Array, sample: Array, known: Array, steps: Array) -> "Averages":
        """Averages over one sample. `known`: the mean rows over `steps` steps before."""
        columns = sample.shape[-1]
        rows, difference = jnp.mean(sample, axis=0), (sample[0] - sample[1])[..., -1:] / 2
        halves = sample.reshape(2, -1, columns)
        products = jnp.mean(jnp.swapaxes(halves, 1, 2) @ halves, axis=0)
        scores = jnp.sum((known + (rows - known) / (steps + 1)) * difference, axis=1)
        one = jnp.ones((), rows.dtype)
        return cls(one, cut.astype(one.dtype), point, rows, products, scores.T @ scores)

    def joined(self, later: "Averages") -> "Averages":
        """Averages over the samples of two."""
        steps = self.steps + later.steps
        means = jax.tree.map(lambda a, b: a + (b - a) * (later.steps / steps), self, later)
        return replace(means, steps=steps)

    def minimum(
        self, reach: Float[Array, " free"]
    ) -> tuple[Float[Array, " free"], Float[Array, "free free"], Float[Array, ""]]:
        """Minimum of a quadratic model of the loss: the point, its covariance by the paths, the loss.

        Steps from the mean point are damped: a single one is divided by 1 + variance / `reach`². Undamped,
        noise would move a parameter that the samples do not show yet, such as a mean free path within an
        opaque material, to where it has no effect.
        """
        flat, halves = self.rows.reshape(-1, self.rows.shape[-1]), 2 * self.steps
        squares = flat.T @ flat
        # mean over all pairs of different halves of all steps
        pairs = (halves * squares - self.products) / (halves - 1)
        curvature, gradient = pairs[:-1, :-1], pairs[:-1, -1]
        norm = jnp.diagonal(squares)[:-1]
        scale = jnp.sqrt(jnp.where(norm > 0, norm, 1))
        values, axes = jnp.linalg.eigh(curvature / jnp.outer(scale, scale))
        axes = axes / jnp.outer(scale, jnp.sqrt(jnp.maximum(values, FLOOR / jnp.sqrt(self.steps))))
        inverse = axes @ axes.T
        step, covariance = inverse @ gradient, inverse @ self.scatter[:-1, :-1] @ inverse / self.steps
        loss = (pairs[-1, -1] - gradient @ step) / 2
        prior = jnp.diagonal(covariance) / (jnp.square(reach) * jnp.diagonal(inverse))
        damped = jnp.linalg.solve(jnp.eye(len(step)) + inverse @ jnp.diag(prior), step)
        return self.point - damped, covariance, loss


_triangles = jax.jit(Triangles.of)


class SampledRun(eqx.Module):
    """State of a fit by samples.

    Attributes:
        best: the result so far, and the point of the next sample.
        evaluated: the point of the last sample.
        cut: whether the step to `best` was shortened, by its length or by more than half by its noise.
        count: number of samples so far.
        last: averages over the last epoch; of no steps at first.
        current: averages over the current epoch.
        window: averages over both epochs.
        sampled: unbiased loss by the last sample, half the sum of squares.
        loss: loss at the minimum, by both epochs.
        path_covariance: covariance of the result that is due to the noise of the paths.
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
    path_covariance: Float[Array, "free free"]

    @classmethod
    @eqx.filter_jit
    def of(cls, problem: SampledProblem | Any, y: FreeVariables) -> "SampledRun":
        """The state before any step. `problem`: an object with the method `sample` of `SampledProblem`."""
        (flat, _), no = ravel_pytree(y), jnp.zeros((), bool)
        sample = eqx.filter_eval_shape(problem.sample, y, jnp.zeros((), jnp.int32))
        averages = eqx.filter_eval_shape(lambda s: Averages.of(flat, no, s, s[0], flat[0]), sample)
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), averages)
        zero, zeros = jnp.zeros((), flat.dtype), jnp.zeros((flat.size, flat.size), flat.dtype)
        return cls(y, y, no, jnp.zeros((), jnp.int32), none, none, none, zero, zero, zeros)

    @eqx.filter_jit
    def advanced(self, problem: SampledProblem | Any) -> "SampledRun":
        """The state after another sample."""
        sample, known = problem.sample(self.best, self.count), self.window
        flat, unravel = ravel_pytree(self.best)
        current = self.current.joined(Averages.of(flat, self.cut, sample, known.rows, known.steps))
        window = self.last.joined(current)
        reach, _ = ravel_pytree(problem.reach(self.best))
        point, covariance, loss = window.minimum(reach)
        step, vague = point - flat, jnp.any(jnp.diagonal(covariance) > jnp.square(reach))
        y, cut = unravel(flat + jnp.clip(step, -reach, reach)), vague | jnp.any(jnp.abs(step) > reach)
        ended, none = current.steps >= FORGET * self.last.steps, jax.tree.map(jnp.zeros_like, current)
        last = jax.tree.map(lambda new, old: jnp.where(ended, new, old), current, self.last)
        current = jax.tree.map(lambda new, old: jnp.where(ended, new, old), none, current)
        sampled = jnp.vdot(*sample[..., -1]) / 2
        count = self.count + 1
        return SampledRun(y, self.best, cut, count, last, current, window, sampled, loss, covariance)

    def step(self, solver: str, problem: SampledProblem) -> tuple["SampledRun", float]:
        """The state after another sample, or this one if that is not finite, and the sample's loss."""
        run = self.advanced(problem)
        # a loss may be finite where its derivative isn't
        finite = all_finite(jax.device_get((run.best, run.sampled)))
        return (run, float(run.sampled)) if finite else (self, math.nan)

    @property
    def triangles(self) -> Triangles:
        """Triangles of the mean residual and Jacobian of the averaged samples."""
        rows, scores, informed = jax.device_get(_triangles(self.window.rows))
        return Triangles(*jax.device_put((np.linalg.qr(rows, "r"), np.linalg.qr(scores, "r"), informed)))

    @property
    def settled(self) -> bool:
        """True if neither the last step nor any step to an averaged sample was shortened."""
        return not (bool(self.cut) or float(self.window.cut) > 0)

    def ratio(self, problem: SampledProblem, limits: Limits) -> float:
        """Largest ratio of standard errors, by paths over by references, beyond the tolerances."""
        flat = np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(jax.device_get(self.best))])
        by_paths = np.sqrt(np.maximum(np.diag(np.asarray(self.path_covariance, np.float64)), 0))
        spread = spreads(self.triangles, problem.count, problem.scale).unequal
        by_references = np.maximum(np.sqrt(np.sum(spread**2, axis=1)), np.finfo(float).tiny)
        loose = by_paths > limits.atol + limits.rtol * np.abs(flat)
        return float(np.max((by_paths / by_references)[loose], initial=0))

    def ended(self, problem: SampledProblem, losses: list[float], limits: Limits) -> Any:
        """The result if the fit has ended, else None."""
        if not math.isfinite(losses[-1]):
            return Outcome.nonfinite
        if self.settled and len(losses) >= MIN_STEPS and self.ratio(problem, limits) <= ENOUGH:
            return Outcome.successful
        return Outcome.nonlinear_max_steps_reached if len(losses) >= limits.max_steps else None

    def message(self, problem: SampledProblem, limits: Limits, result: Outcome) -> str | None:
        """Outcome of the fit in words; None for the text of its result."""
        if result == Outcome.nonfinite:
            return None
        converged = result == Outcome.successful
        ended = "converged" if converged else "reached the maximum number of steps, max_steps"
        if not self.settled:
            return (
                f"The fit {ended}: some of its last steps were shortened, since the minimum is far away, or "
                "noise of the paths hides it."
            )
        return (
            f"The fit {ended}: noise of its own paths adds {self.ratio(problem, limits):.2g} times the "
            f"standard error due to noise of the references ({ENOUGH} is enough)."
        )
