"""Search for the cheapest step and quadrature within a tolerance."""

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import jax

from ..compositing.blending import Over
from ..march.march import March, Quadrature, Transform
from ..ray import Scene
from ..scene.rendering import Rendering
from .probe import Probe, Reference


# Costs of a sample, and of a pixel without its samples, in samples by the midpoint rule. Fitted to the times
# of `experiments.accuracy` (two CPU cores), whose ratios they predict within 9 % in the mean, 28 % at most.
SAMPLE = {"midpoint": 1.0, "preintegrated": 2.5}
RAY = 22.0

# Steps in voxels: the first, the shortest by the midpoint rule if cells can be integrated, and the shortest.
COARSEST, FINE, FINEST = 2.0, 1 / 16, 1 / 128

# Refinements between a step within the goal and a longer one, and the fraction of the goal they aim at.
REFINED, AIM = 2, 0.97

# With at most WORTHWHILE samples a pixel by the midpoint rule, integrated cells save no more than 16 %, even
# if they are four times as long. With steps shorter than FAIR voxels they may be longer.
WORTHWHILE, FAIR = 16, 0.5


class Part(NamedTuple):
    """A decision of a plan, with its reason."""

    name: str
    kept: bool
    why: str


class Trial(NamedTuple):
    """A march and its image of the probe."""

    step: float  # voxels
    march: March
    image: Rendering
    samples: float  # per pixel
    error: float = math.inf

    @property
    def cost(self) -> float:
        """Cost per pixel, in samples by the midpoint rule."""
        return RAY + SAMPLE[self.march.quadrature] * self.samples


@dataclass
class Search:
    """Trial marches of one scene, rendered at the pixels of a probe."""

    probe: Probe
    scene: Scene
    goal: float  # tolerance of a march
    tolerance: float  # tolerance of the image
    voxel: float  # world length, the unit of steps
    transforms: tuple[Transform, ...]
    rendered: dict[tuple[float, Quadrature], Trial] = field(default_factory=dict)  # by step in voxels

    def cheapest(self, *, once: bool, between: bool = False) -> tuple[Trial, Reference, list[Part]]:
        """The cheapest march within the goal, the reference, and the decisions. `once`: as for `plan`.
        `between`: features may lie between samples, so that cells must be integrated."""
        can_integrate = integrable(self.scene)
        between = between and can_integrate
        first: Quadrature = "preintegrated" if between else "midpoint"
        trial, reference = self._longest(first, last=between or not can_integrate)
        if first == "midpoint" and trial.error > self.goal and can_integrate and math.isfinite(trial.error):
            trial, reference = self._longest("preintegrated", last=True)
        if trial.march.quadrature == "preintegrated" and trial.error <= self.goal:
            trial = min(trial, self._midpoint(trial, reference), key=lambda trial: trial.cost)
        if not math.isfinite(trial.error):
            why = "the image is not finite, or rays use up their samples"
        elif trial.error > self.goal:
            why = f"{trial.step:.2g} voxels, the shortest tried: not proven to be within the tolerance"
        else:
            why = f"{trial.step:.3g} voxels, {trial.march.quadrature}: RMSE {trial.error:.2g}"
        step_part = Part(_name(trial), True, why)
        if trial.error > self.goal:
            return trial, reference, [step_part]
        integrated = None
        if trial.march.quadrature == "preintegrated":
            why = "the midpoint rule would be slower within the tolerance"
        elif trial.samples <= WORTHWHILE and trial.step >= FAIR:
            why = f"{trial.samples:.1f} samples a pixel: too few to save any"
        elif once:
            why = "not tried for one image: an extra program takes longer to compile than it saves"
        elif not can_integrate:
            why = "these cells cannot be integrated"
        elif integrated := self._integrated(trial.step, reference):
            fewer = f"{integrated.samples:.1f} samples a pixel for {trial.samples:.1f}"
            why = f"{_name(integrated)}, {fewer}: cost {integrated.cost / trial.cost:.2f}"
        else:
            why = "not within the tolerance where it would be faster"
        chosen = trial if integrated is None or integrated.cost >= trial.cost else integrated
        quadrature_part = Part("preintegrated", chosen.march.quadrature == "preintegrated", why)
        return chosen, reference, [step_part._replace(kept=chosen is trial), quadrature_part]

    def render(self, step: float, quadrature: Quadrature) -> Trial:
        """Trial of a step, in voxels."""
        if (step, quadrature) not in self.rendered:
            march = March(step * self.voxel, self.transforms, quadrature)
            image = self.probe.render(self.scene, march)
            self.rendered[step, quadrature] = Trial(step, march, image, self.probe.mean(image.samples))
        return self.rendered[step, quadrature]

    def _longest(self, quadrature: Quadrature, *, last: bool) -> tuple[Trial, Reference]:
        """The longest step within the goal, compared with at most half of it and including the reference's
        error. If there is none, the finest step, with an error just above `tolerance`, or more. `last`: no
        other quadrature remains, so that the search does not stop early."""
        steps, finest = [COARSEST, COARSEST / 2, COARSEST / 4], FINEST if last else FINE
        while True:
            reference = Reference.of(self.probe, [self.render(step, quadrature).image for step in steps])
            tried = [self._trial(step, quadrature, reference) for step in steps[-3:-1]]
            trial = next((trial for trial in tried if trial.error <= self.goal), tried[-1])
            if trial.error <= self.goal:
                longer = self._trial(2 * trial.step, quadrature, reference)
                return self._between(trial, longer, reference), reference
            expected = reference.image_error * reference.ratio ** math.log2(steps[-1] / finest)
            hopeless = expected > self.goal and not last
            if steps[-1] <= finest or hopeless or not math.isfinite(trial.error):
                break
            steps.append(steps[-1] / 2)
        if not math.isfinite(trial.error):
            return trial, reference
        unknown = max(reference.image_error, math.nextafter(self.tolerance, math.inf))
        return self._trial(steps[-1], quadrature, reference)._replace(error=unknown), reference

    def _midpoint(self, integrated: Trial, reference: Reference) -> Trial:
        """The longest step within the goal by the midpoint rule, if it takes no longer; else `integrated`.
        The reference by integrated cells is more accurate than that by the midpoint rule."""
        steps = sorted(step for step, quadrature in self.rendered if quadrature == "midpoint")
        tried = [self._trial(step, "midpoint", reference) for step in steps]
        if all(trial.error > self.goal for trial in tried):
            as_fast = integrated.step / SAMPLE["preintegrated"]
            tried.append(self._trial(as_fast, "midpoint", reference))
            tried.sort(key=lambda trial: trial.step)
        within = [k for k, trial in enumerate(tried) if trial.error <= self.goal]
        if not within:
            return integrated
        return self._between(tried[within[-1]], tried[min(within[-1] + 1, len(tried) - 1)], reference)

    def _between(self, short: Trial, long: Trial, reference: Reference) -> Trial:
        """The longest step within the goal, from `short`, which is within it, to `long`."""
        if long.error <= self.goal:
            return long
        for _ in range(REFINED):
            step = math.sqrt(short.step * long.step)
            if 0 < short.error < long.error < math.inf:  # the error is a power of the step; keep off the ends
                power = math.log(long.error / short.error) / math.log(long.step / short.step)
                estimate = short.step * (AIM * self.goal / short.error) ** (1 / power)
                step = min(max(estimate, math.sqrt(short.step * step)), math.sqrt(step * long.step))
            trial = self._trial(step, short.march.quadrature, reference)
            short, long = (trial, long) if trial.error <= self.goal else (short, trial)
        return short

    def _trial(self, step: float, quadrature: Quadrature, reference: Reference) -> Trial:
        trial = self.render(step, quadrature)
        return trial._replace(error=reference.error(trial.image))

    def _integrated(self, step: float, reference: Reference) -> Trial | None:
        """Pre-integration with the longest step within the goal that may be faster than the midpoint rule
        with `step`, in voxels."""
        longest, longer = None, step * SAMPLE["preintegrated"]
        while longer <= 2 * COARSEST:
            trial = self._trial(longer, "preintegrated", reference)
            if trial.error > self.goal:
                break
            longest, longer = trial, longer * 1.5
        return longest


def integrable(scene: Scene) -> bool:
    """Tests whether a scene's cells can be integrated between their ends."""
    leaves, structure = jax.tree.flatten(scene.transfer)
    return isinstance(scene.compositing, Over) and _integrates(structure, *map(jax.typeof, leaves))


@cache
def _integrates(structure: Any, *types: Any) -> bool:
    # by shapes: compiling its tables operation by operation would take seconds
    known: list[bool] = []
    jax.eval_shape(
        lambda transfer: known.append(transfer.integrator() is not None), jax.tree.unflatten(structure, types)
    )
    return known[0]


def _name(trial: Trial) -> str:
    return f"step {float(trial.march.step):.4g}"
