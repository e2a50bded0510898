"""Which step and which quadrature are the cheapest within a tolerance?"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import equinox as eqx

from ..compositing.blending import Over
from ..march.march import March, Quadrature, Transform
from ..ray import Scene
from ..scene.rendering import Rendering
from .probe import Probe, Truth


SAMPLE = {"midpoint": 1.0, "preintegrated": 2.5}
"""Cost of a sample, as a multiple of one by the midpoint rule."""

RAY = 22.0
"""Cost of a pixel without its samples, in samples by the midpoint rule. Fitted, like `SAMPLE`, to the times
of `experiments.accuracy` (two CPU cores), whose ratios they predict within 9 % in the mean, 28 % at most."""

COARSEST, FINE, FINEST = 2.0, 1 / 16, 1 / 128
"""Voxels of the longest step that is tried, and of the shortest: by the midpoint rule where cells can be
integrated, too; and otherwise."""

BISECTIONS = 3
"""How often a step is sought between one that is within the goal and its double, which is not: to 9 %."""

WORTHWHILE, FAIR = 16, 0.5
"""Samples of a pixel, by the midpoint rule, below which cells that are integrated save no more than 16 %,
even if they are four times as long; they may be longer where steps are shorter than FAIR voxels."""


class Part(NamedTuple):
    """What a plan keeps or leaves out, and why."""

    name: str
    kept: bool
    why: str


class Trial(NamedTuple):
    """A march, the error of its image, and samples per pixel."""

    march: March
    error: float
    samples: float

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
    images: dict[tuple[float, Quadrature], Rendering] = field(default_factory=dict)
    """What has been rendered, by step in voxels and quadrature."""

    def cheapest(self, *, once: bool) -> tuple[Trial, Truth, list[Part]]:
        """The cheapest march within the goal, what images were compared with, and what was tried. `once`: as
        for `plan`."""
        found, truth = self._longest("midpoint", FINE if self._integrable else FINEST)
        if found.error > self.goal and self._integrable and math.isfinite(found.error):
            found, truth = self._longest("preintegrated", FINEST)
            # the truth may be known better now: good enough for cheaper steps by the midpoint rule
            steps = [step for step, quadrature in self.images if quadrature == "midpoint"]
            trials = (found, *(self._trial(step, "midpoint", truth) for step in steps))
            within = [trial for trial in trials if trial.error <= self.goal]
            found = min(within, key=lambda trial: trial.cost, default=found)
        step = float(found.march.step) / self.voxel
        if not math.isfinite(found.error):
            why = "the image is not finite, or rays use up their samples"
        elif found.error > self.goal:
            why = f"{step:.2g} voxels, the shortest tried: not proven to be within the tolerance"
        else:
            why = f"{step:.3g} voxels, {found.march.quadrature}: RMSE {found.error:.2g}"
        step_part = Part(_name(found), True, why)
        if found.error > self.goal:
            return found, truth, [step_part]
        other = None
        if found.march.quadrature == "preintegrated":
            why = "the midpoint rule would be slower within the tolerance"
        elif found.samples <= WORTHWHILE and step >= FAIR:
            why = f"{found.samples:.1f} samples a pixel: too few to save any"
        elif once:
            why = "not tried for one image: a program of its own takes longer to compile than it saves"
        elif not self._integrable:
            why = "these cells cannot be integrated"
        elif other := self._integrated(step, truth):
            fewer = f"{other.samples:.1f} samples a pixel for {found.samples:.1f}"
            why = f"{_name(other)}, {fewer}: cost {other.cost / found.cost:.2f}"
        else:
            why = "not within the tolerance where it would be faster"
        chosen = found if other is None or other.cost >= found.cost else other
        integrated = Part("preintegrated", chosen.march.quadrature == "preintegrated", why)
        return chosen, truth, [step_part._replace(kept=chosen is found), integrated]

    def image(self, step: float, quadrature: Quadrature) -> Rendering:
        """Of steps of this length, in voxels."""
        if (step, quadrature) not in self.images:
            march = March(step * self.voxel, self.transforms, quadrature)
            self.images[step, quadrature] = self.probe.render(self.scene, march)
        return self.images[step, quadrature]

    @cached_property
    def _integrable(self) -> bool:
        """Whether cells can be integrated between their ends."""
        # as shapes: its tables take seconds to compile, operation by operation
        known: list[bool] = []
        eqx.filter_eval_shape(
            lambda transfer: known.append(transfer.integrator() is not None), self.scene.transfer
        )
        return known[0] and isinstance(self.scene.compositing, Over)

    def _longest(self, quadrature: Quadrature, finest: float) -> tuple[Trial, Truth]:
        """The longest steps within the goal, compared with steps of half of them or less, and with what these
        still err by. If there are none, the finest, whose error is not known: just `beyond`, or more."""
        steps = [COARSEST, COARSEST / 2, COARSEST / 4]
        while True:
            truth = Truth.of(self.probe, [self.image(step, quadrature) for step in steps])
            tried = [(self._trial(step, quadrature, truth), step) for step in steps[-3:-1]]
            found, step = next((each for each in tried if each[0].error <= self.goal), tried[-1])
            if found.error <= self.goal or steps[-1] <= finest or not math.isfinite(found.error):
                break
            steps.append(steps[-1] / 2)
        if found.error > self.goal and math.isfinite(found.error):
            unknown = max(truth.own, math.nextafter(self.beyond, math.inf))
            return self._trial(steps[-1], quadrature, truth)._replace(error=unknown), truth
        if math.isfinite(found.error) and step < COARSEST:
            too_long = 2 * step
            for _ in range(BISECTIONS):
                middle = math.sqrt(step * too_long)
                trial = self._trial(middle, quadrature, truth)
                if trial.error <= self.goal:
                    step, found = middle, trial
                else:
                    too_long = middle
        return found, truth

    def _trial(self, step: float, quadrature: Quadrature, truth: Truth) -> Trial:
        image = self.image(step, quadrature)
        march = March(step * self.voxel, self.transforms, quadrature)
        return Trial(march, truth.error(image), self.probe.mean(image.samples))

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


def _name(trial: Trial) -> str:
    return f"step {float(trial.march.step):.4g}"
