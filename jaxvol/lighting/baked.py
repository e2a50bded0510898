"""Baked lighting: the ratios of lit colours to colours, computed once on a grid of its own, then fetched."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._util.memory import require_room
from .._util.vec3 import Vec3
from ..scene.volume import Volume
from ..scene.voxel_fetch import corners
from ..xla.compaction import Chosen
from ..xla.memory import gather
from .shading import Sample, Shader, Shading, Surroundings


LEVELS = 2**10 - 1
"""Quantization steps from 0 to the highest ratio: 10 bits per colour channel."""

DARKEST = 1 / 64
"""Colours are clamped to at least this before dividing by them, since ratios would be unbounded otherwise."""

DILATION = 2
"""Nodes by which the ratios are extended around the visible nodes, since samples lie between nodes."""

BYTES_PER_NODE = 96
"""Memory per node while its light is computed."""


class BakedLighting(Shading):
    """Lighting computed in advance by `bake`, without a gradient.

    - `words`: the ratios of lit colour to colour, 10 bits for each of red, green and blue, at each node of a
      grid that spans the volume's grid.
    - `highest`: for each channel, the ratio that the largest 10-bit number stands for.
    """

    words: UInt32[Array, " nodes"]
    highest: Float[Array, "3"]
    shape: tuple[int, int, int] = eqx.field(static=True)

    def for_image(self, around: Surroundings) -> "BakedLighting":
        return jax.lax.stop_gradient(self)

    def begin(self, around: Surroundings, sample: Sample) -> Vec3:
        """Ratios at the sample, by trilinear interpolation."""
        coordinate = around.space.coordinate(sample.point)
        ends = zip(coordinate, self.shape, around.volume.shape, strict=True)
        x, y, z = (c * ((n - 1) / (whole - 1)) for c, n, whole in ends)
        r = g = b = jnp.zeros_like(x)
        for index, weight in corners((x, y, z), self.shape):
            # int32, since signed integers are converted to float in one instruction
            word = gather(self.words, index).astype(jnp.int32)
            r, g, b = (
                total + weight * (word >> shift & LEVELS).astype(x.dtype)
                for total, shift in zip((r, g, b), (0, 10, 20), strict=True)
            )
        red, green, blue = (c * high / LEVELS for c, high in zip((r, g, b), self.highest, strict=True))
        return red, green, blue

    def color(self, sample: Sample, shared: Vec3, sums: Any) -> Vec3:
        r, g, b = (c * ratio for c, ratio in zip(sample.color, shared, strict=True))
        return r, g, b


def nodes_for(volume: Volume, resolution: int) -> tuple[int, int, int]:
    """Shape of a grid with `resolution` nodes along the volume's longest side; `ValueError` if too large."""
    longest = max(volume.shape)
    nx, ny, nz = (max(2, round(resolution * n / longest)) for n in volume.shape)
    require_room(
        nx * ny * nz * BYTES_PER_NODE,
        f"a grid of {nx} x {ny} x {nz} nodes for baked={resolution}; use a coarser one",
    )
    return nx, ny, nz


def bake(shading: Shading, around: Surroundings, nodes: tuple[int, int, int]) -> BakedLighting:
    """Compute the light on a grid of nodes. NaN in any of its inputs makes all of it NaN."""
    shading, around = jax.lax.stop_gradient((shading, around))
    nx, ny, nz = nodes
    classification = around.classification

    def node(number: Int[Array, ""]) -> Sample:
        indices = jnp.unravel_index(number, (nx, ny, nz))
        x, y, z = (
            i.astype(around.volume.spacing.dtype) * ((n - 1) / (m - 1))
            for i, n, m in zip(indices, around.volume.shape, (nx, ny, nz), strict=True)
        )
        measured = classification.at((x, y, z))
        color, extinction = classification.classify(measured)
        zero, one = jnp.zeros_like(extinction), jnp.ones_like(extinction)
        column = row = jnp.zeros((), jnp.int32)
        point = around.space.point((x, y, z))
        return Sample(point, (zero, zero, zero), measured, color, extinction, one, (column, row))

    def ratios_of(numbers: Int[Array, " chunk"]) -> Vec3:
        samples = jax.vmap(node)(numbers)
        r, g, b = (
            lit_color / jnp.maximum(color, DARKEST)
            for lit_color, color in zip(Shader(shading, around)(samples), samples.color, strict=True)
        )
        return r, g, b

    count = nx * ny * nz
    visible = jax.lax.map(lambda i: node(i).extinction != 0, jnp.arange(count), batch_size=min(count, 2**14))
    chosen = Chosen.of([visible.reshape(1, -1)])
    zeros = jnp.zeros(count, around.volume.spacing.dtype)

    def chunk(indices: Int[Array, " chunk"], channels: Vec3) -> Vec3:
        return chosen.put(channels, indices, ratios_of(jnp.minimum(indices, count - 1)))

    ratios = jnp.stack(chosen.fold(chunk, (zeros, zeros, zeros)), axis=-1).reshape(nx, ny, nz, 3)
    ratios = _dilate(ratios, visible.reshape(nx, ny, nz))
    # XLA's maximum of a large array skips NaN on CPUs
    known = ~jnp.isnan(ratios).any((0, 1, 2))
    highest = jnp.where(known, jnp.maximum(ratios.max((0, 1, 2)), 1e-6), jnp.nan)
    steps = jnp.round(ratios.reshape(-1, 3) / highest[None] * LEVELS).astype(jnp.uint32)
    words = steps[:, 0] | steps[:, 1] << 10 | steps[:, 2] << 20
    return BakedLighting(words, highest, (nx, ny, nz))


def _dilate(
    ratios: Float[Array, "nx ny nz 3"], visible: Bool[Array, "nx ny nz"]
) -> Float[Array, "nx ny nz 3"]:
    """Give each node that borders known ones the mean of their ratios."""
    known = visible.astype(ratios.dtype)[..., None]
    for _ in range(DILATION):
        total, count = _sum_neighbors(ratios * known), _sum_neighbors(known)
        ratios = jnp.where(known > 0, ratios, total / jnp.maximum(count, 1))
        known = (count > 0).astype(ratios.dtype)
    return ratios


def _sum_neighbors(values: Float[Array, "nx ny nz c"]) -> Float[Array, "nx ny nz c"]:
    """Sum over each node and its 26 neighbours."""
    for axis in range(3):
        padded = jnp.pad(values, [(1, 1) if i == axis else (0, 0) for i in range(4)])
        n = values.shape[axis]
        before, here, after = (jax.lax.slice_in_dim(padded, s, s + n, axis=axis) for s in range(3))
        values = before + here + after
    return values
