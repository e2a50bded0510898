"""Which step and which quadrature are the cheapest within a tolerance?"""

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import jax

from ..compositing.blending import Over
from ..march.march import March, Quadrature, Transform
from ..ray import Scene
from ..scene.rendering import Rendering
from ..scene.transfer import Transfer
from .probe import Probe, Truth


SAMPLE = {"midpoint": 1.0, "preintegrated": 2.5}
"""Cost of a sample, as a multiple of one by the midpoint rule."""

RAY = 22.0
"""Cost of a pixel without its samples, in samples by the midpoint rule. Fitted, like `SAMPLE`, to the times
of `experiments.accuracy` (two CPU cores), whose ratios they predict within 9 % in the mean, 28 % at most."""

COARSEST, FINE, FINEST = 2.0, 1 / 16, 1 / 128
"""Voxels of the step that is tried first, and of the shortest: by the midpoint rule where cells can be
integrated, too; and otherwise."""

REFINED, AIM = 2, 0.97
"""How often a step is sought between one that is within the goal and one that is not, and for which part of
the goal."""

WORTHWHILE, FAIR = 16, 0.5
"""Samples of a pixel, by the midpoint rule, below which cells that are integrated save no more than 16 %,
even if they are four times as long; they may be longer where steps are shorter than FAIR voxels."""


class Part(NamedTuple):
    """What a plan keeps or leaves out, and why."""

    name: str
    kept: bool
    why: str


class Trial(NamedTuple):
    """A march and its image of the probe."""

    step: float
    """Voxels."""
    march: March
    image: Rendering
    samples: float
    """Per pixel."""
    error: float = math.inf

    @property
    def cost(self) -> float:
        """Per pixel, in samples by the midpoint rule."""
        return RAY + SAMPLE[self.march.quadrature] * self.samples


@dataclass
class Search:
    """Marches of one scene, tried on some of its pixels."""

    probe: Probe
    scene: Scene
    goal: float
    """The error that the marches may have."""
    beyond: float
    """That of the image, above which the plan fails."""
    voxel: float
    """World length that steps are counted in."""
    transforms: tuple[Transform, ...]
    rendered: dict[tuple[float, Quadrature], Trial] = field(default_factory=dict)
    """By step in voxels and quadrature."""

    @property
    def integrable(self) -> bool:
        """Whether cells can be integrated between their ends."""
        return isinstance(self.scene.compositing, Over) and integrates(self.scene.transfer)

    def cheapest(self, *, once: bool, between: bool = False) -> tuple[Trial, Truth, list[Part]]:
        """The cheapest march within the goal, what images were compared with, and what was tried. `once`: as
        for `plan`. `between`: what is visible may lie between samples, so that cells must be integrated."""
        integrable, between = self.integrable, between and self.integrable
        first: Quadrature = "preintegrated" if between else "midpoint"
        found, truth = self._longest(first, last=between or not integrable)
        if first == "midpoint" and found.error > self.goal and integrable and math.isfinite(found.error):
            found, truth = self._longest("preintegrated", last=True)
        if found.march.quadrature == "preintegrated" and found.error <= self.goal:
            found = min(found, self._midpoint(found, truth), key=lambda trial: trial.cost)
        if not math.isfinite(found.error):
            why = "the image is not finite, or rays use up their samples"
        elif found.error > self.goal:
            why = f"{found.step:.2g} voxels, the shortest tried: not proven to be within the tolerance"
        else:
            why = f"{found.step:.3g} voxels, {found.march.quadrature}: RMSE {found.error:.2g}"
        step_part = Part(_name(found), True, why)
        if found.error > self.goal:
            return found, truth, [step_part]
        other = None
        if found.march.quadrature == "preintegrated":
            why = "the midpoint rule would be slower within the tolerance"
        elif found.samples <= WORTHWHILE and found.step >= FAIR:
            why = f"{found.samples:.1f} samples a pixel: too few to save any"
        elif once:
            why = "not tried for one image: a program of its own takes longer to compile than it saves"
        elif not integrable:
            why = "these cells cannot be integrated"
        elif other := self._integrated(found.step, truth):
            fewer = f"{other.samples:.1f} samples a pixel for {found.samples:.1f}"
            why = f"{_name(other)}, {fewer}: cost {other.cost / found.cost:.2f}"
        else:
            why = "not within the tolerance where it would be faster"
        chosen = found if other is None or other.cost >= found.cost else other
        integrated = Part("preintegrated", chosen.march.quadrature == "preintegrated", why)
        return chosen, truth, [step_part._replace(kept=chosen is found), integrated]

    def render(self, step: float, quadrature: Quadrature) -> Trial:
        """Steps of this length, in voxels."""
        if (step, quadrature) not in self.rendered:
            march = March(step * self.voxel, self.transforms, quadrature)
            image = self.probe.render(self.scene, march)
            self.rendered[step, quadrature] = Trial(step, march, image, self.probe.mean(image.samples))
        return self.rendered[step, quadrature]

    def _longest(self, quadrature: Quadrature, *, last: bool) -> tuple[Trial, Truth]:
        """The longest steps within the goal, compared with steps of half of them or less, and with what these
        still err by. If there are none, the finest, whose error is not known: just `beyond`, or more. `last`:
        whether no other quadrature is left, so that no step is given up early."""
        steps, finest = [COARSEST, COARSEST / 2, COARSEST / 4], FINEST if last else FINE
        while True:
            truth = Truth.of(self.probe, [self.render(step, quadrature).image for step in steps])
            tried = [self._trial(step, quadrature, truth) for step in steps[-3:-1]]
            found = next((each for each in tried if each.error <= self.goal), tried[-1])
            if found.error <= self.goal:
                return self._between(found, self._trial(2 * found.step, quadrature, truth), truth), truth
            left = truth.own * truth.ratio ** math.log2(steps[-1] / finest)  # of the finest steps, likely
            hopeless = left > self.goal and not last
            if steps[-1] <= finest or hopeless or not math.isfinite(found.error):
                break
            steps.append(steps[-1] / 2)
        if not math.isfinite(found.error):
            return found, truth
        unknown = max(truth.own, math.nextafter(self.beyond, math.inf))
        return self._trial(steps[-1], quadrature, truth)._replace(error=unknown), truth

    def _midpoint(self, integrated: Trial, truth: Truth) -> Trial:
        """The longest steps within the goal by the midpoint rule, if some are that take no longer: the truth
        that integrated cells give is known better than its own."""
        steps = sorted(step for step, quadrature in self.rendered if quadrature == "midpoint")
        tried = [self._trial(step, "midpoint", truth) for step in steps]
        if all(each.error > self.goal for each in tried):
            as_fast = integrated.step / SAMPLE["preintegrated"]
            tried.append(self._trial(as_fast, "midpoint", truth))
            tried.sort(key=lambda trial: trial.step)
        within = [k for k, each in enumerate(tried) if each.error <= self.goal]
        if not within:
            return integrated
        return self._between(tried[within[-1]], tried[min(within[-1] + 1, len(tried) - 1)], truth)

    def _between(self, within: Trial, beyond: Trial, truth: Truth) -> Trial:
        """The longest steps within the goal that are found between two, of which the first is; the second, if
        that is, too."""
        if beyond.error <= self.goal:
            return beyond
        for _ in range(REFINED):
            step = math.sqrt(within.step * beyond.step)
            if 0 < within.error < beyond.error < math.inf:  # as a power of the step, not too near to either
                power = math.log(beyond.error / within.error) / math.log(beyond.step / within.step)
                sought = within.step * (AIM * self.goal / within.error) ** (1 / power)
                step = min(max(sought, math.sqrt(within.step * step)), math.sqrt(step * beyond.step))
            trial = self._trial(step, within.march.quadrature, truth)
            within, beyond = (trial, beyond) if trial.error <= self.goal else (within, trial)
        return within

    def _trial(self, step: float, quadrature: Quadrature, truth: Truth) -> Trial:
        trial = self.render(step, quadrature)
        return trial._replace(error=truth.error(trial.image))

    def _integrated(self, step: float, truth: Truth) -> Trial | None:
        """Pre-integration with the longest steps within the goal, if that may be faster than the midpoint
        rule with this `step`, in voxels."""
        found, longer = None, step * SAMPLE["preintegrated"]
        while longer <= 2 * COARSEST:
            trial = self._trial(longer, "preintegrated", truth)
            if trial.error > self.goal:
                break
            found, longer = trial, longer * 1.5
        return found


def integrates(transfer: Transfer) -> bool:
    """Whether a transfer function's cells can be integrated between their ends."""
    leaves, structure = jax.tree.flatten(transfer)
    return _integrates(structure, *map(jax.typeof, leaves))


@cache
def _integrates(structure: Any, *types: Any) -> bool:
    # as shapes: its tables take seconds to compile, operation by operation
    known: list[bool] = []
    jax.eval_shape(
        lambda transfer: known.append(transfer.integrator() is not None), jax.tree.unflatten(structure, types)
    )
    return known[0]


def _name(trial: Trial) -> str:
    return f"step {float(trial.march.step):.4g}"
