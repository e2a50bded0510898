"""Takes the next few cells of many rays at once.

A *segment* is `Tiling.cells` cells of a ray. All its samples are fetched before any is composited, because
XLA repeats a fetch for every use that it fuses it into, unless the fetched values lie in memory; and only the
results of a branch do. So measuring is one `lax.cond`, the transfer function's search another, and the
opacities a third. (Measured on CPU.)
"""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from .._util.vec3 import Scalar
from .._util.xla import in_memory
from ..march import Cell, March
from ..reference import Progress, blend, front, move, opacity, pieces
from ..space import Ray
from ..transfer import Classification, Measured
from ..volume import Volume
from .shading import shaded_colors
from .tiling import Tiling


class Samples(NamedTuple):
    """The next cells of many rays, as lists with one entry for each piece of a cell; each entry is an array
    (cells, rays). Cells that a ray does not take are placed beyond its exit."""

    cells: list[Cell]
    measured: list[Measured]
    opacity: list[Scalar]


class SampleVisitor(ABC):
    """Looks at all samples of a march.

    - `given`, `kept`, `sums`: for each ray, (groups, rays in a group): constants, state carried from segment
      to segment, and sums, which begin at 0.
    - `total`: sums over all rays.
    """

    given: PyTree
    kept: PyTree
    sums: PyTree
    total: PyTree

    @abstractmethod
    def visit(
        self, ray: Ray, at: Progress, samples: Samples, given: PyTree, kept: PyTree, total: PyTree
    ) -> tuple[PyTree, PyTree, PyTree]:
        """The state behind the samples of some rays, what these add to the rays' sums, and the new total."""


def vmap_cells(f: Any, of_cells: tuple[bool, ...] = (True,)) -> Any:
    """Maps a function of one ray over arrays (rays,) and, where `of_cells`, (cells, rays)."""
    return jax.vmap(jax.vmap(f), in_axes=tuple(0 if each else None for each in of_cells))


def regular_from_here(at: Progress) -> Bool[Array, "*rays"]:
    """Which rays have no shift ahead of them, and advance by whole steps from here on."""
    return jnp.ones(at.finished.shape, bool) if at.shift is None else at.shift == 0


def march_segment(
    march: March,
    volume: Volume,
    seen: Classification,
    tiling: Tiling,
    ray: Ray,
    at: Progress,
    *,
    regular: bool,
) -> tuple[Progress, Samples]:
    """Marches rays by a segment, or to where they are finished or shifted off the cells that were sampled.
    `regular`: no ray has a shift ahead of it, so that each takes all the cells."""
    ahead = jnp.arange(tiling.cells, dtype=at.index.dtype)
    samples = _sampled(march, volume, seen, ahead, ray, at)
    taken = shifted = None
    if not regular:
        taken, shifted = _taken(march, at, ahead, samples.opacity)
        samples = _without(samples, ahead[:, None] < taken[None], ray)
    if seen.light is None:
        colors = [vmap_cells(seen.classify)(read)[0] for read in samples.measured]
    else:
        colors = shaded_colors(seen, march, tiling.chunk, ray, at, *samples)
    blended = jax.vmap(lambda ray, at, cell: blend(march, ray, at, cell))
    cells = tuple(zip(samples.cells, colors, samples.opacity, strict=True))
    # unrolled, so that nothing between two cells is put in memory
    after, _ = jax.lax.scan(lambda at, cell: (blended(ray, at, cell), None), at, cells, unroll=tiling.cells)
    if taken is None:
        after = jax.vmap(lambda ray, at: move(march, ray, at, None, tiling.cells))(ray, after)
    else:
        after = jax.vmap(lambda ray, at, *how: move(march, ray, at, *how))(ray, after, shifted, taken)
    return after, samples


def _sampled(
    march: March, volume: Volume, seen: Classification, ahead: Int[Array, " cells"], ray: Ray, at: Progress
) -> Samples:
    """The samples of these cells ahead of each ray."""

    def pieces_of(at: Progress) -> tuple[Cell, ...]:
        def one(ray: Ray, at: Progress, k: Int[Array, ""]) -> tuple[Cell, ...]:
            return pieces(march, ray, volume, front(march, at, k))

        return jax.vmap(jax.vmap(one, in_axes=(0, 0, None)), in_axes=(None, None, 0))(ray, at, ahead)

    cut = pieces_of(at)
    divided = len(cut) > 1
    # Dividing a cell is expensive, so that its pieces are stored. An undivided cell costs less to recompute
    # than to load.
    given = cut if divided else None

    def cells(at: Progress, given: Any) -> tuple[Cell, ...]:
        return given if divided else pieces_of(at)

    def measured(at: Progress, given: Any) -> list[Measured]:
        each = vmap_cells(lambda ray, piece: seen.measure(ray.path(march.sample(piece))), (False, True))
        return [each(ray, piece) for piece in cells(at, given)]

    def opacities(at: Progress, given: Any, values: list[Measured]) -> list[Scalar]:
        each = vmap_cells(
            lambda ray, piece, read: opacity(march, ray, seen, piece, read), (False, True, True)
        )
        return [each(ray, piece, read) for piece, read in zip(cells(at, given), values, strict=True)]

    # Always true, but opaque to XLA, so that the branches survive. An index grows by at most one segment's
    # cells a segment, finished or not, and there are no more segments in a pass than `march.most_samples`,
    # at most 2**24: it never overflows. Whether any ray is alive would take 1 % of a frame to find out.
    live = at.index[0] >= 0
    values = in_memory(live, measured, at, given)
    if seen.search is not None:
        found = in_memory(live, lambda values: [vmap_cells(seen.search)(v) for v in values], values)
        values = [(*read, *more) for read, more in zip(values, found, strict=True)]
    alphas = in_memory(live, opacities, at, given, values)
    return Samples(list(cells(at, given)), values, alphas)


def _taken(
    march: March, at: Progress, ahead: Int[Array, " cells"], alphas: list[Scalar]
) -> tuple[Int[Array, " rays"], Bool[Array, " rays"]]:
    """How many of a segment's cells each ray takes, and whether the last of them shifts it. A ray with a
    shift ahead goes no farther than its next transparent cell, behind which its samples lie elsewhere."""
    left, cells = march.most_samples - at.index, ahead.size
    transparent = jnp.all(jnp.stack(alphas) == 0, axis=0)
    # a minimum, since XLA computes argmax by comparing pairs
    first = jnp.min(jnp.where(transparent, ahead[:, None] + 1, cells + 1), axis=0)
    shifted = ~regular_from_here(at) & (first <= jnp.minimum(left, cells))
    return jnp.minimum(jnp.where(shifted, first, cells), left), shifted


def _without(samples: Samples, takes: Bool[Array, "cells rays"], ray: Ray) -> Samples:
    """The samples, with cells that are not taken made transparent and put beyond the exit."""
    cells = [
        eqx.tree_at(lambda cell: cell.front, cell, jnp.where(takes, cell.front, ray.length[None]))
        for cell in samples.cells
    ]
    return Samples(cells, samples.measured, [jnp.where(takes, alpha, 0) for alpha in samples.opacity])
