"""How is work divided for this machine? All constants of the fast engine, in one place."""

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
launch. (Two CPU cores, the engine: images of 64², 128² and 256² pixels take 0.67, 0.68 and 0.89 of the time
that batches of 520 take; 512² pixels would take 1.28 times as long in batches of 72.)"""


class Tiling(NamedTuple):
    """Sizes by which rays and samples are processed. They change no image, only the order in which gradients
    are summed, and `Rendering.samples` where rays leap.

    Attributes:
        cells: cells of a segment, whose samples are all fetched before any is composited.
        group: rays compacted as one unit, a square number.
        batch: groups marched at a time, as many as fit into the cache; where `turns` is 0, no more than a
            sixteenth of a tile's, or LEAST_BATCH (`batch_of`).
        min_alive: share of a batch's groups that must be alive for it to go on; below it, batches are
            refilled.
        turns: if not 0, the segments by which a batch is marched before it is refilled, in place of
            `min_alive`: a number that is known when the program is compiled.
        tile: beams that are marched to their ends before the next ones are made: 262 144 rays.
        direct_tile: the same where JAX differentiates the march itself, and so keeps all its states.
        searched: groups whose entries and exits are searched at a time, where a search is needed. It takes
            as many steps as the slowest ray among them.
        chunk: samples shaded at a time, a multiple of 128. If 0, all of a segment, the invisible ones too.
        least: beams of a tile at least, so that a few rays are marched by the program of an image.
        squares: whether given rays are those of squares of a camera's pixels, beam by beam.
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
        """Groups of so many that are marched at a time. Of few, a part only: an image that is one batch goes
        on with all its lanes to the end of its longest rays, since only others could fill their places."""
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
        """The sizes for programs that are traced now: `GPU` where they are for one, the defaults, which were
        measured on CPUs, elsewhere."""
        return GPU if on_gpu() else Tiling()


class RenderOptions(eqx.Module):
    """What is computed, how it is differentiated, and how work is divided.

    Attributes:
        steps: of each ray's scan, for `"direct"`.
    """

    outputs: Outputs = eqx.field(static=True)
    tiling: Tiling = eqx.field(static=True)
    adjoint: Adjoint = eqx.field(static=True, default="replay")
    steps: int | None = eqx.field(static=True, default=None)


GPU = Tiling(cells=16, batch=2**12, turns=8, tile=2**14, searched=2**16, chunk=0)
"""For GPUs, where the host waits for the device at each branch, and at each turn of a loop of unknown length
(see `platform`). So one loop of unknown length is left, each turn of which makes up one batch of the groups
that are alive, and marches it by `turns` segments; and a batch of 65 536 rays has a million samples in
flight. A tile is an image of up to 1024 × 1024 pixels.

Chosen on an H200: the head phantom of 512³ voxels, 1024 × 1024 pixels, steps of half a voxel, with leaps and
early termination. An image with the gradient of its transfer function took 9.3 ms; in segments of 8 cells
11.0 ms, and in these by batches of 2¹³ groups and 16 turns 14.3 ms. (Of the lanes of a batch of 2¹² groups,
41 % take samples of this image, of one of 2¹³ 24 %.) In the view of `experiments/scenes.py`, the host waits
13 times. Loops of unknown length remain in shading with many terms (`ScattererTemplates`), in each segment.
"""
