"""Sizes by which the fast engine divides work, for CPUs and GPUs."""

import math
from typing import Literal, NamedTuple, TypeAlias

import equinox as eqx

from ..compositing.blending import Outputs
from ..xla.compaction import CHUNK
from ..xla.platform import on_gpu


Adjoint: TypeAlias = Literal["replay", "forward", "direct"]


GROUPS_OF_BEAM = 4
"""Groups of a beam, 2 x 2 of a camera's pixels."""

LEAST_BATCH = 72
"""Groups that are marched at a time in a small image: 1152 rays, whose kernels still take longer than their
launch. (Two CPU cores, the engine: relative to batches of 520, images of 64², 128² and 256² pixels take 0.67,
0.68 and 0.89 of the time, 512² pixels 1.28 times as long.)"""


class Tiling(NamedTuple):
    """Sizes by which rays and samples are processed. They change no image, only the order in which gradients
    are summed, and `Rendering.samples` where rays leap.

    Attributes:
        cells: cells of a segment, whose samples are all fetched before any is composited.
        group: rays compacted as one unit, a square number.
        batch: groups marched at a time, as many as fit into the cache; `batch_of` limits it in small images.
        min_alive: share of a batch's groups that must be alive; below it, batches are refilled.
        turns: if not 0, number of segments that a batch is marched before it is refilled, in place of
            `min_alive`: a constant of the compiled program.
        tile: beams that are marched to their ends before the next ones are made: 262 144 rays.
        direct_tile: `tile` where JAX differentiates the march itself, and so keeps all its states.
        searched: groups whose entries and exits are searched at a time, where a search is needed. The search
            takes as many steps as the slowest ray among them.
        chunk: samples shaded at a time, a multiple of 128. If 0, all of a segment, also invisible ones.
        least: minimum number of beams of a tile, so that a few rays are marched by the program of an image.
        squares: whether each beam of a `GivenRays` is a square of a camera's pixels.
    """

    cells: int = 8
    group: int = 16
    # Not 512: rows of 8192 floats would lie 32 KiB apart, so that all of them map to the same cache lines.
    batch: int = 520
    min_alive: float = 0.75
    turns: int = 0
    tile: int = 4096
    direct_tile: int = 64
    searched: int = 16
    chunk: int = CHUNK
    least: int = 0
    squares: bool = False

    def batch_of(self, groups: int) -> int:
        """Number of groups per batch, of `groups` in a tile. A small image is several batches: a single one
        could not be refilled, and would keep all its lanes until its longest ray ends."""
        part = groups if self.turns else max(groups // 16 + 8, LEAST_BATCH)
        return min(self.batch, groups, part)

    @property
    def side(self) -> int:
        """Pixels along the side of a group."""
        return math.isqrt(self.group)

    @property
    def beam(self) -> int:
        """Pixels along the side of a beam, which is 2 x 2 groups."""
        return 2 * self.side

    @property
    def rays_per_beam(self) -> int:
        """Number of rays of a beam."""
        return self.beam**2

    @classmethod
    def of_backend(cls) -> "Tiling":
        """The sizes for programs that are traced now: `GPU` on a GPU, else the defaults, measured on CPUs."""
        return GPU if on_gpu() else Tiling()


class RenderOptions(eqx.Module):
    """Options of a render: its outputs, the rule of its derivatives, and the division of work.

    Attributes:
        steps: number of steps of each ray's scan, for `adjoint="direct"`.
        samples: whether that scan leaps, and returns at most `steps` samples of each ray.
    """

    outputs: Outputs = eqx.field(static=True)
    tiling: Tiling = eqx.field(static=True)
    adjoint: Adjoint = eqx.field(static=True, default="replay")
    steps: int | None = eqx.field(static=True, default=None)
    samples: bool = eqx.field(static=True, default=False)


GPU = Tiling(cells=16, batch=2**12, turns=8, tile=2**14, searched=2**16, chunk=0)
"""For GPUs, where the host waits for the device at each branch, and at each turn of a loop of unknown length
(see `platform`). So one loop of unknown length remains: it gathers a batch of living groups and marches it by
`turns` segments; a batch of 65 536 rays has a million samples in flight. A tile is an image of up to
1024 × 1024 pixels.

Chosen on an H200: the head phantom of 512³ voxels, 1024 × 1024 pixels, steps of half a voxel, with leaps and
early termination. An image with the gradient of its transfer function took 9.3 ms; in segments of 8 cells
11.0 ms; in segments of 8 cells, batches of 2¹³ groups and 16 turns 14.3 ms. (In batches of 2¹² groups, 41 %
of the lanes take samples of this image; in batches of 2¹³, 24 %.) In the view of `experiments/scenes.py`, the
host waits 13 times. Shading with many terms (`ScattererTemplates`) has a loop of unknown length in each
segment.
"""
