"""What if the light at each place were known already? Computed once, in a volume of its own.

What a light does to a sample, but for what depends on the view, is the ratio of its colour as lit to its
colour: three numbers, which vary more slowly than the colour does. They are computed on a grid, and fetched.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._util.compaction import Chosen
from .._util.memory import require_room
from .._util.vec3 import Vec3
from ..volume import Volume, split
from .shading import Lighting, Sample, Shading, Surroundings, lit


LEVELS = 2**10 - 1
"""Steps from 0 to the highest ratio: 10 bits for each of the colours."""

DARKEST = 1 / 64
"""A colour below this counts as this: its ratio would have no bound."""

GROWN = 2
"""Nodes, around those where anything is seen, to which light is spread: samples lie between nodes."""


BYTES = 96
"""Memory that a node takes while its light is computed: its ratios, whether they are known, and the sums over
the nodes around."""


class BakedLighting(Lighting):
    """Light that was computed before, by `bake`.

    - `words`: for each node of a grid that spans the volume's, the ratios of colours as lit to colours, 10
      bits for each of red, green and blue.
    - `highest`: the ratios that the highest of these numbers stands for.

    It is as it was: it has no gradient, and neither does it follow the volume or the transfer function.
    """

    words: UInt32[Array, " nodes"]
    highest: Float[Array, "3"]
    shape: tuple[int, int, int] = eqx.field(static=True)

    @property
    def ratio(self) -> Float[Array, "nx ny nz 3"]:
        """The ratios at the nodes."""
        shifts = jnp.arange(3, dtype=jnp.uint32) * 10
        steps = (self.words[:, None] >> shifts[None]) & jnp.uint32(LEVELS)
        return (steps.astype(self.highest.dtype) * (self.highest / LEVELS)[None]).reshape(*self.shape, 3)

    def over(self, around: Surroundings) -> "BakedShading":
        return BakedShading(jax.lax.stop_gradient(self))


class BakedShading(Shading):
    """Baked light ready for one image."""

    light: BakedLighting

    def about(self, around: Surroundings, sample: Sample) -> Vec3:
        """The ratios at the sample, trilinear."""
        coordinate = around.space.coordinate(sample.point)
        ends = zip(coordinate, self.light.shape, around.volume.shape, strict=True)
        x, y, z = (c * ((n - 1) / (whole - 1)) for c, n, whole in ends)
        (i, j, k), fractions = split((x, y, z), self.light.shape)
        _, ny, nz = self.light.shape
        r = g = b = jnp.zeros_like(x)
        for a in range(8):
            corner = a >> 2, a >> 1 & 1, a & 1
            weight = jnp.ones_like(x)
            for side, fraction in zip(corner, fractions, strict=True):
                weight = weight * (fraction if side else 1 - fraction)
            place = ((i + corner[0]) * ny + j + corner[1]) * nz + k + corner[2]
            # signed, since conversion from those is one instruction
            word = self.light.words.at[place].get(mode="promise_in_bounds").astype(jnp.int32)
            r, g, b = (
                total + weight * (word >> shift & LEVELS).astype(x.dtype)
                for total, shift in zip((r, g, b), (0, 10, 20), strict=True)
            )
        red, green, blue = (c * high / LEVELS for c, high in zip((r, g, b), self.light.highest, strict=True))
        return red, green, blue

    def color(self, sample: Sample, notes: Vec3, sums: Any) -> Vec3:
        r, g, b = (c * ratio for c, ratio in zip(sample.color, notes, strict=True))
        return r, g, b


def nodes_for(volume: Volume, resolution: int) -> tuple[int, int, int]:
    """The shape of a grid with so many nodes along the volume's longest side, and as many in proportion along
    the others.

    **Raises:** `ValueError` where light on it would not fit into memory."""
    longest = max(volume.shape)
    nx, ny, nz = (max(2, round(resolution * n / longest)) for n in volume.shape)
    require_room(
        nx * ny * nz * BYTES, f"a grid of {nx} x {ny} x {nz} nodes for baked={resolution}; take a coarser one"
    )
    return nx, ny, nz


def bake(shading: Shading, around: Surroundings, nodes: tuple[int, int, int]) -> BakedLighting:
    """The light on a grid of nodes. NaN in what it is made of makes all of it NaN."""
    shading, around = jax.lax.stop_gradient((shading, around))
    nx, ny, nz = nodes
    classification = around.transfer.over(around.volume)

    def node(number: Int[Array, ""]) -> Sample:
        places = jnp.unravel_index(number, (nx, ny, nz))
        x, y, z = (
            i.astype(around.volume.spacing.dtype) * ((n - 1) / (m - 1))
            for i, n, m in zip(places, around.volume.shape, (nx, ny, nz), strict=True)
        )
        measured = classification.searched(classification.measure((x, y, z)))
        color, extinction = classification.classify(measured)
        still, one = jnp.zeros_like(extinction), jnp.ones_like(extinction)
        none = jnp.zeros((), jnp.int32)
        point = around.space.point((x, y, z))
        return Sample(point, (still, still, still), measured, color, extinction, one, (none, none))

    def ratio(number: Int[Array, ""]) -> Vec3:
        sample = node(number)
        r, g, b = (
            new / jnp.maximum(old, DARKEST)
            for new, old in zip(lit(shading, around, sample)[0], sample.color, strict=True)
        )
        return r, g, b

    count = nx * ny * nz
    seen = jax.lax.map(lambda i: node(i).extinction != 0, jnp.arange(count), batch_size=min(count, 2**14))
    chosen = Chosen.of([seen.reshape(1, -1)])
    none = jnp.zeros(count, around.volume.spacing.dtype)

    def chunk(places: Int[Array, " chunk"], found: Vec3) -> Vec3:
        return chosen.put(found, places, jax.vmap(ratio)(jnp.minimum(places, count - 1)))

    ratios = jnp.stack(chosen.over(chunk, (none, none, none)), axis=-1).reshape(nx, ny, nz, 3)
    ratios = _spread(ratios, seen.reshape(nx, ny, nz))
    highest = jnp.maximum(ratios.max((0, 1, 2)), 1e-6)
    steps = jnp.round(ratios.reshape(-1, 3) / highest[None] * LEVELS).astype(jnp.uint32)
    words = steps[:, 0] | steps[:, 1] << 10 | steps[:, 2] << 20
    return BakedLighting(words, highest, (nx, ny, nz))


def _spread(ratios: Float[Array, "nx ny nz 3"], seen: Bool[Array, "nx ny nz"]) -> Float[Array, "nx ny nz 3"]:
    """Each node beside some that are known gets their mean."""
    known = seen.astype(ratios.dtype)[..., None]
    for _ in range(GROWN):
        total, count = _around(ratios * known), _around(known)
        ratios = jnp.where(known > 0, ratios, total / jnp.maximum(count, 1))
        known = (count > 0).astype(ratios.dtype)
    return ratios


def _around(values: Float[Array, "nx ny nz c"]) -> Float[Array, "nx ny nz c"]:
    """The sum over each node and its 26 neighbours."""
    for axis in range(3):
        padded = jnp.pad(values, [(1, 1) if i == axis else (0, 0) for i in range(4)])
        n = values.shape[axis]
        before, here, after = (jax.lax.slice_in_dim(padded, s, s + n, axis=axis) for s in range(3))
        values = before + here + after
    return values
