"""Which steps, quadratures and strides are within a tolerance, and what do they cost?"""

import math
import time
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..compositing.blending import Over
from ..march.march import March, Quadrature, Transform
from ..march.transforms import AdaptiveSampling
from ..scene.rendering import Rendering
from ..scene.transfer import Transfer
from ..scene.variation import Windows
from .probe import Probe, Setting, Truth


SAMPLE = {"midpoint": 1.0, "preintegrated": 2.5, "adaptive": 2.1}
"""What a sample costs, as a multiple of one by the midpoint rule."""

RAY = 22.0
"""What a pixel costs beside its samples, in samples by the midpoint rule: cells that are computed and not
used, leaps, the ray. Fitted, like `SAMPLE`, to the times of `experiments.accuracy` (five scenes, two CPU
cores), whose ratios they predict within 9 % in the mean, 28 % at most."""

COARSEST, FINE, FINEST = 2.0, 1 / 32, 1 / 256
"""Voxels of the longest step that is tried, and of the shortest: with the midpoint rule where cells can be
integrated, too, and otherwise. A step is proven by images of a half and a quarter of it."""

LONGEST = 8
"""Steps of the longest cell under adaptive sampling, the shortest of which are half as long as uniform
ones."""


SLOWER = "not within the tolerance where it would be faster"


class Trial(NamedTuple):
    """A march, the error of its image, samples for each pixel, and a key of `SAMPLE`."""

    march: March
    error: float
    samples: float
    kind: str

    @property
    def cost(self) -> float:
        """Of a pixel, in samples by the midpoint rule."""
        return RAY + SAMPLE[self.kind] * self.samples


class Trials:
    """Marches of one scene that have been tried.

    - `goal`: the error that they may have. `beyond`: that of the image, above which the plan fails.
    - `voxel`: world length that steps are counted in. `transforms`: of all marches.
    - `seconds`: that each image took, by quadrature and step, compilation included where there was any.
    """

    def __init__(
        self,
        probe: Probe,
        setting: Setting,
        goal: float,
        beyond: float,
        voxel: float,
        transforms: tuple[Transform, ...],
    ):
        self.probe, self.setting, self.goal, self.beyond = probe, setting, goal, beyond
        self.voxel, self.transforms = voxel, transforms
        self.seconds: dict[tuple[Quadrature, float], float] = {}
        self._images: dict[tuple[Quadrature, float], Rendering] = {}

    def march(self, step: float, quadrature: Quadrature = "midpoint", *more: Transform) -> March:
        """A march with this step, in voxels."""
        return March(step * self.voxel, (*self.transforms, *more), quadrature)

    def image(self, step: float, quadrature: Quadrature) -> Rendering:
        """Of steps of this length, in voxels."""
        if (quadrature, step) not in self._images:
            march, begun = self.march(step, quadrature), time.perf_counter()
            image = jax.block_until_ready(self.probe.render(self.setting, march))
            self._images[quadrature, step] = image
            self.seconds[quadrature, step] = time.perf_counter() - begun
        return self._images[quadrature, step]

    def steps(self, quadrature: Quadrature) -> tuple[float, float]:
        """The shortest and the longest step that was tried, in voxels."""
        tried = [step for of, step in self._images if of == quadrature]
        return min(tried), max(tried)

    @property
    def integrable(self) -> bool:
        """Whether cells can be integrated between their ends."""
        known = False

        def ask(transfer: Transfer) -> None:
            nonlocal known
            known = transfer.integrator() is not None

        # as shapes: its tables take seconds to compile, operation by operation
        eqx.filter_eval_shape(ask, self.setting.transfer)
        return known and isinstance(self.setting.compositing, Over)

    def uniform(self) -> tuple[Trial, Truth]:
        """The longest steps within the goal: by the midpoint rule; or integrated, where that takes more than
        8 steps of a voxel, or cannot be proven with them. And what they were compared with."""
        found, truth = self._longest("midpoint", FINE if self.integrable else FINEST)
        if found.error > self.goal and self.integrable and math.isfinite(found.error):
            found, truth = self._longest("preintegrated", FINEST)
            tried = found, *self._sampled(truth)
            found = min(tried, key=lambda each: (each.error > self.goal, each.cost))
        return found, truth

    def _sampled(self, truth: Truth) -> Iterator[Trial]:
        """The longest steps within the goal by the midpoint rule, if any that was tried is: the truth may be
        known better now."""
        for step in sorted((step for of, step in self._images if of == "midpoint"), reverse=True):
            error = truth.error(self.image(step, "midpoint"))
            if error <= self.goal:
                yield self._trial(*self._between(step, error, truth, "midpoint"), "midpoint")
                return

    def _longest(self, quadrature: Quadrature, finest: float) -> tuple[Trial, Truth]:
        """The longest steps within the goal, compared with steps of a quarter of them or less. If there are
        none, the finest, whose error is not known: just `beyond`, or more."""
        steps = [COARSEST, COARSEST / 2, COARSEST / 4]
        while True:
            truth = Truth.of(self.probe, [self.image(step, quadrature) for step in steps])
            best = steps[-3]
            error = truth.error(self.image(best, quadrature))
            if error <= self.goal or steps[-1] <= finest or not math.isfinite(error):
                break
            steps.append(steps[-1] / 2)
        if error > self.goal and math.isfinite(error):
            best, error = steps[-1], max(truth.own, math.nextafter(self.beyond, math.inf))
        elif best < COARSEST:
            best, error = self._between(best, error, truth, quadrature)
        return self._trial(best, error, quadrature), truth

    def _trial(self, step: float, error: float, quadrature: Quadrature) -> Trial:
        samples = self.probe.mean(self.image(step, quadrature).samples)
        return Trial(self.march(step, quadrature), error, samples, quadrature)

    def _between(
        self, step: float, error: float, truth: Truth, quadrature: Quadrature
    ) -> tuple[float, float]:
        """A longer step within the goal, below twice this one, which is not: where it should lie if the error
        is a power of the step; if that fails, halfway."""
        low, high = (step, error), (2 * step, truth.error(self.image(2 * step, quadrature)))
        for attempt in range(3):
            if low[1] <= 0 or not math.isfinite(high[1]) or high[1] <= low[1]:
                break
            power = math.log(high[1] / low[1]) / math.log(high[0] / low[0])
            longer = low[0] * (0.97 * self.goal / low[1]) ** (1 / power)
            if attempt == 2 and low[0] == step:
                longer = math.sqrt(low[0] * high[0])
            if not 1.05 * low[0] < longer < high[0]:
                break
            tried = longer, truth.error(self.image(longer, quadrature))
            low, high = (tried, high) if tried[1] <= self.goal else (low, tried)
        return low

    def _tried(self, march: March, kind: str, truth: Truth) -> Trial:
        """A march, rendered."""
        image = self.probe.render(self.setting, march)
        return Trial(march, truth.error(image), self.probe.mean(image.samples), kind)

    def integrated(self, step: float, truth: Truth) -> Trial | str:
        """Pre-integration with the longest steps within the goal, if that is faster than the midpoint rule
        with this `step`, in voxels; or why not."""
        if not self.integrable:
            return "these cells cannot be integrated"
        found, longer = None, step * SAMPLE["preintegrated"]
        while longer <= 2 * COARSEST:
            trial = self._tried(self.march(longer, "preintegrated"), "preintegrated", truth)
            if trial.error > self.goal:
                break
            found, longer = trial, longer * 1.5
        return found or SLOWER

    def adaptive(self, step: float, truth: Truth) -> Trial | str:
        """Adaptive sampling, with cells from half this step on, and the largest tolerance of its own that
        keeps the goal; or why not."""
        if not bool(_predictable(self.setting)):
            return "it cannot be predicted how this scene varies"
        found, tolerance = None, 2 * self.goal
        for _ in range(4):
            march = self.march(step / 2, "midpoint", AdaptiveSampling(tolerance, LONGEST))
            trial = self._tried(march, "adaptive", truth)
            if trial.error <= self.goal:
                if found is not None and trial.samples >= found.samples:
                    break
                found = trial
                if trial.error > 0.7 * self.goal:
                    break
                tolerance *= min((0.9 * self.goal / max(trial.error, 1e-12)) ** 1.5, 8)
            elif found is not None:
                break
            else:
                tolerance /= 4
        return found or SLOWER


@eqx.filter_jit
def _predictable(setting: Setting) -> Bool[Array, ""]:
    """Whether it is known anywhere how the scene varies."""
    varies = setting.compositing.variation(setting.transfer, Windows.of(setting.volume))
    return jnp.any(jnp.isfinite(varies.total))
