"""What happens to light on its way from the eye? It flies, is scattered, looks for a light, and flies on.

A walk is one path, traced backwards from the camera. It is always on one flight: its own, or one from its
last scattering towards a light, by which it learns how much of that light arrives. Both ask the same of a
volume, so that walks at different stages run side by side, a step at a time, without waiting for each other.
"""

from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from .._util.noise import hashed_uniforms_4
from .._util.vec3 import Scalar, Vec3, apart
from .._util.xla import in_memory
from ..lighting.lights import Arriving, ConstantLight, Light, LocatedLight
from ..volume import Volume
from .majorants import Majorants
from .medium import Medium
from .phase import phase, sample_phase, turned
from .tracking import Candidate, Flight, fly


ROULETTE = 0.25
"""What a walk may still bring, or a light still sends, relative to its start. Below it chance decides whether
to follow it: with a probability in proportion, and then as if it were this much."""

MOST_STEPS = 2**24
"""Steps after which a walk counts as exhausted, against walks that never end."""

Words: TypeAlias = tuple[UInt32[Array, "..."], UInt32[Array, "..."], UInt32[Array, "..."]]
"""The key of all that is random along a path: pixel, path, seed."""

Uniforms: TypeAlias = tuple[Scalar, Scalar, Scalar, Scalar]
"""Random numbers in [0, 1)."""


class Walk(eqx.Module):
    """One path, as far as it has come.

    - `words`: the key of all that is random along it. `steps`: taken so far.
    - `flight`: that which it is on, towards a light if `to_light`; else its own.
    - `direction`: of its own flight, world, unit; the next one while it looks for a light.
    - `throughput`: the share of light at its end that arrives at the camera; (r, g, b).
    - `promised`: what the light will add if nothing stands between, of which `clear` is left so far.
    - `radiance`: gathered.
    - `met`: whether the camera's ray met anything. `scatterings`: so far.
    - `alive`: whether it goes on. `exhausted`: whether it was cut off.
    """

    words: Words
    steps: Int[Array, ""]
    flight: Flight
    to_light: Bool[Array, ""]
    direction: Vec3
    throughput: Vec3
    promised: Vec3
    clear: Scalar
    radiance: Vec3
    met: Bool[Array, ""]
    scatterings: Int[Array, ""]
    alive: Bool[Array, ""]
    exhausted: Bool[Array, ""]

    @classmethod
    def begin(
        cls,
        words: Words,
        flight: Flight,
        direction: Vec3,
        alive: Bool[Array, ""],
    ) -> "Walk":
        """From the camera's side of the volume."""
        no, none, nothing = jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.zeros_like(flight.depth)
        black, one = (nothing, nothing, nothing), nothing + 1
        return cls(
            words,
            steps=none,
            flight=flight,
            to_light=no,
            direction=direction,
            throughput=(one, one, one),
            promised=black,
            clear=nothing,
            radiance=black,
            met=no,
            scatterings=none,
            alive=alive,
            exhausted=no,
        )


class Scene(NamedTuple):
    """What walks walk through.

    - `most`: scatterings that a walk may have.
    """

    volume: Volume
    medium: Medium
    majorants: Majorants
    lights: tuple[Light, ...]
    anisotropy: Scalar
    most: Int[Array, ""]

    @property
    def located(self) -> tuple[LocatedLight, ...]:
        return tuple(light for light in self.lights if isinstance(light, LocatedLight))

    @property
    def surroundings(self) -> Vec3:
        """Radiance from all around."""
        constant = [light.radiance for light in self.lights if isinstance(light, ConstantLight)]
        return apart(sum(constant, jnp.zeros(3, jnp.float32)))

    @property
    def spacing(self) -> Vec3:
        return apart(self.volume.spacing)

    def flight(self, start: Vec3, direction: Vec3, end: Scalar) -> Flight:
        """From a grid coordinate in a world direction."""
        return Flight.to(self.majorants, start, direction, self.spacing, end)

    def light(self, place: Vec3, uniform: Scalar) -> Arriving:
        """What arrives at a grid coordinate from one of the located lights, chosen at random, on average
        from all of them."""
        x, y, z = (o + c * s for o, c, s in zip(apart(self.volume.origin), place, self.spacing, strict=True))
        count = len(self.located)
        chosen = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
        each = [light.at((x, y, z)) for light in self.located]
        one = jax.tree.map(lambda *parts: jnp.select([chosen == i for i in range(count)], parts), *each)
        r, g, b = one.irradiance
        return one._replace(irradiance=(r * count, g * count, b * count))


class Scattering(NamedTuple):
    """What a scattering makes of a walk: where it goes on to, as `Walk` has it, and where it looks first.

    - `toward`, `end`: world direction, and length, of its next flight.
    """

    direction: Vec3
    throughput: Vec3
    promised: Vec3
    to_light: Bool[Array, ""]
    toward: Vec3
    end: Scalar


def step(scene: Scene, walks: Walk) -> Walk:
    """The next step of many walks, arrays of one length: a part of a flight, and what comes of it.

    XLA computes anew what several results are made of, for each of them; but not what a branch has put in
    memory. So everything dear is behind one.
    """
    live = jnp.any(walks.alive)
    first, second = (in_memory(live, jax.vmap(lambda w, i=i: _uniforms(w, i)), walks) for i in (0, 1))
    (draw, decide, *_), (choose, first_turn, second_turn, survive) = first, second
    turn = in_memory(
        live, jax.vmap(sample_phase, in_axes=(None, 0, 0)), scene.anisotropy, first_turn, second_turn
    )
    flight, candidate = in_memory(
        live, jax.vmap(lambda flight, draw: fly(scene.majorants, flight, draw)), walks.flight, draw
    )
    measured = in_memory(live, jax.vmap(scene.medium.measure), candidate.place)
    extinction, albedo = in_memory(live, jax.vmap(scene.medium.meet), measured)
    share = extinction / jnp.maximum(candidate.majorant, jnp.finfo(extinction.dtype).tiny)
    scattering = in_memory(
        live,
        jax.vmap(lambda *of_one: _scattering(scene, *of_one)),
        walks,
        candidate.place,
        albedo,
        turn,
        choose,
        survive,
    )
    found, over = candidate.found & walks.alive, candidate.over & walks.alive
    candidate = eqx.tree_at(lambda c: (c.found, c.over), candidate, (found, over))
    walks = eqx.tree_at(lambda w: (w.flight, w.steps), walks, (flight, walks.steps + 1))
    return jax.vmap(lambda *of_one: _onward(scene, *of_one))(walks, candidate, share, scattering, decide)


def _onward(
    scene: Scene, walk: Walk, candidate: Candidate, share: Scalar, scattering: Scattering, decide: Scalar
) -> Walk:
    """What becomes of a walk at a candidate, where a share of the majorant is extinction; or at the end of
    its flight."""
    onward = _walked(scene, walk, candidate, share, scattering, decide)
    if scene.located:
        looking = _looked(scene, walk, candidate, share, decide)
        onward = jax.tree.map(lambda a, b: jnp.where(walk.to_light, a, b), looking, onward)
    spent = onward.alive & (onward.steps >= MOST_STEPS)
    return eqx.tree_at(
        lambda w: (w.alive, w.exhausted), onward, (onward.alive & ~spent, onward.exhausted | spent)
    )


def _scattering(
    scene: Scene, walk: Walk, place: Vec3, albedo: Vec3, turn: Vec3, choose: Scalar, survive: Scalar
) -> Scattering:
    """What comes of a walk if it is scattered here, by this turn."""
    before = _times(walk.throughput, albedo)
    throughput = _after_roulette(before, survive)
    direction = turned(turn, walk.direction)
    endless = jnp.full_like(survive, jnp.inf)
    if not scene.located:
        no = jnp.zeros(survive.shape, bool)
        return Scattering(direction, throughput, walk.promised, no, direction, endless)
    light = scene.light(place, choose)
    density = phase(_dot(walk.direction, light.toward), scene.anisotropy)
    promised = _scaled(_times(before, light.irradiance), density)
    to_light = _greatest(promised) > 0
    toward, end = _where(to_light, light.toward, direction), jnp.where(to_light, light.distance, endless)
    return Scattering(direction, throughput, promised, to_light, toward, end)


def _walked(
    scene: Scene, walk: Walk, candidate: Candidate, share: Scalar, scattering: Scattering, decide: Scalar
) -> Walk:
    """A walk on its own flight: delta tracking. Its end is the light all around; a collision scatters it."""
    collides = candidate.found & (decide < share)
    capped = collides & (walk.scatterings >= scene.most)
    scatters = collides & ~capped
    gathered = _times(walk.throughput, scene.surroundings)
    gathered = _scaled(gathered, (candidate.over & walk.met).astype(share.dtype))
    onward = scene.flight(candidate.place, scattering.toward, scattering.end)
    goes_on = scattering.to_light | (_greatest(scattering.throughput) > 0)
    return Walk(
        walk.words,
        walk.steps,
        jax.tree.map(lambda new, old: jnp.where(scatters, new, old), onward, walk.flight),
        scatters & scattering.to_light,
        _where(scatters, scattering.direction, walk.direction),
        _where(scatters, scattering.throughput, walk.throughput),
        _where(scatters, scattering.promised, walk.promised),
        jnp.ones_like(walk.clear),
        _plus(walk.radiance, gathered),
        walk.met | collides,
        walk.scatterings + scatters.astype(jnp.int32),
        walk.alive & ~candidate.over & ~capped & (~scatters | goes_on),
        walk.exhausted | capped,
    )


def _looked(scene: Scene, walk: Walk, candidate: Candidate, share: Scalar, survive: Scalar) -> Walk:
    """A walk on its way to a light: ratio tracking. At its end it goes on from where it was scattered."""
    left = walk.clear * jnp.where(candidate.found, jnp.maximum(1 - share, 0), 1)
    kept = jnp.where(survive * ROULETTE < left, ROULETTE, 0)
    left = jnp.where(candidate.found & (left < ROULETTE), kept, left)
    done = candidate.over | (left == 0)
    gathered = _scaled(walk.promised, jnp.where(candidate.over, left, 0))
    onward = scene.flight(walk.flight.start, walk.direction, jnp.full_like(walk.flight.end, jnp.inf))
    return eqx.tree_at(
        lambda w: (w.flight, w.to_light, w.clear, w.radiance, w.alive),
        walk,
        (
            jax.tree.map(lambda new, old: jnp.where(done, new, old), onward, walk.flight),
            ~done,
            left,
            _plus(walk.radiance, gathered),
            walk.alive & (~done | (_greatest(walk.throughput) > 0)),
        ),
    )


def _after_roulette(throughput: Vec3, uniform: Scalar) -> Vec3:
    """The throughput, where it is small either 0 or as much larger as this is rare."""
    greatest = _greatest(throughput)
    small = greatest < ROULETTE
    followed = uniform * ROULETTE < greatest
    more = ROULETTE / jnp.where(greatest > 0, greatest, 1)
    return _scaled(throughput, jnp.where(small, jnp.where(followed, more, 0), 1))


def _uniforms(walk: Walk, stage: int) -> Uniforms:
    """Four numbers in [0, 1) for one of the two stages of a walk's next step."""
    pixel, path, seed = walk.words
    return hashed_uniforms_4(pixel, path, (2 * walk.steps + stage).astype(jnp.uint32), seed)


def _where(condition: Bool[Array, ""], a: Vec3, b: Vec3) -> Vec3:
    x, y, z = (jnp.where(condition, p, q) for p, q in zip(a, b, strict=True))
    return x, y, z


def _times(a: Vec3, b: Vec3) -> Vec3:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


def _plus(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _scaled(a: Vec3, factor: Scalar) -> Vec3:
    return a[0] * factor, a[1] * factor, a[2] * factor


def _dot(a: Vec3, b: Vec3) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _greatest(a: Vec3) -> Scalar:
    return jnp.maximum(jnp.maximum(a[0], a[1]), a[2])
