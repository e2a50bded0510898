"""Takes the next few cells of many rays at once.

A *segment* is `Tiling.cells` cells of a ray. All its samples are fetched before any is composited, because
XLA repeats a fetch for every use that it fuses it into, unless the fetched values lie in memory; and only the
results of a branch do. So measuring is one `lax.cond`, the transfer function's search another, and the
opacities a third. (Measured on CPU.)
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar
from ..compositing.blending import Weighting
from ..compositing.selection import Selection
from ..march.march import Cell
from ..ray import Progress, Scene, Track, add, move, opacity, pieces, read, stop, stopped
from ..scene.several import Together
from ..scene.space import Ray
from ..scene.transfer import Classification, Measured
from ..xla.memory import in_memory
from ..xla.trees import PyTree, unchecked, with_fields
from .shading import inline_shader, light_terms, lit_colors, shaded_colors
from .tiling import Tiling


class Samples(NamedTuple):
    """The next cells of many rays: lists with one entry for each piece of a cell, of arrays (cells, rays).
    Cells that a ray does not take are transparent, and lie past its `Ray.end`. `light`: the terms of shading
    that is `inline`."""

    cells: list[Cell]
    measured: list[Measured]
    opacity: list[Scalar]
    light: list[PyTree] | None = None
    ray: Any = None
    """The rays, which end where they take no other cell."""

    @property
    def number(self) -> int:
        """Number of cells of each ray."""
        return self.opacity[0].shape[0]


class SampleVisitor(ABC):
    """Looks at all samples of a march.

    Attributes:
        given, carry, sums: for each ray, (groups, rays in a group): constants, state carried from segment to
            segment, and sums, which begin at 0.
        total: sums over all rays.
    """

    given: PyTree
    carry: PyTree
    sums: PyTree
    total: PyTree

    @abstractmethod
    def visit(
        self, ray: Ray, at: Progress, samples: Samples, given: PyTree, carry: PyTree, total: PyTree
    ) -> tuple[PyTree, PyTree, PyTree]:
        """The state after the samples of some rays, what these add to the rays' sums, and the new total."""


def vmap_cells(f: Any, of_cells: tuple[bool, ...] = (True,)) -> Any:
    """Maps a function over rays, and over cells for those arguments whose `of_cells` is true, which are
    arrays (cells, rays)."""
    return jax.vmap(jax.vmap(f), in_axes=tuple(0 if each else None for each in of_cells))


class Ahead(eqx.Module):
    """The cells ahead of many rays, up to the one behind which they shift.

    Attributes:
        rays: as they were given, with their own reach.
        index: of the next cell.
        offset: of these cells, as in `Track`.
        reach: `Ray.reach`, the end of the last cell that is taken.
        until: the first cell that is not.
    """

    rays: Ray
    index: Int[Array, " rays"]
    offset: Float[Array, " rays"]
    reach: Float[Array, " rays"]
    until: Int[Array, " rays"]

    @classmethod
    def of(cls, rays: Ray, at: Progress, step: Scalar) -> "Ahead":
        """The cells ahead of rays that are `at` these places."""
        track = at.track
        offset, until = track.offset, track.until
        if track.shift is not None and track.shifted is not None:
            before = at.index < track.shifted
            offset = offset + jnp.where(before, 0, track.shift)
            until = jnp.where(before, jnp.minimum(until, track.shifted), until)
        back = (offset + until.astype(offset.dtype)) * step
        reach = jnp.where(at.finished, 0, jnp.minimum(back, rays.length))
        return cls(rays, at.index, offset, reach, until)

    @property
    def place(self) -> "tuple[Ray, Place]":
        """The rays, which end where they take no other cell, and where their next cell lies."""
        ray = self.rays
        return with_fields(ray, reach=self.reach), Place(
            self.index, unchecked(Track, offset=self.offset, shift=None, shifted=None, until=self.until)
        )


class Place(eqx.Module):
    """Where the next cells of rays lie: what `pieces` reads of a `Progress`."""

    index: Int[Array, "*rays"]
    track: Track


def march_segment(
    scene: Scene, tiling: Tiling, rays: Ray, at: Progress, *, shifts: bool = False
) -> tuple[Progress, Samples]:
    """Marches rays by a segment of cells; by fewer, where a ray has no more of them, and by none where it is
    finished. `shifts`: a segment is one cell, behind which rays may shift."""
    classification, number = scene.classification, tiling.cells
    ahead = Ahead.of(rays, at, scene.march.step)
    samples = _sampled(scene, number, ahead)
    ray, _ = ahead.place
    colors: Any
    values = [read[:1] for read in samples.measured]
    if isinstance(scene.compositing, Selection):
        colors, values = [None] * len(samples.cells), samples.measured
    elif classification.light is None:
        colors = _colors(scene, at, samples.measured)
    elif (shader := inline_shader(scene)) is not None:
        assert samples.light is not None
        parts = samples.cells, _colors(scene, at, samples.measured), samples.light
        colors = lit_colors(shader, scene, ray, *parts)
    else:
        colors = shaded_colors(scene, tiling.chunk, ray, at, samples.cells, samples.measured, samples.opacity)
    cells = tuple(zip(samples.cells, values, colors, samples.opacity, strict=True))
    # Whether a ray is stopped follows from what it has passed, but of transforms of one's own. So it is not
    # carried from cell to cell, which XLA would then compute one after the other.
    rules: Any = scene.march
    follows = isinstance(scene.compositing, Weighting) and not rules.custom

    def composited(ray: Ray, at: Progress, cell: Any) -> Progress:
        if follows:
            at = with_fields(at, finished=stopped(scene, at.composite))
        for piece in cell:
            at = add(scene, ray, at, *piece, divided=len(cell) > 1)
        return at if follows else stop(scene, at)

    # unrolled, so that nothing between two cells is put in memory
    after, _ = jax.lax.scan(
        lambda at, cell: (jax.vmap(composited)(ray, at, cell), None), at, cells, unroll=number
    )
    after = jax.vmap(partial(stop, scene))(with_fields(after, finished=at.finished) if follows else after)
    steps = jnp.where(at.finished, 0, jnp.clip(ahead.until - at.index, 0, number))
    # of rays that move: others take no cell here
    clear = jnp.all(jnp.stack(samples.opacity) == 0, axis=(0, 1)) & (steps > 0)
    transparent = clear if shifts else None
    return jax.vmap(partial(move, scene.march))(ray, after, transparent, steps), samples._replace(ray=ray)


def _sampled(scene: Scene, number: int, ahead: Ahead) -> Samples:
    """The samples of so many cells ahead of each ray."""
    march, classification = scene.march, scene.classification

    def pieces_of(ahead: Ahead) -> tuple[Cell, ...]:
        rays = jax.vmap(partial(pieces, scene), in_axes=(0, 0, None))
        each = jnp.arange(number, dtype=ahead.index.dtype)
        return jax.vmap(rays, in_axes=(None, None, 0))(*ahead.place, each)

    cut = pieces_of(ahead)
    divided = len(cut) > 1
    # Dividing a cell is expensive, so that its pieces are stored. An undivided cell costs less to recompute
    # than to load.
    given = cut if divided else None

    def cells(ahead: Ahead, given: Any) -> tuple[Cell, ...]:
        return given if divided else pieces_of(ahead)

    def measured(ahead: Ahead, given: Any) -> list[Measured]:
        each, (ray, _) = vmap_cells(partial(read, scene), (False, True)), ahead.place
        return [each(ray, piece) for piece in cells(ahead, given)]

    def opacities(ahead: Ahead, given: Any, values: list[Measured]) -> list[Scalar]:
        each, (ray, _) = vmap_cells(partial(opacity, scene), (False, True, True)), ahead.place
        return [each(ray, piece, read) for piece, read in zip(cells(ahead, given), values, strict=True)]

    live = always(ahead)
    if march.integrates:
        values = _measured_over(scene, ahead, live, cells, given)
    else:
        values = _searched(classification, live, in_memory(live, measured, ahead, given))
    alphas = in_memory(live, opacities, ahead, given, values)
    shader = inline_shader(scene)
    ray, _ = ahead.place
    light = None if shader is None else light_terms(shader, scene, live, ray, partial(cells, ahead, given))
    return Samples(list(cells(ahead, given)), values, alphas, light)


def always(at: Any) -> Bool[Array, ""]:
    """Always true, but opaque to XLA, so that branches survive."""
    # whether any ray is alive would take 1 % of a frame to find out
    return at.index[0] >= 0


def _searched(classification: Classification, live: Bool[Array, ""], read: list[Measured]) -> list[Measured]:
    """What was measured, in memory, with what the transfer function's search finds for it."""
    if classification.search is None:
        return read
    search = vmap_cells(classification.search)
    found = in_memory(live, lambda read: [search(each) for each in read], read)
    return [(*each, *more) for each, more in zip(read, found, strict=True)]


def _colors(scene: Scene, at: Progress, measured: list[Measured]) -> list[Any]:
    """The colours of cells, as classified."""
    classify = vmap_cells(scene.classification.of_cells)

    def all_(measured: list[Measured]) -> list[Any]:
        return [classify(each)[0] for each in measured]

    # Means, and what is looked up, would be computed again for each use if they were fused into the
    # compositing of each cell.
    often = scene.classification.search is not None or isinstance(scene.transfer, Together)
    return in_memory(always(at), all_, measured) if often or scene.march.integrates else all_(measured)


def _measured_over(
    scene: Scene, ahead: Ahead, live: Bool[Array, ""], cells: Callable[..., tuple[Cell, ...]], given: Any
) -> list[Measured]:
    """What is measured over the pieces of cells, each end once where they are joined."""
    march, classification = scene.march, scene.classification
    at = vmap_cells(lambda ray, depth: classification.measure(ray.path(depth))[:1], (False, True))
    between = vmap_cells(
        lambda ray, piece: classification.attributes(ray.path(march.sample(piece))), (False, True)
    )
    ends_of = vmap_cells(lambda ray, piece: march.ends(piece, ray), (False, True))

    def measured(ahead: Ahead, given: Any) -> list[Measured]:
        """At the ends of all pieces; where they are joined, at the first front and at all backs."""
        ray, _ = ahead.place
        ends = [ends_of(ray, piece) for piece in cells(ahead, given)]
        if not march.joins:
            return [at(ray, depth) for pair in ends for depth in pair]
        # where a cell begins, the last piece of the one in front of it ends
        first = jnp.concatenate([ends[0][0][:1], ends[-1][1]])
        return [at(ray, first), *(at(ray, back) for _, back in ends[:-1])]

    def attributes_of(ahead: Ahead, given: Any) -> list[Measured]:
        return [between(ahead.place[0], piece) for piece in cells(ahead, given)]

    attributes = in_memory(live, attributes_of, ahead, given)
    read = _searched(classification, live, in_memory(live, measured, ahead, given))
    if not march.joins:
        fronts, backs = read[::2], read[1::2]
    else:
        joints, *inner = read
        backs = [*inner, jax.tree.map(lambda leaf: leaf[1:], joints)]
        fronts = [jax.tree.map(lambda leaf: leaf[:-1], joints), *inner]
    return [classification.spanned(*each) for each in zip(attributes, fronts, backs, strict=True)]
