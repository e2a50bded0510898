"""Random walks of light, from the camera: flights, scatterings, next-event estimation. A walk is on its own
flight or on one towards a light; both query the volume alike, so that walks run side by side, a step at a
time."""

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
from ..scene.volume import Volume
from ..xla.memory import in_memory
from .fixed_paths import constant
from .likelihood import Sampling, likelihood
from .medium import Medium
from .tracking import Candidate, Decision, Flight, fly


T = TypeVar("T")

ROULETTE = 0.25
"""Threshold of Russian roulette, for a walk's throughput and for the transmittance towards a light."""

LIGHTS = "the directions and positions of lights"

Words: TypeAlias = tuple[UInt32[Array, "..."], UInt32[Array, "..."], UInt32[Array, "..."]]
"""Key of all random numbers along a path: pixel, path, seed."""


class WalkResult(NamedTuple):
    """A path's radiance, opacity (0 or 1), number of scatterings, and whether it was cut."""

    radiance: Vec3
    opacity: Scalar
    scatterings: Int[Array, "..."]
    exhausted: Bool[Array, "..."]

    @classmethod
    def zeros(cls, shape: tuple[int, ...]) -> "WalkResult":
        dark, no = jnp.zeros(shape, jnp.float32), jnp.zeros(shape, bool)
        return cls((dark, dark, dark), dark, jnp.zeros(shape, jnp.int32), no)


class Walk(NamedTuple):
    """The state of one path.

    Attributes:
        words: key of all its random numbers.
        steps: number of steps so far.
        flight: the current one: towards a light if `to_light`, else its own.
        to_light: whether it is on the way to a light.
        direction: of its own flight, world, unit; on the way to a light, that of its next own flight.
        throughput: fraction of the light at its end that arrives at the camera; (r, g, b).
        importance: by which Russian roulette ends it, a constant for derivatives; None: of its throughput.
        unoccluded: what the light adds without occlusion.
        transmittance: towards the light, so far.
        result: of the path, so far.
        alive: whether it continues.
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
        chosen = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        each = [light.at((x, y, z), direction) for light in lights]
        one = jax.tree.map(lambda *parts: jnp.select([chosen == i for i in range(count)], parts), *each)
        r, g, b = one.irradiance
        toward, distance = constant(LIGHTS, (one.toward, one.distance))
        return Arriving(toward, distance, (r * count, g * count, b * count))


class Scattering(NamedTuple):
    """What a walk is after a scattering: see `Walk`. `toward` and `end`: of its next flight."""

    direction: Vec3
    throughput: Vec3
    importance: Scalar
    unoccluded: Vec3
    to_light: Bool[Array, "..."]
    toward: Vec3
    end: Scalar


def step(scene: WalkScene, walks: Walk) -> Walk:
    """Advance many walks by a part of a flight. Expensive values are stored, or XLA recomputes them."""
    live = jnp.any(walks.alive)

    def uniforms(walk: Walk, stage: int) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        pixel, path, seed = walk.words
        return hashed_uniforms_4(pixel, path, (2 * walk.steps + stage).astype(jnp.uint32), seed)

    def each(f: Callable[..., Any], *arguments: Any) -> Any:
        return in_memory(live, jax.vmap(f), *arguments)

    first, second = (each(partial(uniforms, stage=stage), walks) for stage in (0, 1))
    (draw, decide, *_), (choose, first_turn, second_turn, survive) = first, second
    turn = each(partial(sample_phase, jax.lax.stop_gradient(scene.anisotropy)), first_turn, second_turn)
    majorants = scene.medium.majorants
    flight, candidate = each(partial(fly, majorants), walks.flight, draw)
    extinction, albedo = each(scene.medium.classify, each(scene.medium.measure, candidate.coordinate))
    decision = jax.vmap(partial(Decision.at, majorants))(candidate, extinction)
    at = candidate.coordinate
    scattering = each(partial(_scatter, scene), walks, at, albedo, decision.collided, turn, choose, survive)
    candidate = candidate._replace(found=candidate.found & walks.alive, over=candidate.over & walks.alive)
    walks = walks._replace(flight=flight, steps=walks.steps + 1)

    def advance(
        walk: Walk, candidate: Candidate, decision: Decision, scattering: Scattering, u: Scalar
    ) -> Walk:
        advanced = _delta_tracking(scene, walk, candidate, decision, scattering, u)
        if not located(scene.lights):
            return advanced
        return _where(walk.to_light, _ratio_tracking(scene, walk, candidate, decision, u), advanced)

    return jax.vmap(advance)(walks, candidate, decision, scattering, decide)


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
    """Outcome of a scattering. `collided`: the collision's weight; `turn`: direction around z."""
    kept = scaled(albedo, collided)
    before_roulette = times(walk.throughput, kept)
    least = scene.sampling.importance
    if walk.importance is None or least is None:
        importance = greatest(before_roulette)
    else:
        importance = walk.importance * jnp.maximum(jax.lax.stop_gradient(greatest(kept)), least)
    weight, importance = _roulette(importance, survive)
    weight = weight * likelihood(phase(turn[2], scene.anisotropy))
    throughput = scaled(before_roulette, weight)
    direction = scattered(turn, walk.direction)
    endless = jnp.full_like(survive, jnp.inf)
    if not located(scene.lights):
        no = jnp.zeros(survive.shape, bool)
        return Scattering(direction, throughput, importance, walk.unoccluded, no, direction, endless)
    light = scene.light(coordinate, walk.direction, choose)
    assert light.toward is not None
    density = phase(dot(walk.direction, light.toward), scene.anisotropy)
    unoccluded = scaled(times(before_roulette, light.irradiance), density)
    to_light = (greatest(unoccluded) > 0) | (walk.importance is not None)
    toward, end = select(to_light, light.toward, direction), jnp.where(to_light, light.distance, endless)
    return Scattering(direction, throughput, importance, unoccluded, to_light, toward, end)


def _delta_tracking(
    scene: WalkScene,
    walk: Walk,
    candidate: Candidate,
    decision: Decision,
    scattering: Scattering,
    decide: Scalar,
) -> Walk:
    """Advance a walk on its own flight. A collision scatters it; at the end it gathers the constant light."""
    before, (direction, throughput, importance, unoccluded, to_light, toward, end) = walk.result, scattering
    collides = candidate.found & (decide < decision.chance)
    capped = collides & (before.scatterings >= scene.max_scatterings)
    scatters, met = collides & ~capped, before.scatterings > 0
    gathered = times(walk.throughput, sky_of(scene.lights, jnp.float32))
    gathered = scaled(gathered, (candidate.over & met).astype(decision.share.dtype))
    passed = jnp.where(candidate.found & ~collides, decision.passed, 1)
    opacity = jnp.where(candidate.over & ~met, 1 - walk.throughput[0], before.opacity)
    goes_on = to_light | (importance > 0)
    return walk._replace(
        flight=_where(scatters, scene.flight(candidate.coordinate, toward, end), walk.flight),
        to_light=scatters & to_light,
        direction=select(scatters, direction, walk.direction),
        throughput=select(scatters, throughput, scaled(walk.throughput, passed)),
        importance=None if walk.importance is None else jnp.where(scatters, importance, walk.importance),
        unoccluded=select(scatters, unoccluded, walk.unoccluded),
        transmittance=jnp.ones_like(walk.transmittance),
        result=WalkResult(
            plus(before.radiance, gathered),
            jnp.where(scatters & ~met, 1, opacity),
            before.scatterings + scatters.astype(jnp.int32),
            before.exhausted | capped,
        ),
        alive=walk.alive & ~candidate.over & ~capped & (~scatters | goes_on),
    )


def _ratio_tracking(
    scene: WalkScene, walk: Walk, candidate: Candidate, decision: Decision, survive: Scalar
) -> Walk:
    """Advance a walk on its way to a light. At the end it continues from where it was scattered."""
    transmittance = walk.transmittance * jnp.where(candidate.found, jnp.maximum(1 - decision.share, 0), 1)
    survivor = jnp.where(survive * ROULETTE < transmittance, ROULETTE * likelihood(transmittance), 0)
    transmittance = jnp.where(candidate.found & (transmittance < ROULETTE), survivor, transmittance)
    done = candidate.over | (transmittance == 0)
    gathered = scaled(walk.unoccluded, jnp.where(candidate.over, transmittance, 0))
    own_flight = scene.flight(walk.flight.start, walk.direction, jnp.full_like(walk.flight.end, jnp.inf))
    importance = greatest(walk.throughput) if walk.importance is None else walk.importance
    return walk._replace(
        flight=_where(done, own_flight, walk.flight),
        to_light=~done,
        transmittance=transmittance,
        result=walk.result._replace(radiance=plus(walk.result.radiance, gathered)),
        alive=walk.alive & (~done | (importance > 0)),
    )


def _where(condition: Bool[Array, ""], a: T, b: T) -> T:
    return jax.tree.map(lambda one, other: jnp.where(condition, one, other), a, b)


def _roulette(importance: Scalar, uniform: Scalar) -> tuple[Scalar, Scalar]:
    """Russian roulette: weight by the importance, a constant for derivatives; and importance then."""
    importance = jax.lax.stop_gradient(importance)
    small = importance < ROULETTE
    survives = uniform * ROULETTE < importance
    weight = ROULETTE / jnp.where(importance > 0, importance, 1)
    weight = jnp.where(small, jnp.where(survives, weight, 0), 1)
    return weight, importance * weight
