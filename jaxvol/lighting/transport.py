"""Lighting by templates of random walks: light that is scattered any number of times, as by `path_trace`.

Light that has been scattered at least once before it reaches a sample changes slowly from place to place. It
is computed on a grid of nodes, by random walks from each: the flights of a template, turned at random. What a
sample gets from a light directly changes fast at surfaces, and is computed for each sample.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._util.checks import all_finite
from .._util.noise import hashed_uniforms_4
from .._util.vec3 import Scalar, Vec3, along, apart, dot, plus, scaled, times
from ..scene.space import enter
from ..scene.volume import without_voxels
from ..scene.voxel_fetch import corners
from ..xla.memory import gather
from .baked import sum_neighbors
from .harmonics import harmonics, packed, powers, unpacked
from .lights import ConstantLight, Light
from .materials import EDGE, Material, shares
from .medium import Scattering, scattering_at
from .phase import phase
from .random_walks import unit_walks
from .shading import Sample, Shading, Surroundings


NEAR = 2
"""Nodes up to which light is computed around visible ones, since samples lie between nodes."""

STEPS = 2
"""Steps from a node towards a light, per node of the grid's longest side. They grow with the distance."""

LOCAL_STEPS = 4
"""Steps from a sample towards a light, until the grid is fine enough for what lies beyond."""

LOCAL = 1.5
"""Length of these, in the grid's spacing."""

OWN = 0.6
"""Share of flights whose length is drawn from the extinction where they begin. The others' is drawn from the
mean free path of any material, or from that of thin matter, so that no weight is large where a flight goes on
in thinner matter, or beyond a cavity."""

THIN = 4
"""Mean free paths of thin matter along the diagonal of the volume."""

NODES = 2**9, 2**12
"""Nodes at a time for walks, and for what is simpler."""

LEAST = 1e-6
"""Least rate of collisions, and least density, by which anything is divided."""


class ScatteredLight(Shading):
    """Light in a scene, on a grid that spans the volume's.

    Attributes:
        radiance: at each node, of light that was scattered before, by the direction from which it comes
            (`harmonics`), three channels each.
        depths: at each node, the optical depth up to each light that has a direction.
        anisotropy: g; None for 0.
        shape: of the grid.
    """

    radiance: Float[Array, "nodes channels"]
    depths: Float[Array, "nodes lights"]
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    anisotropy: Float[Array, ""] | None
    shape: tuple[int, int, int] = eqx.field(static=True)

    @property
    def terms(self) -> int:
        return 1 if self.depths.shape[-1] else 0

    def begin(self, around: Surroundings, sample: Sample) -> tuple[Vec3, Scalar]:
        """Radiance from the grid, scattered towards the camera; and the share of light that is not absorbed."""
        coordinate = around.space.coordinate(sample.point)
        row = interpolated(self.radiance, _on_grid(around, self.shape, sample.point))
        light = _scattered(row, sample.direction, self.anisotropy)
        fractions = shares(self.materials, around.volume, coordinate, sample.measured[0], edge=EDGE)
        absorbed = sum(f * m.opacity for f, m in zip(fractions, self.materials, strict=True))
        return light, 1 - absorbed

    def term(
        self, around: Surroundings, sample: Sample, shared: Any, number: Int[Array, ""]
    ) -> tuple[Scalar, ...]:
        """The transmittance towards each light: step by step near the sample, from the grid beyond."""
        near = LOCAL * around.space.diagonal / math.hypot(*(n - 1 for n in self.shape))
        towards = [light.at(sample.point, sample.direction) for light in located(self.lights)]
        places = [
            along(sample.point, arriving.toward, middle * jnp.minimum(near, arriving.distance))
            for arriving in towards
            for _, middle in _growing(LOCAL_STEPS)
        ]
        steps = iter(around.stored(lambda: [self._extinction(around, place) for place in places]))
        found = []
        for light, arriving in enumerate(towards):
            reach = jnp.minimum(near, arriving.distance)
            depth = reach * sum(width * next(steps) for width, _ in _growing(LOCAL_STEPS))
            beyond = along(sample.point, arriving.toward, reach)
            row = interpolated(self.depths, _on_grid(around, self.shape, beyond))
            found.append(jnp.exp(-depth - row[light]))
        return tuple(found)

    def color(self, sample: Sample, shared: tuple[Vec3, Scalar], sums: Any) -> Vec3:
        light, kept = shared
        for source, transmittance in zip(located(self.lights), sums or (), strict=True):
            light = plus(
                light, arrived(source, sample.point, sample.direction, self.anisotropy, transmittance)
            )
        r, g, b = (jnp.clip(c, 0, 1) * kept for c in sample.color)
        return times((r, g, b), light)

    def _extinction(self, around: Surroundings, point: Vec3) -> Scalar:
        return scattering_at(around, self.materials, point).extinction


def located(lights: tuple[Light, ...]) -> list[Light]:
    """The lights that reach a point from a single direction."""
    return [light for light in lights if not isinstance(light, ConstantLight)]


def arrived(
    light: Light, point: Vec3, direction: Vec3, anisotropy: Scalar | None, transmittance: Scalar
) -> Vec3:
    """Radiance that a light adds, scattered at a point into a ray of this direction; with albedo 1."""
    arriving = light.at(point, direction)
    assert arriving.toward is not None
    density = 1 / (4 * math.pi) if anisotropy is None else phase(dot(arriving.toward, direction), anisotropy)
    return scaled(arriving.irradiance, transmittance * density)


def interpolated(rows: Float[Array, "nodes channels"], at: tuple[Vec3, tuple[int, ...]]) -> Array:
    """Trilinear interpolation of rows at a coordinate of a grid of this shape."""
    total = jnp.zeros((), rows.dtype)
    for index, weight in corners(*at):
        total = total + weight * gather(rows, index)
    return total


def _on_grid(around: Surroundings, shape: tuple[int, ...], point: Vec3) -> tuple[Vec3, tuple[int, ...]]:
    ends = zip(around.space.coordinate(point), shape, around.volume.shape, strict=True)
    x, y, z = (c * ((n - 1) / (whole - 1)) for c, n, whole in ends)
    return (x, y, z), shape


def _growing(steps: int) -> list[tuple[float, float]]:
    """Widths and middles of steps that divide 1 and grow in proportion to their number."""
    ends = [(i / steps) ** 2 for i in range(steps + 1)]
    return [(b - a, (a + b) / 2) for a, b in zip(ends, ends[1:], strict=False)]


class Transport(NamedTuple):
    """What light is computed from. `directions`, `lengths`: the flights of `count` sets of `walks`, with so
    many `levels` each."""

    around: Surroundings
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    anisotropy: Float[Array, ""] | None
    seed: int
    count: int
    walks: int
    levels: int

    @property
    def sky(self) -> Vec3:
        """Radiance of all constant lights."""
        constant = [light.radiance for light in self.lights if isinstance(light, ConstantLight)]
        return apart(sum(constant, jnp.zeros(3, self.dtype)))

    @property
    def dtype(self) -> Any:
        return self.around.volume.spacing.dtype

    def at(self, point: Vec3) -> Scattering:
        return scattering_at(self.around, self.materials, point)

    def solved(self, nodes: int) -> ScatteredLight:
        """The light on a grid of so many nodes along the volume's longest side. NaN in any input makes all of
        it NaN."""
        whole = self.around.volume.shape
        x, y, z = (max(2, round(nodes * n / max(whole))) for n in whole)
        # the transfer function's tables are computed before all loops
        around = dataclasses.replace(self.around, tables=self.around.classification)
        grid = _Grid(self._replace(around=around), (x, y, z))
        extinction, rates, near = grid.rates()
        depths = grid.depths(near)
        radiance = grid.radiance(near, extinction, rates, depths)
        inputs = (
            without_voxels(self.around.volume),
            self.around.transfer,
            self.materials,
            self.lights,
            self.anisotropy,
        )
        data = self.around.volume.data
        valid = all_finite((inputs, data if jnp.issubdtype(data.dtype, jnp.inexact) else None))
        radiance, depths = (jnp.where(valid, each, jnp.nan) for each in (radiance, depths))
        return ScatteredLight(radiance, depths, self.materials, self.lights, self.anisotropy, grid.shape)


class _Grid(NamedTuple):
    transport: Transport
    shape: tuple[int, int, int]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def point(self, number: Int[Array, ""], beside: Vec3 = (0.0, 0.0, 0.0)) -> Vec3:
        """World point of a node, or `beside` it, in units of the grid."""
        around, dtype = self.transport.around, self.transport.dtype
        ends = zip(
            jnp.unravel_index(number, self.shape), beside, self.shape, around.volume.shape, strict=True
        )
        x, y, z = ((i.astype(dtype) + offset) * ((whole - 1) / (n - 1)) for i, offset, n, whole in ends)
        return around.space.point((x, y, z))

    def mapped(self, f: Any, nodes: Int[Array, " nodes"], together: int) -> Array:
        """`f` of nodes, some `together`; 0 for all other nodes. `nodes` ends with as many `size` as are
        missing."""
        together = min(together, self.size)
        chunks = jnp.pad(nodes, (0, -nodes.size % together), constant_values=self.size).reshape(-1, together)
        # nothing of a chunk is kept for the backward pass, which would not fit into memory
        of_chunk = jax.checkpoint(lambda chunk: jax.vmap(f)(jnp.minimum(chunk, self.size - 1)))
        kind = jax.eval_shape(of_chunk, chunks[0])

        def one(chunk: Int[Array, " together"]) -> Array:
            return jax.lax.cond(
                chunk[0] < self.size, of_chunk, lambda _: jnp.zeros(kind.shape, kind.dtype), chunk
            )

        found = jax.lax.map(one, chunks)
        found = found.reshape(-1, *found.shape[2:])
        whole = jnp.zeros((self.size, *found.shape[1:]), found.dtype)
        return whole.at[chunks.reshape(-1)].set(found, mode="drop")

    def rates(self) -> tuple[Array, Array, Int[Array, " nodes"]]:
        """The extinction at all nodes; the rate at which flights from them collide; and the nodes around
        which anything may be visible, in front."""
        offsets = jnp.asarray([(0, 0, 0), *np.ndindex(2, 2, 2)], self.transport.dtype)
        offsets = jnp.where(jnp.arange(9)[:, None] > 0, (offsets - 0.5) / 2, 0)

        def one(number: Int[Array, ""]) -> Array:
            around = jax.vmap(lambda offset: self.transport.at(self.point(number, apart(offset))))(offsets)
            seen = (around.extinction > 0).astype(around.rate.dtype)
            rate = jnp.sum(seen * around.rate) / jnp.maximum(jnp.sum(seen), 1)
            return jnp.stack([around.extinction[0], rate, jnp.max(seen)])

        found = self.mapped(one, jnp.arange(self.size), NODES[1])
        rate, known = (found[:, i].reshape(*self.shape, 1) for i in (1, 2))
        for _ in range(NEAR):
            total, number = sum_neighbors(rate * known), sum_neighbors(known)
            rate = jnp.where(known > 0, rate, total / jnp.maximum(number, 1))
            known = (number > 0).astype(rate.dtype)
        near = jnp.nonzero(known.reshape(-1) > 0, size=self.size, fill_value=self.size)[0]
        return found[:, 0], rate.reshape(-1), near

    def depths(self, near: Int[Array, " nodes"]) -> Float[Array, "nodes lights"]:
        """Optical depths from nodes towards the lights."""
        transport, sources = self.transport, located(self.transport.lights)
        if not sources:
            return jnp.zeros((self.size, 0), transport.dtype)
        widths, middles = (
            jnp.asarray(each, transport.dtype)
            for each in zip(*_growing(STEPS * max(self.shape)), strict=True)
        )

        def one(number: Int[Array, ""]) -> Array:
            point, found = self.point(number), []
            for light in sources:
                arriving = light.at(point, point)
                column = row = jnp.zeros((), jnp.int32)
                ray = enter(transport.around.space, point, arriving.toward, (column, row))
                length = jnp.minimum(ray.length, arriving.distance)

                def add(depth: Scalar, step: Any) -> tuple[Scalar, None]:
                    width, middle = step
                    place = along(ray.entry, arriving.toward, middle * length)
                    return depth + width * transport.at(place).extinction, None

                found.append(length * jax.lax.scan(add, jnp.zeros_like(length), (widths, middles))[0])
            return jnp.stack(found)

        return self.mapped(one, near, NODES[1])

    def radiance(self, near: Int[Array, " nodes"], extinctions: Array, rates: Array, depths: Array) -> Array:
        """Radiance at nodes of light that was scattered at least once, or came from a constant light."""
        transport, order = self.transport, 0 if self.transport.anisotropy is None else 2
        around, levels = transport.around, transport.levels
        number_of_walks = transport.count * transport.walks
        g = jnp.zeros((), transport.dtype) if transport.anisotropy is None else transport.anisotropy
        directions, lengths = unit_walks(
            jax.random.key(transport.seed), transport.count, transport.walks, levels, g
        )
        flights = jnp.concatenate([directions, lengths[..., None]], axis=-1).reshape(
            number_of_walks, levels, 4
        )
        thin = THIN / jax.lax.stop_gradient(around.space.diagonal)
        each_rate = [thin, *(1 / material.mean_free_path for material in transport.materials)]
        sky, seed, sources = transport.sky, jnp.uint32(transport.seed), located(transport.lights)

        def one(number: Int[Array, ""]) -> Array:
            word = number.astype(jnp.uint32)
            *turn, which = (
                u.astype(transport.dtype) for u in hashed_uniforms_4(word, word, jnp.uint32(2**31), seed)
            )
            axes = _rotation(*turn)
            template = (which * transport.count).astype(jnp.int32)
            start = self.point(number)
            here = extinctions[number], rates[number]

            def walk(index: Int[Array, ""]) -> Array:
                of_walk = template * transport.walks + index

                def flight(state: Any, level: Int[Array, ""]) -> tuple[Any, None]:
                    point, (extinction, own), throughput, light = state
                    row = gather(flights.reshape(-1, 4), of_walk * levels + level)
                    along_template = row[0], row[1], row[2]
                    x, y, z = (dot(axis, along_template) for axis in axes)
                    direction = x, y, z
                    u = hashed_uniforms_4(word, index.astype(jnp.uint32), level.astype(jnp.uint32), seed)[0]
                    rate = _proposed(own, each_rate, u.astype(own.dtype))
                    distance = row[3] / jnp.maximum(rate, LEAST)
                    density = _density(own, each_rate, distance)
                    both = jax.vmap(lambda s: transport.at(along(point, direction, s)))(
                        jnp.stack([distance / 2, distance])
                    )
                    middle, there = (
                        jax.tree.map(lambda leaf: leaf[0], both),
                        jax.tree.map(lambda leaf: leaf[1], both),
                    )
                    depth = distance * (extinction + 4 * middle.extinction + there.extinction) / 6
                    weight = there.extinction * jnp.exp(-depth) / jnp.maximum(density, LEAST**2)
                    light = plus(light, scaled(times(throughput, sky), 1 - weight))
                    throughput = times(scaled(throughput, weight), there.albedo)
                    end = along(point, direction, distance)
                    if sources:
                        depths_there = interpolated(depths, _on_grid(around, self.shape, end))
                        for i, source in enumerate(sources):
                            added = arrived(
                                source, end, direction, transport.anisotropy, jnp.exp(-depths_there[i])
                            )
                            light = plus(light, times(throughput, added))
                    return (end, (there.extinction, there.rate), throughput, light), None

                zero = jnp.zeros((), transport.dtype)
                state = start, here, (zero + 1,) * 3, (zero,) * 3
                (_, _, _, light), _ = jax.lax.scan(flight, state, jnp.arange(levels))
                first = gather(flights.reshape(-1, 4), of_walk * levels)
                x, y, z = (dot(axis, (first[0], first[1], first[2])) for axis in axes)
                basis = harmonics((x, y, z), order)
                return packed([scaled(light, 4 * math.pi * b) for b in basis])

            return jnp.mean(jax.vmap(walk)(jnp.arange(transport.walks)), axis=0)

        return self.mapped(one, near, NODES[0])


def _scattered(row: Float[Array, "channels"], direction: Vec3, anisotropy: Scalar | None) -> Vec3:
    """Radiance scattered into a ray of this direction, from the radiance that arrives; with albedo 1."""
    order = 0 if anisotropy is None else 2
    g = jnp.zeros_like(direction[0]) if anisotropy is None else anisotropy
    zero = jnp.zeros_like(row[0])
    total = zero, zero, zero
    each = zip(unpacked(row), harmonics(direction, order), powers(g, order), strict=True)
    for coefficient, basis, power in each:
        total = plus(total, scaled(coefficient, basis * power))
    return total


def _proposed(own: Scalar, rates: list[Scalar], u: Scalar) -> Scalar:
    """The rate of collisions at which a flight's length is drawn, of those that `_density` mixes."""
    chosen = own
    for i, rate in enumerate(rates):
        chosen = jnp.where(u >= OWN + (1 - OWN) * i / len(rates), rate, chosen)
    return chosen


def _density(own: Scalar, rates: list[Scalar], distance: Scalar) -> Scalar:
    """Density of the length of a flight."""
    others = sum(rate * jnp.exp(-rate * distance) for rate in rates) / len(rates)
    return OWN * own * jnp.exp(-own * distance) + (1 - OWN) * others


def _rotation(u: Scalar, v: Scalar, w: Scalar) -> tuple[Vec3, Vec3, Vec3]:
    """The rows of a rotation, uniformly distributed for uniform numbers in [0, 1).

    Source: Shoemake, "Uniform Random Rotations", Graphics Gems III, 1992."""
    a, b = jnp.sqrt(1 - u), jnp.sqrt(u)
    x, y = a * jnp.sin(2 * jnp.pi * v), a * jnp.cos(2 * jnp.pi * v)
    z, s = b * jnp.sin(2 * jnp.pi * w), b * jnp.cos(2 * jnp.pi * w)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)),
        (2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)),
        (2 * (x * z - y * s), 2 * (y * z + x * s), 1 - 2 * (x * x + y * y)),
    )
