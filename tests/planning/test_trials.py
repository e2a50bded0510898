"""Is the longest step within a goal found, and what is cheaper taken, where the error of each image is known?

No ray is marched: errors and numbers of samples are formulas of the march.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies

import jaxvol as jv
from jaxvol.compositing.blending import Over
from jaxvol.compositing.projections import Average
from jaxvol.planning import choices, trials
from jaxvol.planning.choices import Part, brightest_of, cheapest_march, simplest_light
from jaxvol.planning.lightings import Simpler
from jaxvol.planning.probe import Probe, Setting
from jaxvol.planning.trials import Trial, Trials
from jaxvol.scene.rendering import Details

from ..scenes import scaled_phantom, soft_transfer


VOLUME = scaled_phantom("sphere")
Formula = Callable[[float], float]


class Light(jv.lighting.Phong):
    """Wrong by `error`, and by `grain` times the squared step; with simpler ones, which have a gradient if
    they are wrong by less than a half."""

    error: float
    grain: float
    others: tuple["Light", ...]

    def __init__(self, error: float, *others: "Light", grain: float = 0.0):
        super().__init__()
        self.error, self.others, self.grain = error, others, grain

    def smooth(self) -> "Light":
        return Light(0.0, grain=self.grain)

    def simpler(self) -> list[Simpler]:
        return [Simpler(each, f"wrong by {each.error}", each.error < 0.5) for each in self.others]


class Known(Probe):
    """A probe of one pixel, whose difference from the truth is a formula: of the step in voxels by the
    midpoint rule, of that by integration, and of the tolerance of adaptive sampling. `samples`: of steps of a
    voxel."""

    midpoint: Formula
    integrated: Formula
    adaptive: Formula
    samples: float
    exhausted: bool

    def __new__(
        cls,
        midpoint: Formula,
        integrated: Formula = lambda step: 1.0,
        adaptive: Formula = lambda tolerance: 1.0,
        samples: float = 100.0,
        exhausted: bool = False,
    ) -> "Known":
        rays: Any = None
        self = super().__new__(cls, rays, np.ones(1), np.ones(1, bool), np.ones((1, 1)), 1)
        self.midpoint, self.integrated, self.adaptive = midpoint, integrated, adaptive
        self.samples, self.exhausted = samples, exhausted
        return self

    def render(self, setting: Setting, march: jv.March) -> jv.Rendering:
        step = float(march.step)
        samples = self.samples / step
        strides = [each for each in march.transforms if isinstance(each, jv.AdaptiveSampling)]
        if strides:
            wrong, samples = self.adaptive(float(strides[0].tolerance)), samples / 8
        else:
            wrong = self.integrated(step) if march.quadrature == "preintegrated" else self.midpoint(step)
        if isinstance(setting.lighting, Light):
            wrong += setting.lighting.error + setting.lighting.grain * step**2
        rgba = jnp.asarray(np.asarray([3 * [0.5 + wrong] + [1.0]], np.float32))
        counted = jnp.asarray([math.ceil(samples)], jnp.int32)
        return jv.Rendering(rgba, jnp.asarray([self.exhausted]), Details(samples=counted))


def trials_of(known: Known, goal: float, *, transfer: Any = None, mode: Any = None, lighting=None) -> Trials:
    setting = Setting(VOLUME, transfer or soft_transfer(), mode or Over(), lighting)
    return Trials(known, setting, goal, 2 * goal, 1.0, (jv.SpaceLeaping(),))


def square(factor: float) -> Callable[[float], float]:
    return lambda step: factor * step**2


@settings(max_examples=25)
@given(strategies.floats(-6, 4), strategies.floats(1, 2.5))
def test_the_longest_step_within_the_goal_is_found(exponent, power):
    """To within 15 %, on the safe side."""
    factor, goal = 10**exponent, 1e-2
    found, truth = trials_of(Known(lambda step: factor * step**power), goal, mode=Average()).uniform()
    longest = (goal / factor) ** (1 / power)
    step = float(found.march.step)
    if math.isfinite(found.error) and found.error <= goal:
        assert factor * step**power <= found.error * (1 + 1e-4) + 1e-6
        assert step == 2 if longest > 2.4 else step >= 0.8 * longest
        assert truth.own <= goal
    else:
        assert longest < 4 * trials.FINEST


def marched(known: Known, *, goal: float = 1e-2, lit=False, once=False, **scene: Any):
    parts: list[Part] = []
    chosen, _ = cheapest_march(trials_of(known, goal, **scene), parts, lit=lit, once=once)
    return chosen, parts


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
    "integration is no better": (Known(square(0.04)), {}, "midpoint", trials.SLOWER),
    "strides are faster": (
        Known(square(0.04), adaptive=lambda tolerance: 0.4 * tolerance),
        {},
        "adaptive",
        "samples a pixel for",
    ),
    "strides are better than they promise": (
        Known(square(0.04), adaptive=lambda tolerance: 1e-3 * tolerance),
        {},
        "adaptive",
        "samples a pixel for",
    ),
    "strides are worse than they promise": (
        Known(square(0.04), adaptive=lambda tolerance: 3 * tolerance),
        {},
        "adaptive",
        "samples a pixel for",
    ),
    "strides under light": (
        Known(square(0.04), adaptive=lambda tolerance: 0.4 * tolerance),
        {"lit": True},
        "midpoint",
        "it does not know light",
    ),
    "another mode": (Known(*FAST), {"mode": Average()}, "midpoint", "these cells cannot be integrated"),
    "a peak between samples": (
        Known(peak, square(1e-3)),
        {},
        "preintegrated",
        "the midpoint rule would be slower",
    ),
    "a peak between samples, of no integral": (
        Known(peak),
        {"mode": Average()},
        "midpoint",
        "not proven to be within the tolerance",
    ),
    "nothing is within": (Known(peak, peak), {"goal": 1e-5}, "", "not proven to be within the tolerance"),
    "no finite image": (Known(lambda step: math.nan), {}, "midpoint", "not finite"),
    "samples used up": (Known(square(1e-4), exhausted=True), {}, "midpoint", "use up their samples"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_cheapest_within_the_goal_is_taken(case):
    known, how, kind, said = CASES[case]
    chosen, parts = marched(known, **how)
    assert not kind or chosen.kind == kind
    assert any(said in part.why for part in parts), parts
    assert sum(part.kept for part in parts) >= 1


def lit(known: Known, light: Light, *, goal: float = 1e-2, gradients: bool = False):
    """What is chosen for a march of steps of a voxel, and what is said."""
    found = trials_of(known, goal, lighting=light)
    march = found.march(1.0)
    parts = [Part("step 1", True, "of a voxel")]
    chosen = Trial(march, 1e-3, 100.0, "midpoint")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choices, "smooth", Light.smooth)
        patch.setattr(choices, "simpler", Light.simpler)
        return simplest_light(found, chosen, light, goal, parts, gradients=gradients), parts


def test_the_first_light_within_the_goal_is_taken():
    known = Known(lambda step: 0.0)
    for errors, gradients, used in (
        ((4e-3, 2e-3), False, 4e-3),  # the first of them is the cheapest
        ((4e-2, 2e-3), False, 2e-3),
        ((4e-2, 3e-2), False, 1e-3),  # none of them: as given
        ((0.6, 4e-3), True, 4e-3),  # the first has no gradient
    ):
        light = Light(1e-3, *map(Light, errors))
        (_, chosen, error, _, _), parts = lit(known, light, gradients=gradients)
        assert isinstance(chosen, Light)
        assert chosen.error == used == pytest.approx(error, rel=1e-3)
        assert [part.name for part in parts if part.kept] == ["step 1", f"light: {_name(used, light)}"]
    assert not any("0.6" in part.name for part in parts)


def _name(error: float, light: Light) -> str:
    return "as given" if error == light.error else f"wrong by {error}"


def test_the_least_error_is_taken_where_no_light_is_within_the_goal():
    (_, chosen, error, _, _), parts = lit(Known(lambda step: 0.0), Light(math.nan, Light(math.nan)))
    assert isinstance(chosen, Light)
    assert chosen.error == error == 0
    assert {part.name: part.kept for part in parts}["light: as given, without its noise"]


def test_steps_are_halved_where_light_changes_along_rays():
    known = Known(lambda step: 0.0)
    (marched, _, _, _, _), parts = lit(known, Light(0.0, grain=0.03))
    assert float(marched.march.step) == 0.5
    # what steps of a half change by is a quarter of what those of one do
    assert marched.error == pytest.approx(0.03 / 4, rel=0.05)
    assert [part.name for part in parts if part.kept][-1] == "step 0.5"
    assert not {part.name: part.kept for part in parts}["step 1"]


def test_brightness_counts_where_anything_is_seen():
    rgba = jnp.asarray(np.asarray([[0.1, 0.1, 0.1, 1.0], [0.4, 0, 0, 0.2], [9, 9, 9, 1e-4]], np.float32))
    assert brightest_of(jv.Rendering(rgba, jnp.zeros(3, bool))) == pytest.approx(2)
