"""Lighting by random walks: light scattered any number of times, as by `path_trace`. Radiance, which changes
slowly, is computed on a grid of nodes, by flights of a template, rotated at random at each node; direct
light, which changes fast at surfaces, is computed at each sample."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import all_finite
from .._util.memory import require_room
from .._util.noise import hashed_uniforms_4
from .._util.vec3 import Scalar, Vec3, along, apart, dot, plus, scaled, times
from ..scene.space import Space, enter
from ..scene.volume import without_voxels
from ..scene.voxel_fetch import corners
from ..xla.memory import gather
from .lights import Light, located, sky_of
from .medium import Scattering, scattering_at
from .random_walks import unit_walks
from .shading import Sample, Shading, Surroundings


NEAR, FAR = 2, 3
"""Distance from visible nodes, in nodes, up to which radiance and optical depths are computed."""

STEPS = 2
"""Steps from a node towards a light, per node of the grid's longest side. They grow with the distance."""

LOCAL_STEPS = 6
"""Steps from a sample towards a light, until the grid is fine enough."""

LOCAL = 2.25
"""Length of the local steps together, in the grid's spacing."""

LOOKS = 16
"""Steps of a flight up to the volume's end; the extinction of a step is that at one place in it."""

GOLDEN = (math.sqrt(5) - 1) / 2
"""Difference between the places in successive steps, so that all depths in steps are sampled."""

SPREAD = 0.02
"""Share of flights that end in any of the steps, in matter or not, so that derivatives see thin matter."""

COPIES = 3
"""Copies of the radiance on the finer grid that are in memory at once."""

NODES = 2**9, 2**12
"""Nodes at a time, for walks, and for extinctions and optical depths."""

EVEN = 3.0
"""Upper bound of a step's optical depth when its place is drawn, or none would lie in far parts of steps."""

TINY = 1e-6
"""Lower bound of optical depths in divisors, and share of flights that end where there is no matter."""


_Way: TypeAlias = tuple[Vec3, Scalar, Bool[Array, ""]]
_Begun: TypeAlias = tuple[Vec3, list[_Way], tuple[Scalar, ...]]


class ScatteredLight(Shading):
    """Light in a scene, on grids that span the volume's.

    Attributes:
        radiance: mean radiance over all directions, at the nodes of a finer grid, of light that was scattered
            before and of constant lights.
        depths: optical depth from each node to each light that has a direction.
        shape: shape of the grid of depths.
    """

    radiance: Float[Array, "finer 3"]
    depths: Float[Array, "nodes lights"]
    lights: tuple[Light, ...]
    shape: tuple[int, int, int] = eqx.field(static=True)

    @property
    def terms(self) -> int:
        return 1 if self.depths.shape[-1] else 0

    def begin(self, around: Surroundings, sample: Sample) -> _Begun:
        """Radiance from the grid; the way to each light; and the optical depth towards each light beyond the
        local steps (depths at surfaces are not linear between nodes)."""
        r, g, b = interpolated(self.radiance, _on_grid(around, _finer(self.shape), sample.point))
        ways, far_depths = self._ways(around, sample), []
        for number, (direction, reach, lit) in enumerate(ways):
            point = along(sample.point, direction, reach)
            row = interpolated(self.depths, _on_grid(around, self.shape, point))
            far_depths.append(jnp.where(lit, 0, row[number]))
        return (r, g, b), ways, tuple(far_depths)

    def term(
        self, around: Surroundings, sample: Sample, shared: _Begun, number: Int[Array, ""]
    ) -> tuple[Scalar, ...]:
        """Optical depths near the sample towards all lights, by one read, which takes less time."""
        _, ways, _ = shared
        steps = _growing(LOCAL_STEPS)
        places = [along(sample.point, to, middle * reach) for to, reach, _ in ways for _, middle in steps]
        extinctions = around.stored(lambda: [scattering_at(around, place).extinction for place in places])
        values = iter(extinctions)
        return tuple(reach * sum(width * next(values) for width, _ in steps) for _, reach, _ in ways)

    def color(self, sample: Sample, shared: _Begun, sums: tuple[Scalar, ...] | None) -> Vec3:
        light, _, far_depths = shared
        for source, near, far in zip(located(self.lights), sums or (), far_depths, strict=True):
            light = plus(light, arrived(source, sample.point, sample.direction, jnp.exp(-near - far)))
        return times(sample.color, light)

    def _ways(self, around: Surroundings, sample: Sample) -> list[_Way]:
        """Direction of each light, length of the local steps, and whether they reach the light."""
        near = LOCAL * around.space.diagonal / math.hypot(*(n - 1 for n in self.shape))
        ways = []
        for light in located(self.lights):
            direction, distance = _way(light, sample.point, sample.direction)
            reach = jnp.minimum(jnp.minimum(near, distance), _exit(around.space, sample.point, direction))
            ways.append((direction, reach, distance <= near))
        return ways


def _exit(space: Space, point: Vec3, direction: Vec3) -> Scalar:
    """Distance from a point in the volume to its exit along a line."""
    pixel = jnp.zeros((), jnp.int32)
    return enter(space.whole, point, direction, (pixel, pixel)).length


def _way(light: Light, point: Vec3, direction: Vec3) -> tuple[Vec3, Scalar]:
    """Direction and distance of a light."""
    arriving = light.at(point, direction)
    assert arriving.toward is not None
    return arriving.toward, arriving.distance


def arrived(light: Light, point: Vec3, direction: Vec3, transmittance: Scalar) -> Vec3:
    """Radiance of a light that is scattered at a point into a ray of this direction, for albedo 1."""
    arriving = light.at(point, direction)
    assert arriving.toward is not None
    return scaled(arriving.irradiance, transmittance / (4 * math.pi))


def interpolated(rows: Float[Array, "nodes channels"], position: tuple[Vec3, tuple[int, ...]]) -> Array:
    """Interpolate rows trilinearly at a position: coordinate and shape of the grid, by `_on_grid`."""
    total = jnp.zeros((), rows.dtype)
    for index, weight in corners(*position):
        total = total + weight * gather(rows, index)
    return total


def _on_grid(around: Surroundings, shape: tuple[int, ...], point: Vec3) -> tuple[Vec3, tuple[int, ...]]:
    ends = zip(around.space.coordinate(point), shape, around.volume.shape, strict=True)
    x, y, z = (c * ((n - 1) / (voxels - 1)) for c, n, voxels in ends)
    return (x, y, z), shape


def refined(values: Float[Array, "nx ny nz channels"]) -> Float[Array, "fx fy fz channels"]:
    """Interpolate values cubically on a grid twice as fine, since light falls steeply behind surfaces."""
    for axis in range(3):
        n = values.shape[axis]
        ends = [(1, 1) if i == axis else (0, 0) for i in range(4)]
        padded = jnp.pad(values, ends, mode="reflect", reflect_type="odd")  # exact if linear
        a, b, c, d = (jax.lax.slice_in_dim(padded, i, i + n - 1, axis=axis) for i in range(4))
        middle = (9 * (b + c) - (a + d)) / 16
        last = jax.lax.slice_in_dim(values, n - 1, n, axis=axis)
        pairs = jnp.stack([b, middle], axis=axis + 1)
        shape = (*values.shape[:axis], 2 * n - 2, *values.shape[axis + 1 :])
        values = jnp.concatenate([pairs.reshape(shape), last], axis=axis)
    return values


def _finer(shape: tuple[int, int, int]) -> tuple[int, ...]:
    """Shape of `refined` values."""
    return tuple(2 * n - 1 for n in shape)


def sum_neighbors(values: Float[Array, "nx ny nz c"]) -> Float[Array, "nx ny nz c"]:
    """Sum each node and its 26 neighbours."""
    for window in ((3, 1, 1, 1), (1, 3, 1, 1), (1, 1, 3, 1)):
        values = jax.lax.reduce_window(values, 0.0, jax.lax.add, window, (1, 1, 1, 1), "SAME")
    return values


def _growing(steps: int) -> list[tuple[float, float]]:
    """Widths and middles of steps that divide 1 and grow in proportion to their number."""
    ends = [(i / steps) ** 2 for i in range(steps + 1)]
    return [(b - a, (a + b) / 2) for a, b in itertools.pairwise(ends)]


class Transport(NamedTuple):
    """Inputs of the light on a grid, which is computed by `sets` of `walks` with `levels` scatterings."""

    around: Surroundings
    lights: tuple[Light, ...]
    seed: int
    sets: int
    walks: int
    levels: int

    def solved(self, nodes: int) -> ScatteredLight:
        """Light on a grid of `nodes` nodes along the axis of most voxels, all NaN if any input is NaN.
        **Raises** `ValueError` for grids that do not fit into memory."""
        volume = self.around.volume
        nx, ny, nz = (max(2, round(nodes * n / max(volume.shape))) for n in volume.shape)
        # the transfer function's tables are computed once, before all loops
        space, tables = self.around.space.whole, self.around.classification
        around = dataclasses.replace(self.around, space=space, tables=tables)
        grid = _Grid(self._replace(around=around), (nx, ny, nz))
        require_room(
            4 * math.prod(_finer(grid.shape)) * COPIES * 3,
            f"light at {nx} x {ny} x {nz} nodes for nodes={nodes}; use fewer",
        )
        rates, near, far = grid.matter()
        depths = grid.depths(far)
        radiance = refined(grid.radiance(near, rates, depths).reshape(*grid.shape, 3))
        radiance = jnp.maximum(radiance, 0).reshape(-1, 3)
        # comparisons would hide a NaN
        data = volume.data if jnp.issubdtype(volume.data.dtype, jnp.inexact) else None
        inputs = without_voxels(volume), data, self.around.transfer, self.lights
        valid = all_finite(inputs)
        radiance, depths = (jnp.where(valid, values, jnp.nan) for values in (radiance, depths))
        return ScatteredLight(radiance, depths, self.lights, grid.shape)

    @property
    def dtype(self) -> Any:
        return self.around.volume.spacing.dtype

    def flights(self) -> Float[Array, "flights 4"]:
        """Directions and lengths, in mean free paths, of flights, in the order of sets, walks and levels."""
        key = jax.random.key(self.seed)
        directions, lengths = unit_walks(key, self.sets, self.walks, self.levels)
        return jnp.concatenate([directions, lengths[..., None]], axis=-1).reshape(-1, 4)

    def at(self, point: Vec3) -> Scattering:
        return scattering_at(self.around, point)


class _State(NamedTuple):
    """A walk: place, rate of collisions, share of its light that arrives at the start, radiance gathered."""

    point: Vec3
    rate: Scalar
    throughput: Vec3
    light: Vec3


class _Grid(NamedTuple):
    """Nodes at which light is computed."""

    transport: Transport
    shape: tuple[int, int, int]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def point(self, number: Int[Array, ""], offset: tuple[Any, Any, Any] = (0.0, 0.0, 0.0)) -> Vec3:
        """World point at an offset from a node, in units of the grid."""
        around, dtype = self.transport.around, self.transport.dtype
        nodes = jnp.unravel_index(number, self.shape)
        ends = zip(nodes, offset, self.shape, around.volume.shape, strict=True)
        x, y, z = ((i.astype(dtype) + d) * ((voxels - 1) / (n - 1)) for i, d, n, voxels in ends)
        return around.space.point((x, y, z))

    def mapped(self, f: Callable[[Array], Array], nodes: Int[Array, " nodes"], size: int) -> Array:
        """Apply `f` to nodes, `size` at a time; 0 for others. `nodes` may end with numbers past the last."""
        size = min(size, self.size)
        padded = jnp.pad(nodes, (0, -nodes.size % size), constant_values=self.size)
        chunks = padded.reshape(-1, size)

        @jax.checkpoint  # a backward pass through all nodes would not fit into memory
        def of_chunk(chunk: Int[Array, " size"]) -> Array:
            return jax.vmap(f)(jnp.minimum(chunk, self.size - 1))

        shape = jax.eval_shape(of_chunk, chunks[0])

        def if_any(chunk: Int[Array, " size"]) -> Array:
            def zeros(_: Array) -> Array:
                return jnp.zeros(shape.shape, shape.dtype)

            return jax.lax.cond(chunk[0] < self.size, of_chunk, zeros, chunk)

        values = jax.lax.map(if_any, chunks)
        values = values.reshape(-1, *values.shape[2:])
        zeros = jnp.zeros((self.size, *values.shape[1:]), values.dtype)
        return zeros.at[chunks.reshape(-1)].set(values, mode="drop")

    def matter(self) -> tuple[Float[Array, " nodes"], Int[Array, " nodes"], Int[Array, " nodes"]]:
        """Rates of collisions around nodes; padded indices of nodes within NEAR and FAR of visible ones."""
        offsets = np.array([(0.5, 0.5, 0.5), *np.ndindex(2, 2, 2)]) / 2 - 0.25

        def measure(number: Int[Array, ""]) -> Array:
            def extinction_at(offset: Float[Array, "3"]) -> Scalar:
                return self.transport.at(self.point(number, apart(offset))).extinction

            extinction = jax.vmap(extinction_at)(jnp.asarray(offsets, self.transport.dtype))
            visible = (extinction > 0).astype(extinction.dtype)
            rate = jnp.sum(extinction) / jnp.maximum(jnp.sum(visible), 1)
            return jnp.stack([rate, jnp.max(visible)])

        measured = self.mapped(measure, jnp.arange(self.size, dtype=jnp.int32), NODES[1])
        rate, known = (measured[:, i].reshape(*self.shape, 1) for i in (0, 1))
        reached = []
        for _ in range(FAR):
            total, number = sum_neighbors(rate * known), sum_neighbors(known)
            rate = jnp.where(known > 0, rate, total / jnp.maximum(number, 1))
            known = (number > 0).astype(rate.dtype)
            reached.append(jnp.nonzero(known.reshape(-1) > 0, size=self.size, fill_value=self.size)[0])
        return rate.reshape(-1), reached[NEAR - 1], reached[-1]

    def depths(self, nodes: Int[Array, " nodes"]) -> Float[Array, "nodes lights"]:
        """Optical depths from nodes towards the lights."""
        transport, sources = self.transport, located(self.transport.lights)
        if not sources:
            return jnp.zeros((self.size, 0), transport.dtype)
        steps = jnp.asarray(_growing(STEPS * max(self.shape)), transport.dtype)

        def depth_toward(point: Vec3, light: Light) -> Scalar:
            direction, distance = _way(light, point, point)
            length = jnp.minimum(_exit(transport.around.space, point, direction), distance)

            def add(depth: Scalar, step: Float[Array, "2"]) -> tuple[Scalar, None]:
                width, middle = step
                place = along(point, direction, middle * length)
                return depth + width * transport.at(place).extinction, None

            return length * jax.lax.scan(add, jnp.zeros_like(length), steps)[0]

        def measure(number: Int[Array, ""]) -> Array:
            return jnp.stack([depth_toward(self.point(number), light) for light in sources])

        return self.mapped(measure, nodes, NODES[1])

    def radiance(
        self, near: Int[Array, " nodes"], rates: Float[Array, " nodes"], depths: Float[Array, "nodes lights"]
    ) -> Float[Array, "nodes 3"]:
        """Radiance at nodes, of light that was scattered before and of constant lights."""
        transport, flights = self.transport, self.transport.flights()
        levels, walks, dtype = transport.levels, transport.walks, transport.dtype
        seed, zero = jnp.uint32(transport.seed), jnp.zeros((), transport.dtype)

        def gathered(number: Int[Array, ""]) -> Array:
            word = number.astype(jnp.uint32)
            *turn, u = (u.astype(dtype) for u in hashed_uniforms_4(word, word, jnp.uint32(2**31), seed))
            axes, chosen = _rotation(*turn), (u * transport.sets).astype(jnp.int32)

            def walk(index: Int[Array, ""]) -> Array:
                def flight(level: Int[Array, ""]) -> tuple[Vec3, Scalar]:
                    """Direction and length of a flight of the template, rotated."""
                    x, y, z, length = gather(flights, ((chosen * walks + index) * levels) + level)
                    a, b, c = (dot(axis, (x, y, z)) for axis in axes)
                    return (a, b, c), length

                def advance(state: _State, level: Int[Array, ""]) -> tuple[_State, None]:
                    words = word, index.astype(jnp.uint32), level.astype(jnp.uint32), seed
                    u = hashed_uniforms_4(*words)[0].astype(dtype)
                    direction, length = flight(level)
                    quantile = -jnp.expm1(-length)
                    return self.advanced(state, direction, quantile, u, depths), None

                black, white = (zero, zero, zero), (zero + 1, zero + 1, zero + 1)
                start = _State(self.point(number), rates[number], white, black)
                end, _ = jax.lax.scan(advance, start, jnp.arange(levels, dtype=jnp.int32))
                return jnp.stack(end.light)

            return jnp.mean(jax.vmap(walk)(jnp.arange(walks, dtype=jnp.int32)), axis=0)

        return self.mapped(gathered, near, NODES[0])

    def advanced(self, state: _State, direction: Vec3, quantile: Scalar, u: Scalar, depths: Array) -> _State:
        """The walk after its next flight, which ends at a quantile of the collisions along it. `u` varies the
        places at which the extinction is read."""
        transport, (point, rate, throughput, light) = self.transport, state
        looks = _looks(rate, _exit(transport.around.space, point, direction), u)
        extinction = jax.vmap(lambda s: transport.at(along(point, direction, s)).extinction)(looks.places)
        distance, weight = _ending(extinction, looks, quantile)
        end = along(point, direction, distance)
        scattering = transport.at(end)
        # the mean of 1 - weight is the fraction of flights that leave
        light = plus(light, scaled(times(throughput, sky_of(transport.lights, transport.dtype)), 1 - weight))
        throughput = times(scaled(throughput, weight), scattering.albedo)
        row = interpolated(depths, _on_grid(transport.around, self.shape, end))
        for i, source in enumerate(located(transport.lights)):
            light = plus(light, times(throughput, arrived(source, end, direction, jnp.exp(-row[i]))))
        rate = jnp.where(scattering.extinction > 0, scattering.extinction, rate)
        return _State(end, rate, throughput, light)


class _Looks(NamedTuple):
    """Steps of a flight: widths, and places at which the extinction is read. `density` is 1, with the
    derivative of the places' density: it changes the weights of walks, whose places stay, or jumps would be
    missing."""

    places: Float[Array, "looks"]
    widths: Float[Array, "looks"]
    density: Float[Array, "looks"]


def _looks(rate: Scalar, length: Scalar, u: Scalar) -> _Looks:
    """Steps that grow with the distance beyond a mean free path, and places distributed as collisions."""
    fixed = jax.lax.stop_gradient(rate), jax.lax.stop_gradient(length)
    number, depth = jnp.arange(LOOKS + 1, dtype=rate.dtype), jnp.maximum(fixed[0] * fixed[1], TINY)
    ends = jnp.expm1(number / LOOKS * jnp.log1p(depth)) / depth
    widths = jnp.diff(ends)
    depths = jnp.clip(widths * depth, 0, EVEN)
    u = (u + GOLDEN * number[:-1]) % 1
    offsets = -jnp.log1p(u * jnp.expm1(-depths)) / depths
    depths = jnp.where(depths < EVEN, widths * jnp.maximum(rate * fixed[1], TINY), EVEN)
    density = depths * jnp.exp(-depths * offsets) / -jnp.expm1(-depths)
    places = fixed[1] * (ends[:-1] + offsets * widths)
    return _Looks(places, length * widths, density / jax.lax.stop_gradient(density))


def _ending(extinction: Float[Array, "looks"], looks: _Looks, u: Scalar) -> tuple[Scalar, Scalar]:
    """Distance of a flight, and its weight: probability of a collision in its last step over the probability
    by which the step was drawn."""
    depths = extinction * looks.widths
    collided = -jnp.expm1(-depths) * jnp.exp(depths - jnp.cumsum(depths))
    drawn = jax.lax.stop_gradient(collided + (SPREAD * jnp.sum(collided) + TINY) / LOOKS)
    drawn = drawn / jnp.sum(drawn)
    chosen = jnp.arange(LOOKS) == jnp.sum(jnp.cumsum(drawn)[:-1] < u)
    values = looks.places, looks.density * collided / drawn
    distance, weight = (jnp.sum(jnp.where(chosen, value, 0)) for value in values)
    return distance, weight


def _rotation(u: Scalar, v: Scalar, w: Scalar) -> tuple[Vec3, Vec3, Vec3]:
    """Rows of a uniformly distributed rotation. Source: Shoemake, "Uniform Random Rotations", 1992."""
    a, b = jnp.sqrt(1 - u), jnp.sqrt(u)
    x, y = a * jnp.sin(2 * jnp.pi * v), a * jnp.cos(2 * jnp.pi * v)
    z, s = b * jnp.sin(2 * jnp.pi * w), b * jnp.cos(2 * jnp.pi * w)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)),
        (2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)),
        (2 * (x * z - y * s), 2 * (y * z + x * s), 1 - 2 * (x * x + y * y)),
    )
