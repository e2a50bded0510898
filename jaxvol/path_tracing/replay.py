"""Reverse mode: paths are walked twice more, and each step is pulled back when the light behind it is known.

The first walk finds the radiance of each path, the second one walks the same path by the same random numbers.
The cotangent of the throughput after a step is that of the radiance, times the radiance gathered later over
the throughput. The former is the path's total minus what was gathered so far: no step is stored. Where the
throughput has a factor near 0, such as that of a collision in empty space, both lack it (`Walk.dark`).

What arrives from a light is known only at the end of the flight towards it. So the second walk first scouts a
scattering and the flight after it, then returns to the state before it, and pulls them back.

Source: Vicini, Speierer and Jakob, "Path Replay Backpropagation", 2021.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._util.vec3 import Scalar, Vec3, dot, minus, scaled, times
from ..engine.voxel_gradient import (
    Sums,
    asked_of,
    cotangents_of,
    recorded,
    with_cotangents,
    zero_perturbations,
    zero_sums,
)
from ..lighting.lights import Light
from ..lighting.materials import Material
from ..scene.transfer import Measured, Transfer
from ..scene.volume import Volume
from ..scene.voxel_fetch import Fetched
from ..xla.linear import moving_leaves
from ..xla.trees import PyTree, added, floats, is_none, zeros_of
from .lanes import Index, walk_all
from .likelihood import jumping_in_reverse
from .medium import Medium
from .walks import Walk, WalkResult, WalkScene, advance, propose, step, where_all


class Inputs(NamedTuple):
    """Inputs of an image that have derivatives, at least in part."""

    volume: Volume
    transfer: Transfer
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    anisotropy: Scalar


class Replay(NamedTuple):
    """The second walk of a path.

    Attributes:
        walk: the state of the walk.
        before: the state before the last scattering.
        scouts: True until the transmittance towards the light is known.
        transmittance: transmittance of the whole flight towards the light, unless the walk `scouts`.
        total: the result of the path.
        radiance_bar: cotangent of the path's radiance.
        opacity_bar: cotangent of the path's opacity.
    """

    walk: Walk
    before: Walk
    scouts: Bool[Array, "..."]
    transmittance: Scalar
    total: WalkResult
    radiance_bar: Vec3
    opacity_bar: Scalar

    @property
    def alive(self) -> Bool[Array, "..."]:
        return self.walk.alive

    @property
    def result(self) -> tuple[()]:
        """Empty result: that of replays is a sum over all paths."""
        return ()

    def advanced(self, ahead: Walk) -> "Replay":
        """The replay after a step that led `ahead`."""
        begins, ends = ~self.walk.to_light & ahead.to_light, self.walk.to_light & ~ahead.to_light
        returns = self.scouts & ends
        return self._replace(
            walk=where_all(returns, self.before, ahead),
            before=where_all(self.scouts & begins, self.walk, self.before),
            scouts=self.scouts ^ ends,
            transmittance=jnp.where(returns, ahead.transmittance, self.transmittance),
        )

    def cotangents(self, ahead: Walk) -> tuple[Any, ...]:
        """Cotangents of `_moving(ahead)`."""
        bar, parts = self.radiance_bar, (ahead.dark, self.walk.dark, ahead.result, self.total)
        dark, dark_before, result, total = cast(Any, parts)  # replayed walks have all optional parts
        light_bar = times(bar, dark)
        # what the flight towards a light will add
        pending = scaled(ahead.unoccluded, jnp.where(ahead.to_light, self.transmittance, 0))
        rest = minus(minus(total.radiance, result.radiance), times(pending, dark))
        dark_rest = times(minus(minus(total.after_dark, result.after_dark), pending), dark)
        zipped = zip(bar, dark, rest, dark_rest, strict=True)
        red, green, blue = (c_bar * jnp.where(d == 1, near, far) for c_bar, d, near, far in zipped)
        # an opacity of 1 minus the throughput, where nothing scattered
        red = red - self.opacity_bar * (1 - total.opacity)
        throughput_bar = tuple(map(_over, (red, green, blue), ahead.throughput))
        fell = [(d != 1) & (d_before == 1) for d, d_before in zip(dark, dark_before, strict=True)]
        dark_bar = tuple(map(jnp.where, fell, times(bar, total.after_dark), (0, 0, 0)))
        unoccluded_bar = scaled(light_bar, self.transmittance)
        transmittance_bar = _over(dot(unoccluded_bar, ahead.unoccluded), ahead.transmittance)
        bars = throughput_bar, dark_bar, unoccluded_bar, transmittance_bar, bar
        pulls = self.alive & ~(self.scouts & (self.walk.to_light | ahead.to_light))
        return jax.tree.map(lambda leaf: jnp.where(pulls, leaf, 0), bars)


def _moving(walk: Walk) -> tuple[Any, ...]:
    """The parts of a walk that have a derivative. (The opacity is one minus a throughput.)"""
    return walk.throughput, walk.dark, walk.unoccluded, walk.transmittance, walk.result.radiance


def _over(a: Scalar, b: Scalar) -> Scalar:
    """a / b; 0 where b is."""
    return jnp.where(b == 0, 0, a / jnp.where(b == 0, 1, b))


def _data(inputs: Inputs) -> Any:
    return inputs.volume.data


class Pulled(NamedTuple):
    """Sums of cotangents: of all arrays of voxels, and of the other inputs that are differentiated."""

    voxels: Sums
    moving: PyTree

    @classmethod
    def zeros(cls, inputs: Inputs, perturbed: Inputs) -> "Pulled":
        """Zeros for the perturbed inputs. (The voxels of a field are among the others: it may read them in
        any way.)"""
        moving = floats(eqx.filter(inputs, perturbed))
        if inputs.volume.field is not None:
            return cls([None], zeros_of(moving))
        voxels = zero_sums(inputs.volume, asked_of(inputs.volume, perturbed.volume))
        return cls(voxels, zeros_of(eqx.tree_at(_data, moving, None, is_leaf=is_none)))

    def cotangents(self, inputs: Inputs) -> Inputs:
        """The cotangents, in the structure of the perturbed inputs."""
        if self.voxels[0] is None:
            return self.moving
        (data,) = cotangents_of(inputs.volume, self.voxels)
        return eqx.tree_at(_data, self.moving, data, is_leaf=is_none)


def replay_all(
    scene: WalkScene,
    inputs: Inputs,
    begin: Callable[[Index], Walk],
    bars: Callable[[Index], tuple[Vec3, Scalar]],
    sums: Pulled,
    count: int,
    lanes: int,
) -> Pulled:
    """The sums plus the cotangents of `count` paths. `bars`: cotangents of the radiance and opacity of paths
    by index. The floats of `inputs` that are differentiated, but for voxels, have the structure of
    `sums.moving`."""

    def begin_walk(index: Index) -> Walk:
        walk = begin(index)
        radiance_bar, opacity_bar = bars(index)
        depends = [bar != 0 for bar in (*radiance_bar, opacity_bar)]
        return walk._replace(alive=walk.alive & reduce(jnp.logical_or, depends))

    def begin_replay(index: Index) -> Replay:
        walk, total = begin_walk(index), jax.tree.map(lambda leaf: leaf[index], totals)
        scouts = jnp.ones(index.shape, bool)
        return Replay(walk, walk, scouts, walk.transmittance, total, *bars(index))

    totals, _ = walk_all(begin_walk, lambda walks, none: (step(scene, walks), none), count, lanes)
    return walk_all(begin_replay, partial(_replay_step, scene, inputs), count, lanes, sums)[1]


def _replay_step(scene: WalkScene, inputs: Inputs, replays: Replay, sums: Pulled) -> tuple[Replay, Pulled]:
    """A step of many replays, pulled back to the sums."""
    walks, volume = replays.walk, inputs.volume
    proposal = propose(scene, walks)
    asked = any(sum_ is not None for sum_ in sums.voxels)

    def ahead(moving: PyTree, changes: list[Any]) -> tuple[PyTree, tuple[Walk, list[list[Fetched]]]]:
        changed = eqx.combine(moving, inputs)

        def medium(volume: Volume) -> Medium:
            parts = volume, changed.transfer, changed.materials
            return Medium.within(scene.medium.majorants, *parts, jumping_in_reverse)

        def measure(changes: list[Any], coordinate: Vec3) -> tuple[Measured, list[list[Fetched]]]:
            if not asked:
                return medium(changed.volume).measure(coordinate), []
            volume, fetched = recorded(changed.volume, changes)
            return medium(volume).measure(coordinate), fetched

        measured, fetched = jax.vmap(measure)(changes, proposal.candidate.coordinate)
        scene_ = scene._replace(
            medium=medium(changed.volume), lights=changed.lights, anisotropy=changed.anisotropy
        )
        walk = advance(scene_, walks, proposal, measured)
        return _moving(walk), (walk, fetched)

    changes: list[Any] = []
    if asked:
        _, (_, fetched) = jax.eval_shape(ahead, sums.moving, changes)
        changes = zero_perturbations(volume, fetched, sums.voxels, jnp.dtype(jnp.float32))
    moving = moving_leaves(inputs, sums.moving)
    _, pull, (walk, fetched) = jax.vjp(ahead, moving, changes, has_aux=True)
    of_moving, of_changes = pull(replays.cotangents(walk))
    voxels = with_cotangents(sums.voxels, volume, fetched, of_changes) if asked else sums.voxels
    return replays.advanced(walk), Pulled(voxels, added(sums.moving, of_moving))
