"""Baked lighting: the ratios of lit colours to colours, computed once on a grid of its own, then fetched."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from .._util.memory import require_room
from .._util.vec3 import Vec3
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

    Attributes:
        words: ratios of lit colour to colour, 10 bits for each of red, green and blue, at each node of a grid
            that spans the volume's grid.
        highest: for each channel, the ratio that the largest 10-bit number stands for.
        shape: of the grid.
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


def bake(shading: Shading, around: Surroundings, resolution: int) -> BakedLighting:
    """Compute the light on a grid with `resolution` nodes along the volume's longest side. NaN in any input
    makes all of it NaN. **Raises** `ValueError` for a grid that does not fit into memory."""
    longest = max(around.volume.shape)
    nx, ny, nz = (max(2, round(resolution * n / longest)) for n in around.volume.shape)
    require_room(
        nx * ny * nz * BYTES_PER_NODE,
        f"a grid of {nx} x {ny} x {nz} nodes for baked={resolution}; use a coarser one",
    )
    shading, around = jax.lax.stop_gradient((shading, around))
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

    count = nx * ny * nz
    visible = jax.lax.map(lambda i: node(i).extinction != 0, jnp.arange(count), batch_size=min(count, 2**14))
    chosen = Chosen.of([visible.reshape(1, -1)])
    zeros = jnp.zeros(count, around.volume.spacing.dtype)

    def chunk(indices: Int[Array, " chunk"], channels: Vec3) -> Vec3:
        samples = jax.vmap(node)(jnp.minimum(indices, count - 1))
        lit = Shader(shading, around)(samples)
        ratios = tuple(a / jnp.maximum(b, DARKEST) for a, b in zip(lit, samples.color, strict=True))
        return chosen.put(channels, indices, ratios)

    ratios = jnp.stack(chosen.fold(chunk, (zeros, zeros, zeros)), axis=-1).reshape(nx, ny, nz, 3)
    known = visible.astype(ratios.dtype).reshape(nx, ny, nz, 1)
    for _ in range(DILATION):  # each node that borders known ones gets the mean of their ratios
        total, number = sum_neighbors(ratios * known), sum_neighbors(known)
        ratios = jnp.where(known > 0, ratios, total / jnp.maximum(number, 1))
        known = (number > 0).astype(ratios.dtype)
    # XLA's maximum of a large array skips NaN on CPUs
    finite = ~jnp.isnan(ratios).any((0, 1, 2))
    highest = jnp.where(finite, jnp.maximum(ratios.max((0, 1, 2)), 1e-6), jnp.nan)
    steps = jnp.round(ratios.reshape(-1, 3) / highest[None] * LEVELS).astype(jnp.uint32)
    words = steps[:, 0] | steps[:, 1] << 10 | steps[:, 2] << 20
    return BakedLighting(words, highest, (nx, ny, nz))


def sum_neighbors(values: Float[Array, "nx ny nz c"]) -> Float[Array, "nx ny nz c"]:
    """Sum over each node and its 26 neighbours."""
    for window in ((3, 1, 1, 1), (1, 3, 1, 1), (1, 1, 3, 1)):
        values = jax.lax.reduce_window(values, 0.0, jax.lax.add, window, (1, 1, 1, 1), "SAME")
    return values
