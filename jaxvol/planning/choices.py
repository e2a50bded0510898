"""Which parts of a march, and which lighting, does an image need? What is kept or left out, and why."""

import math
import time
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool

from ..lighting.shading import Lighting
from ..march.march import March, Transform
from ..march.transforms import AlphaCorrection, SpaceLeaping
from ..scene.rendering import Rendering
from ..scene.space import Space
from .lightings import simpler, smooth
from .probe import Probe, Setting, Truth
from .trials import RAY, Trial, Trials


LIT = 1 / 2
"""Part of what is left that is for light, where there is any."""

EMPTY = 0.05
"""Part of the blocks in which nothing is visible, below which leaps are not worth their look-ups."""

WORTHWHILE = 16
"""Samples of a pixel, by the midpoint rule, below which cells that are integrated save no more than 16 %,
even if they are four times as long; they may be longer where steps are shorter than FAIR voxels."""

FAIR = 0.5

TOGETHER = 0.4
"""What a sample takes in an image, of what it takes in patches, which lie apart and so share no cached
voxels: the median of 21 images of `experiments.planning`, between 0.18 and 0.72."""

HALVED = 3
"""How often the step is halved at most because light changes along a ray."""

UNPROVEN = "not proven by a copy; kept"


class Part(NamedTuple):
    """A part of a plan: what it is, whether it was kept or left out, and why."""

    name: str
    kept: bool
    why: str


def brightest_of(image: Rendering) -> float:
    """The brightest colour, 1 or more: by so much of what is left of a ray its early end may err."""
    rgba = np.asarray(image.rgba, np.float64)
    seen = rgba[:, 3] > 1e-3
    return float(max(1.0, np.max(rgba[seen, :3] / rgba[seen, 3:], initial=0.0)))


def has_variants(lighting: Lighting) -> bool:
    """Whether there is a choice of lightings that look nearly the same."""
    return bool(simpler(lighting)) or smooth(lighting) is not lighting


def proven_transforms(
    visible: Bool[Array, "bx by bz"], space: Space, given: tuple[Transform, ...], *, copy: bool = False
) -> tuple[tuple[Transform, ...], list[Part]]:
    """Transforms that proofs decide on, from the blocks that may hold anything visible. `copy`: these are of
    a copy, which does not prove that there is nothing in between."""
    found: list[Transform] = []
    parts = []
    at_faces = space.visible_at_faces(visible)
    faces = sum(map(bool, at_faces))
    if any(isinstance(each, AlphaCorrection) for each in given):
        parts.append(Part("AlphaCorrection", True, "part of the scene"))
    elif faces or copy:
        cut = "" if len(at_faces) == 6 else " and cuts"
        why = f"something may be visible at {faces} of the volume's {len(at_faces)} faces{cut}"
        parts.append(Part("AlphaCorrection", True, why if faces else UNPROVEN))
        found.append(AlphaCorrection())
    else:
        parts.append(Part("AlphaCorrection", False, "nothing is visible at the volume's faces: proven"))
    empty = float(np.mean(~np.asarray(visible)))
    leaps = empty >= EMPTY
    why = f"{empty:.1%} of the blocks hold nothing visible"
    parts.append(Part("SpaceLeaping", leaps or copy, why if leaps or not copy else UNPROVEN))
    return (*found, *((SpaceLeaping(),) if leaps or copy else ())), parts


def cheapest_march(trials: Trials, parts: list[Part], *, lit: bool, once: bool) -> tuple[Trial, Truth]:
    """The cheapest march within the goal. `lit`: whether it is for an image with light, along which
    adaptive sampling cannot know how samples change. `once`: as for `plan`."""
    uniform, truth = trials.uniform()
    step, samples = float(uniform.march.step) / trials.voxel, uniform.samples
    name = f"step {float(uniform.march.step):.4g}"
    if not math.isfinite(uniform.error):
        parts.append(Part(name, True, "the image is not finite, or rays use up their samples"))
        return uniform, truth
    if uniform.error > trials.goal:
        why = f"{step:.2g} voxels, the shortest tried: not proven to be within the tolerance"
        parts.append(Part(name, True, why))
        return uniform, truth
    parts.append(Part(name, True, f"{step:.3g} voxels, {uniform.kind}: RMSE {uniform.error:.2g}"))
    if uniform.kind == "preintegrated":
        parts.append(Part("preintegrated", True, "the midpoint rule would be slower within the tolerance"))
        return uniform, truth
    few = samples <= WORTHWHILE and step >= FAIR
    if few or once:
        why = "not tried for one image: a program of its own takes longer to compile than it saves"
        if few:
            why = f"{samples:.1f} samples a pixel: too few to save any"
        parts.append(Part("preintegrated, AdaptiveSampling", False, why))
        return uniform, truth
    others = {
        "preintegrated": trials.integrated(step, truth),
        "AdaptiveSampling": "it does not know light" if lit else trials.adaptive(step, truth),
    }
    found = [uniform, *(other for other in others.values() if isinstance(other, Trial))]
    best = min(found, key=lambda each: each.cost)
    for name, other in others.items():
        why = other
        if isinstance(other, Trial):
            fewer = f"{other.samples:.1f} samples a pixel for {samples:.1f}"
            why = f"step {float(other.march.step):.4g}, {fewer}: cost {other.cost / uniform.cost:.2f}"
        assert isinstance(why, str)
        parts.append(Part(name, other is best, why))
    return best, truth


def simplest_light(
    trials: Trials, chosen: Trial, lighting: Lighting, goal: float, parts: list[Part], *, gradients: bool
) -> tuple[Trial, Lighting, float, float, float]:
    """The march, the cheapest lighting within what is left of the goal, its error, the seconds that it adds
    to an image, and the brightest colour."""
    probe, setting = trials.probe, trials.setting

    def rendered(march: March, lighting: Lighting) -> Rendering:
        return probe.render(setting._replace(lighting=lighting), march)

    without_noise = smooth(lighting)
    truth = rendered(chosen.march, without_noise)
    tried = [(each.lighting, each.what) for each in simpler(lighting) if each.has_gradient or not gradients]
    left, found = goal - chosen.error, []
    for other, what in (*tried, (lighting, "as given"), (without_noise, "as given, without its noise")):
        error = probe.distance(rendered(chosen.march, other), truth)
        found.append((error if math.isfinite(error) else math.inf, other, what))
        if error <= left:
            break
    error, lit, used = min(found, key=lambda each: each[0])
    if error <= left:
        error, lit, used = found[-1]
    for each, _, what in found:
        why = f"RMSE {each:.2g}"
        if what == used and error > left:
            why += ", the least of these: not within the tolerance"
        parts.append(Part(f"light: {what}", what == used, why))
    # how light changes along a ray is not known before: shorter steps must not change the image
    march, change = chosen.march, math.inf
    allowed = goal - error if error <= left else goal * (1 - LIT)
    image = rendered(march, lit)
    for _ in range(HALVED):
        half = March(march.step / 2, march.transforms, march.quadrature)
        finer = rendered(half, lit)
        change = 4 / 3 * probe.distance(image, finer)
        if change <= allowed:
            break
        longer = f"step {float(march.step):.4g}"
        parts[:] = [part._replace(kept=part.kept and part.name != longer) for part in parts]
        why = f"halved: with light, twice as long steps change the image by {change:.2g}"
        parts.append(Part(f"step {float(half.step):.4g}", True, why))
        image, march, change = finer, half, change / 3
    samples = probe.mean(image.samples)
    marched = Trial(march, max(chosen.error, change), samples, chosen.kind)
    unlit, with_light = (_fastest(probe, setting._replace(lighting=each), march) for each in (None, lit))
    pixels = probe.pixels * probe.share / probe.inside.size
    return marched, lit, error, max(with_light - unlit, 0.0) * pixels, brightest_of(image)


def _fastest(probe: Probe, setting: Setting, march: March) -> float:
    """Seconds to render the patches, once compiled."""

    def once() -> float:
        begun = time.perf_counter()
        jax.block_until_ready(probe.render(setting, march).rgba)
        return time.perf_counter() - begun

    once()
    return min(once() for _ in range(2))


def seconds_of(trials: Trials, chosen: Trial) -> float:
    """Time of an image on this machine, to within a factor of some 2. What a sample costs is taken from two
    steps, so that calls, which take as long for a few pixels as for an image, do not count. The program of
    their images was compiled for another one before."""
    times, samples = [], []
    for step in trials.steps("midpoint"):
        times.append(trials.seconds["midpoint", step])
        samples.append(float(np.asarray(trials.image(step, "midpoint").samples, np.float64).sum()))
    pixels = trials.probe.pixels
    if samples[0] <= 1.1 * samples[1]:  # nothing is seen
        return times[1] * pixels * trials.probe.share / trials.probe.inside.size
    a_sample = max(times[0] - times[1], 0.0) / (samples[0] - samples[1])
    return TOGETHER * a_sample * (chosen.cost - RAY * (1 - trials.probe.share)) * pixels
