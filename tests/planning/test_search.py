"""Is the longest step within a goal found, and what is cheaper taken, where the error of each image is known?

No ray is marched: errors and numbers of samples are formulas of the march.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies

import jaxvol as jv
from jaxvol.compositing.blending import Over
from jaxvol.compositing.projections import Average
from jaxvol.planning import search
from jaxvol.planning.plan import brightest_of
from jaxvol.planning.probe import Probe
from jaxvol.planning.search import Search
from jaxvol.ray import Scene
from jaxvol.scene.rendering import Details

from ..scenes import scaled_phantom, soft_transfer


VOLUME = scaled_phantom("sphere")
Formula = Callable[[float], float]


class Known(Probe):
    """A probe of one pixel, whose difference from the truth is a formula: of the step in voxels by the
    midpoint rule, and of that by integration. `samples`: of steps of a voxel."""

    midpoint: Formula
    integrated: Formula
    samples: float
    exhausted: bool

    def __new__(
        cls,
        midpoint: Formula,
        integrated: Formula = lambda step: 1.0,
        samples: float = 100.0,
        exhausted: bool = False,
    ) -> "Known":
        rays: Any = None
        self = super().__new__(cls, rays, np.ones(1), np.ones(1, bool), np.ones((1, 1)), 1)
        self.midpoint, self.integrated = midpoint, integrated
        self.samples, self.exhausted = samples, exhausted
        return self

    def render(self, scene: Scene, march: jv.March) -> jv.Rendering:
        step = float(march.step)
        samples = self.samples / step
        wrong = (self.integrated if march.quadrature == "preintegrated" else self.midpoint)(step)
        rgba = np.asarray([3 * [0.5 + wrong] + [1.0]], np.float32)
        counted = np.asarray([math.ceil(samples)], np.int32)
        exhausted = np.asarray([self.exhausted])
        rgba, exhausted, counted = jax.device_put((rgba, exhausted, counted))
        return jv.Rendering(rgba, exhausted, Details(samples=counted))


def search_of(known: Known, goal: float, mode: Any = None) -> Search:
    scene = Scene(VOLUME, soft_transfer(), None, jv.March(1.0), mode or Over())
    return Search(known, scene, goal, 2 * goal, 1.0, (jv.SpaceLeaping(),))


def square(factor: float) -> Callable[[float], float]:
    return lambda step: factor * step**2


@settings(max_examples=25)
@given(strategies.floats(-6, 4), strategies.floats(1, 2.5))
def test_the_longest_step_within_the_goal_is_found(exponent, power):
    """On the safe side."""
    factor, goal = 10**exponent, 1e-2
    known = Known(lambda step: factor * step**power)
    found, truth, _ = search_of(known, goal, Average()).cheapest(once=False)
    longest = (goal / factor) ** (1 / power)
    step = float(found.march.step)
    if math.isfinite(found.error) and found.error <= goal:
        assert factor * step**power <= found.error * (1 + 1e-4) + 1e-6
        assert step == 4 if longest > 4.4 else step >= 0.85 * min(longest, 4)
        assert truth.image_error <= goal
    else:
        assert longest < 4 * search.FINEST


FAST = square(0.04), square(0.0004)
"""The midpoint rule is within 0.01 at half a voxel, integration at five."""


def peak(step: float) -> float:
    """What steps of more than a two hundredth of a voxel pass over."""
    return 0.0 if step < 1 / 200 else 0.3 + 0.1 * math.sin(37 * step)


# what is known; of which kind the cheapest march is; what is said of it, or of another one
CASES: dict[str, tuple[Known, dict, str, str]] = {
    "few samples": (Known(square(1e-4), samples=20), {}, "midpoint", "too few to save any"),
    "integration is faster": (Known(*FAST), {}, "preintegrated", "samples a pixel for"),
    "one image only": (Known(*FAST), {"once": True}, "midpoint", "not tried for one image"),
    "more than eight steps of a voxel, for one image": (
        Known(square(1.3), square(1e-9), samples=20.0),
        {"once": True},  # a program is compiled in less time than such steps take
        "preintegrated",
        "the midpoint rule would be slower",
    ),
    "integration is no better": (Known(square(0.04)), {}, "midpoint", "not within the tolerance where"),
    "another mode": (Known(*FAST), {"mode": Average()}, "midpoint", "these cells cannot be integrated"),
    "a peak between samples": (
        Known(peak, square(1e-3)),
        {},
        "preintegrated",
        "the midpoint rule would be slower",
    ),
    "a peak between all samples": (
        Known(lambda step: 0.3, square(1e-3)),
        {"between": True},
        "preintegrated",
        "the midpoint rule would be slower",
    ),
    "nothing is within": (Known(peak, peak), {"goal": 1e-5}, "", "not proven to be within the tolerance"),
    "no finite image": (Known(lambda step: math.nan), {}, "midpoint", "not finite"),
    "samples used up": (Known(square(1e-4), exhausted=True), {}, "midpoint", "use up their samples"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_cheapest_within_the_goal_is_taken(case):
    known, how, kind, said = CASES[case]
    options = {"once": False} | how
    search = search_of(known, options.pop("goal", 1e-2), options.pop("mode", None))
    chosen, _, parts = search.cheapest(**options)
    assert not kind or chosen.march.quadrature == kind
    assert any(said in part.why for part in parts), parts
    assert sum(part.kept for part in parts) >= 1


def test_brightness_counts_where_anything_is_seen():
    rgba = np.asarray([[0.1, 0.1, 0.1, 1.0], [0.4, 0, 0, 0.2], [9, 9, 9, 1e-4]], np.float32)
    assert brightest_of(jv.Rendering(*jax.device_put((rgba, np.zeros(3, bool))))) == pytest.approx(2)
