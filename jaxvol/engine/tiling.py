"""How is work divided for this machine? All constants of the fast engine, in one place."""

import math
from typing import NamedTuple

import jax
from jax.sharding import Mesh

from .._util.compaction import CHUNK


class Tiling(NamedTuple):
    """Sizes by which rays and samples are processed. None of them shows in an image; gradients are summed in
    another order, and the number of samples between two leaps differs.

    - `cells`: cells of a segment, whose samples are all fetched before any is composited.
    - `group`: rays compacted as one unit, a square number.
    - `batch`: groups marched at a time, as many as fit into the cache.
    - `min_alive`: share of a batch's groups that must be alive for it to go on; below it, batches are
      refilled.
    - `tile`: beams that are marched to their ends before the next ones are made: 262 144 rays.
    - `direct_tile`: the same where JAX differentiates the march itself, and so keeps all its states.
    - `searched`: groups whose entries and exits are searched at a time, where a search is needed. It takes as
      many steps as the slowest ray among them.
    - `chunk`: samples shaded at a time, a multiple of 128.
    - `devices`: to which beams are dealt out, a mesh of one axis; None where JAX decides.
    """

    cells: int = 8
    group: int = 16
    # Not 512: rows of 8192 floats would lie 32 KiB apart, so that all of them map to the same cache lines.
    batch: int = 520
    min_alive: float = 0.75
    tile: int = 4096
    direct_tile: int = 64
    searched: int = 16
    chunk: int = CHUNK
    devices: Mesh | None = None

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
    def of_backend(cls, devices: Mesh | None = None) -> "Tiling":
        """The sizes for these devices, or JAX's default backend."""
        platform = jax.default_backend() if devices is None else devices.devices.flat[0].platform
        return BY_BACKEND.get(platform, BY_BACKEND["cpu"])._replace(devices=devices)


BY_BACKEND = {"cpu": Tiling()}
"""Sizes that were measured. Other backends take those of the CPU."""
