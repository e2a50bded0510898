"""Random walks of light, from the camera: flights, scatterings, next-event estimation. A walk flies either
along its path or towards a light; both flights query the volume alike, so that walks step side by side."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from .._util.noise import hashed_uniforms_4
from .._util.vec3 import Scalar, Vec3, dot, greatest, plus, scaled, select, times
from ..lighting.lights import Arriving, Light, located, sky_of
from ..lighting.phase import phase, sample_phase, scattered
from ..scene.space import Affine
from ..scene.transfer import Measured
from ..scene.volume import Volume
from ..xla.memory import in_memory
from .likelihood import Sampling, likelihood
from .medium import Medium
from .tracking import Candidate, Decision, Flight, fly


T = TypeVar("T")

ROULETTE = 0.25
"""Threshold of Russian roulette, for a walk's throughput and for the transmittance towards a light."""

DARK = 3e-4
"""Factor of the throughput below which a walk that is replayed keeps it apart (`Walk.dark`): about the square
root of float32's precision."""

Words: TypeAlias = tuple[UInt32[Array, "..."], UInt32[Array, "..."], UInt32[Array, "..."]]
"""Key of all random numbers along a path: pixel, path, seed."""


class WalkResult(NamedTuple):
    """Radiance of a path, opacity (0 or 1), number of scatterings, and `exhausted` if it was cut off.
    `after_dark`: the radiance since `Walk.dark` is not 1, without that factor; None where `Walk.dark` is."""

    radiance: Vec3
    opacity: Scalar
    scatterings: Int[Array, "..."]
    exhausted: Bool[Array, "..."]
    after_dark: Vec3 | None = None

    def plus(self, gathered: Vec3, dark: Vec3 | None) -> "WalkResult":
        """The result after gathering light."""
        if dark is None or self.after_dark is None:
            return self._replace(radiance=plus(self.radiance, gathered))
        r, g, b = (jnp.where(factor == 1, 0, c) for factor, c in zip(dark, gathered, strict=True))
        after_dark = plus(self.after_dark, (r, g, b))
        return self._replace(radiance=plus(self.radiance, times(gathered, dark)), after_dark=after_dark)


class Walk(NamedTuple):
    """The state of one path.

    Attributes:
        words: key of all random numbers along the path.
        steps: number of steps so far.
        flight: the current flight: towards a light if `to_light`, else along the path.
        to_light: True on the way to a light.
        direction: world direction of the path, unit; on the way to a light, the one after it.
        throughput: fraction of the light at the path's end that arrives at the camera; (r, g, b).
        dark: first factor of the throughput below DARK, which `throughput` and `unoccluded` then lack; else
            1. None: these have all factors.
        importance: importance for Russian roulette, a constant for derivatives; None: that of the throughput.
        unoccluded: radiance that the light adds without occlusion.
        transmittance: transmittance towards the light, so far.
        result: result of the path, so far.
        alive: True if the path continues.
    """

    words: Words
    steps: Int[Array, ""]
    flight: Flight
    to_light: Bool[Array, ""]
    direction: Vec3
    throughput: Vec3
    importance: Scalar | None
    unoccluded: Vec3
    transmittance: Scalar
    result: WalkResult
    alive: Bool[Array, ""]
    dark: Vec3 | None = None


class WalkScene(NamedTuple):
    """The scene that walks travel through."""

    volume: Volume
    medium: Medium
    lights: tuple[Light, ...]
    anisotropy: Scalar
    max_scatterings: Int[Array, ""]
    sampling: Sampling

    @property
    def space(self) -> Affine:
        return Affine(self.volume)

    def flight(self, start: Vec3, direction: Vec3, end: Scalar) -> Flight:
        """Flight from a grid coordinate in a world direction, at most to the depth `end`."""
        space = self.space
        return Flight.to(self.medium.majorants, start, space.frame.components(direction), space.spacing, end)

    def light(self, coordinate: Vec3, direction: Vec3, uniform: Scalar) -> Arriving:
        """Light at a grid coordinate from a random located light, weighted by their number."""
        x, y, z = self.space.point(coordinate)
        count = len(lights := located(self.lights))
        number = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        arriving = [light.at((x, y, z), direction) for light in lights]
        chosen = jax.tree.map(
            lambda *leaves: jnp.select([number == i for i in range(count)], leaves), *arriving
        )
        r, g, b = chosen.irradiance
        return chosen._replace(irradiance=(r * count, g * count, b * count))


class Scattering(NamedTuple):
    """State of a walk after a scattering: see `Walk`. `toward` and `end` are those of the next flight."""

    direction: Vec3
    throughput: Vec3
    importance: Scalar
    unoccluded: Vec3
    to_light: Bool[Array, "..."]
    toward: Vec3
    end: Scalar
    dark: Vec3 | None


class Proposal(NamedTuple):
    """Constants of a step: the advanced flight, its candidate, random numbers, and the turn of a scattering
    (its new direction in the frame of the old)."""

    flight: Flight
    candidate: Candidate
    turn: Vec3
    decide: Scalar
    choose: Scalar
    survive: Scalar


def step(scene: WalkScene, walks: Walk) -> Walk:
    """Advance many walks by a part of a flight. Expensive values are stored, or XLA recomputes them."""
    proposal = propose(scene, walks)
    measured = _stored(walks, scene.medium.measure, proposal.candidate.coordinate)
    return advance(scene, walks, proposal, measured)


def _stored(walks: Walk, f: Callable[..., Any], *arguments: Any) -> Any:
    return in_memory(jnp.any(walks.alive), jax.vmap(f), *arguments)


def propose(scene: WalkScene, walks: Walk) -> Proposal:
    """The part of a step that has no derivative."""

    def uniforms(walk: Walk, stage: int) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        pixel, path, seed = walk.words
        return hashed_uniforms_4(pixel, path, (2 * walk.steps + stage).astype(jnp.uint32), seed)

    stored = partial(_stored, walks)
    first, second = (stored(partial(uniforms, stage=stage), walks) for stage in (0, 1))
    (draw, decide, *_), (choose, first_turn, second_turn, survive) = first, second
    turn = stored(partial(sample_phase, jax.lax.stop_gradient(scene.anisotropy)), first_turn, second_turn)
    flight, candidate = stored(partial(fly, scene.medium.majorants), walks.flight, draw)
    return Proposal(flight, candidate, turn, decide, choose, survive)


def advance(scene: WalkScene, walks: Walk, proposal: Proposal, measured: Measured) -> Walk:
    """The walks after a step, from measurements at the candidates."""
    flight, candidate, turn, decide, choose, survive = proposal
    extinction, albedo = _stored(walks, scene.medium.classify, measured)
    decision = jax.vmap(partial(Decision.at, scene.medium.majorants))(candidate, extinction)
    inputs = walks, candidate.coordinate, albedo, decision.collided, turn, choose, survive
    scattering = _stored(walks, partial(_scatter, scene), *inputs)
    candidate = candidate._replace(hit=candidate.hit & walks.alive, ended=candidate.ended & walks.alive)
    walks = walks._replace(flight=flight, steps=walks.steps + 1)

    def one(walk: Walk, candidate: Candidate, decision: Decision, scattering: Scattering, u: Scalar) -> Walk:
        advanced = _delta_tracking(scene, walk, candidate, decision, scattering, u)
        if not located(scene.lights):
            return advanced
        return where_all(walk.to_light, _ratio_tracking(scene, walk, candidate, decision, u), advanced)

    return jax.vmap(one)(walks, candidate, decision, scattering, decide)


def _scatter(
    scene: WalkScene,
    walk: Walk,
    coordinate: Vec3,
    albedo: Vec3,
    collided: Scalar,
    turn: Vec3,
    choose: Scalar,
    survive: Scalar,
) -> Scattering:
    """Scatter a walk. `collided`: weight of the collision; `turn`: new direction in the frame of the old."""
    kept, dark = scaled(albedo, collided), walk.dark
    floor = scene.sampling.importance
    if walk.importance is None or floor is None:
        importance = greatest(times(walk.throughput, kept))
    else:
        importance = walk.importance * jnp.maximum(jax.lax.stop_gradient(greatest(kept)), floor)
    if dark is not None:
        kept, dark = _split_dark(kept, dark)
    before_roulette = times(walk.throughput, kept)
    weight, importance = _roulette(importance, survive)
    weight = weight * likelihood(phase(turn[2], scene.anisotropy))
    throughput = scaled(before_roulette, weight)
    direction = scattered(turn, walk.direction)
    endless = jnp.full_like(survive, jnp.inf)
    if not located(scene.lights):
        no = jnp.zeros(survive.shape, bool)
        return Scattering(direction, throughput, importance, walk.unoccluded, no, direction, endless, dark)
    light = scene.light(coordinate, walk.direction, choose)
    assert light.toward is not None
    density = phase(dot(walk.direction, light.toward), scene.anisotropy)
    unoccluded = scaled(times(before_roulette, light.irradiance), density)
    to_light = (greatest(unoccluded) > 0) | (walk.importance is not None)
    toward, end = select(to_light, light.toward, direction), jnp.where(to_light, light.distance, endless)
    return Scattering(direction, throughput, importance, unoccluded, to_light, toward, end, dark)


def _split_dark(kept: Vec3, dark: Vec3) -> tuple[Vec3, Vec3]:
    """The factors of a throughput at a scattering, without the first one below DARK; and `Walk.dark`."""
    pairs = list(zip(kept, dark, strict=True))
    first = [(factor < DARK) & (before == 1) for factor, before in pairs]
    r, g, b = (jnp.where(is_first, 1, factor) for is_first, factor in zip(first, kept, strict=True))
    dark_r, dark_g, dark_b = (jnp.where(is_first, *pair) for is_first, pair in zip(first, pairs, strict=True))
    return (r, g, b), (dark_r, dark_g, dark_b)


def _delta_tracking(
    scene: WalkScene,
    walk: Walk,
    candidate: Candidate,
    decision: Decision,
    scattering: Scattering,
    decide: Scalar,
) -> Walk:
    """Advance a walk along its path. A collision scatters it; at the end it gathers the constant light."""
    direction, throughput, importance, unoccluded, to_light, toward, end, dark = scattering
    before = walk.result
    collides = candidate.hit & (decide < decision.chance)
    capped = collides & (before.scatterings >= scene.max_scatterings)
    scatters, met = collides & ~capped, before.scatterings > 0
    gathered = times(walk.throughput, sky_of(scene.lights, jnp.float32))
    gathered = scaled(gathered, (candidate.ended & met).astype(decision.share.dtype))
    passed = jnp.where(candidate.hit & ~collides, decision.passed, 1)
    opacity = jnp.where(candidate.ended & ~met, 1 - walk.throughput[0], before.opacity)
    goes_on = to_light | (importance > 0)
    return walk._replace(
        flight=where_all(scatters, scene.flight(candidate.coordinate, toward, end), walk.flight),
        to_light=scatters & to_light,
        direction=select(scatters, direction, walk.direction),
        throughput=select(scatters, throughput, scaled(walk.throughput, passed)),
        importance=None if walk.importance is None else jnp.where(scatters, importance, walk.importance),
        unoccluded=select(scatters, unoccluded, walk.unoccluded),
        transmittance=jnp.ones_like(walk.transmittance),
        result=before.plus(gathered, walk.dark)._replace(
            opacity=jnp.where(scatters & ~met, 1, opacity),
            scatterings=before.scatterings + scatters.astype(jnp.int32),
            exhausted=before.exhausted | capped,
        ),
        dark=None if dark is None or walk.dark is None else select(scatters, dark, walk.dark),
        alive=walk.alive & ~candidate.ended & ~capped & (~scatters | goes_on),
    )


def _ratio_tracking(
    scene: WalkScene, walk: Walk, candidate: Candidate, decision: Decision, survive: Scalar
) -> Walk:
    """Advance a walk on its way to a light. At the end it continues from its last scattering."""
    transmittance = walk.transmittance * jnp.where(candidate.hit, jnp.maximum(1 - decision.share, 0), 1)
    survivor = jnp.where(survive * ROULETTE < transmittance, ROULETTE * likelihood(transmittance), 0)
    transmittance = jnp.where(candidate.hit & (transmittance < ROULETTE), survivor, transmittance)
    done = candidate.ended | (transmittance == 0)
    gathered = scaled(walk.unoccluded, jnp.where(candidate.ended, transmittance, 0))
    next_flight = scene.flight(walk.flight.start, walk.direction, jnp.full_like(walk.flight.end, jnp.inf))
    importance = greatest(walk.throughput) if walk.importance is None else walk.importance
    return walk._replace(
        flight=where_all(done, next_flight, walk.flight),
        to_light=~done,
        transmittance=transmittance,
        result=walk.result.plus(gathered, walk.dark),
        alive=walk.alive & (~done | (importance > 0)),
    )


def where_all(condition: Bool[Array, "..."], a: T, b: T) -> T:
    """`jnp.where` of each leaf."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _roulette(importance: Scalar, uniform: Scalar) -> tuple[Scalar, Scalar]:
    """Russian roulette: the weight, and the importance after it, both constants for derivatives."""
    importance = jax.lax.stop_gradient(importance)
    small = importance < ROULETTE
    survives = uniform * ROULETTE < importance
    weight = ROULETTE / jnp.where(importance > 0, importance, 1)
    weight = jnp.where(small, jnp.where(survives, weight, 0), 1)
    return weight, importance * weight
