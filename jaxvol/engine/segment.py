"""Marches many rays by one segment of cells.

A *segment* is `Tiling.cells` cells of a ray. All its samples are fetched before any is composited: XLA fuses
a fetch into each of its uses, and so repeats it, unless the fetched values are the result of a branch. So
measuring is one `lax.cond`, the transfer function's search another, and the opacities a third. (Measured on
CPU.)
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._util.vec3 import Scalar
from ..compositing.blending import Weighting
from ..compositing.selection import Selection
from ..march.march import Cell, CellRules, March
from ..ray import Progress, Scene, Track, add, move, opacity, pieces, read, reweigh, stop, stopped
from ..scene.several import Together
from ..scene.space import Ray
from ..scene.transfer import Classification, Measured
from ..xla.memory import in_memory
from ..xla.trees import PyTree, unchecked, with_fields
from .merging import Part, join, merged, merges
from .rays import vmap_cells
from .shading import inline_shader, light_terms, lit_colors, shaded_colors
from .tiling import Tiling


class Samples(NamedTuple):
    """The next cells of many rays: lists with one entry per piece of a cell, of arrays (cells, rays). Cells
    that a ray does not take are transparent, past its `Ray.end`. `light`: the terms of inline shading."""

    cells: list[Cell]
    measured: list[Measured]
    opacity: list[Scalar]
    light: list[PyTree] | None = None
    ray: Any = None
    """The rays, up to the last cell that they take."""

    @property
    def number(self) -> int:
        """Number of cells of each ray."""
        return self.opacity[0].shape[0]


class SampleVisitor(ABC):
    """Visitor of all samples of a march.

    Attributes:
        constants, carry, sums: for each ray, (groups, rays in a group): constants, state carried from segment
            to segment, and sums, which start at 0.
        total: sums over all rays.
    """

    constants: PyTree
    carry: PyTree
    sums: PyTree
    total: PyTree

    @abstractmethod
    def visit(
        self, ray: Ray, at: Progress, samples: Samples, constants: PyTree, carry: PyTree, total: PyTree
    ) -> tuple[PyTree, PyTree, PyTree]:
        """The new carry of these rays, the terms to add to their sums, and the new total."""


class Ahead(eqx.Module):
    """The cells ahead of many rays, up to the one behind which they shift.

    Attributes:
        rays: the rays, with the `reach` of all their cells.
        index: index of the next cell.
        offset: offset of these cells, as in `Track`.
        reach: `Ray.reach`, the end of the last cell that is taken.
        until: index of the first cell that is not taken.
    """

    rays: Ray
    index: Int[Array, " rays"]
    offset: Float[Array, " rays"]
    reach: Float[Array, " rays"]
    until: Int[Array, " rays"]

    @classmethod
    def of(cls, rays: Ray, at: Progress, march: March | CellRules) -> "Ahead":
        """The cells ahead of rays with progress `at`."""
        track = at.track
        offset, until = track.offset, track.until
        if track.shift is not None and track.shifted is not None:
            before = at.index < track.shifted
            offset = offset + jnp.where(before, 0, track.shift)
            until = jnp.where(before, jnp.minimum(until, track.shifted), until)
        back = (offset + until.astype(offset.dtype)) * march.step
        if march.grows:
            back = jax.vmap(march.depth)(back, rays)
        reach = jnp.where(at.finished, 0, jnp.minimum(back, rays.length))
        return cls(rays, at.index, offset, reach, until)

    @property
    def place(self) -> "tuple[Ray, Place]":
        """The rays, up to the last cell that they take, and the place of their next cell."""
        ray = self.rays
        return with_fields(ray, reach=self.reach), Place(
            self.index, unchecked(Track, offset=self.offset, shift=None, shifted=None, until=self.until)
        )


class Place(eqx.Module):
    """Place of the next cells of rays: the fields of a `Progress` that `pieces` reads."""

    index: Int[Array, "*rays"]
    track: Track


def march_segment(
    scene: Scene, tiling: Tiling, rays: Ray, at: Progress, *, shifts: bool = False, visited: bool = False
) -> tuple[Progress, Samples]:
    """Marches rays by a segment of cells: by fewer where a ray has fewer left, by none where it is finished.
    `shifts`: a segment is one cell, behind which rays may shift. `visited`: all pieces are returned."""
    classification, number = scene.classification, tiling.cells
    ahead, rules = Ahead.of(rays, at, scene.march), cast(Any, scene.march)
    merging = not visited and merges(scene, tiling.chunk)
    undivided = scene._replace(march=replace(rules, divide=None)) if merging else scene
    samples = _sampled(undivided, number, ahead)
    ray, _ = ahead.place
    colors: Any
    values = [measured[:1] for measured in samples.measured]
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
    cells: Any = tuple(zip(samples.cells, values, colors, samples.opacity, strict=True))
    if merging:
        cells = merged(scene, opaque_true(at), ray, at, *cells[0])
        samples = samples._replace(opacity=[cells.composite.opacity])
    # Except for custom transforms, `finished` follows from the composite. So it is not carried from cell to
    # cell: XLA would compute the cells one after the other.
    follows = isinstance(scene.compositing, Weighting) and not rules.custom

    def composite(ray: Ray, at: Progress, cell: PyTree, number: Int[Array, ""]) -> Progress:
        if follows:
            at = with_fields(at, finished=stopped(scene, at.composite))
        if isinstance(cell, Part):
            return join(scene, at, cell)
        for piece in cell:
            at = add(scene, ray, at, *piece, divided=len(cell) > 1)
        at = reweigh(scene, ray, at, [piece[-1] for piece in cell], number)
        return at if follows else stop(scene, at)

    # unrolled, so that no intermediate between two cells is stored
    composite_all = jax.vmap(composite, in_axes=(0, 0, 0, None))
    numbered = cells, jnp.arange(number, dtype=at.index.dtype)
    after, _ = jax.lax.scan(
        lambda at, cell: (composite_all(ray, at, *cell), None), at, numbered, unroll=number
    )
    after = jax.vmap(partial(stop, scene))(with_fields(after, finished=at.finished) if follows else after)
    steps = jnp.where(at.finished, 0, jnp.clip(ahead.until - at.index, 0, number))
    # finished rays take no cell
    clear = jnp.all(jnp.stack(samples.opacity) == 0, axis=(0, 1)) & (steps > 0)
    transparent = clear if shifts else None
    return jax.vmap(partial(move, scene.march))(ray, after, transparent, steps), samples._replace(ray=ray)


def _sampled(scene: Scene, number: int, ahead: Ahead) -> Samples:
    """The samples of the next `number` cells of each ray."""
    march, classification = scene.march, scene.classification

    def pieces_of(ahead: Ahead) -> tuple[Cell, ...]:
        rays = jax.vmap(partial(pieces, scene), in_axes=(0, 0, None))
        numbers = jnp.arange(number, dtype=ahead.index.dtype)
        return jax.vmap(rays, in_axes=(None, None, 0))(*ahead.place, numbers)

    cut = pieces_of(ahead)
    divided = len(cut) > 1
    # Dividing a cell is expensive, so its pieces are stored. An undivided cell costs less to recompute than
    # to load.
    stored = cut if divided else None

    def cells(ahead: Ahead, stored: PyTree) -> tuple[Cell, ...]:
        return stored if divided else pieces_of(ahead)

    def measured(ahead: Ahead, stored: PyTree) -> list[Measured]:
        read_cells, (ray, _) = vmap_cells(partial(read, scene), (False, True)), ahead.place
        return [read_cells(ray, piece) for piece in cells(ahead, stored)]

    def opacities(ahead: Ahead, stored: PyTree, values: list[Measured]) -> list[Scalar]:
        opacity_of, (ray, _) = vmap_cells(partial(opacity, scene), (False, True, True)), ahead.place
        pairs = zip(cells(ahead, stored), values, strict=True)
        return [opacity_of(ray, piece, measured) for piece, measured in pairs]

    live = opaque_true(ahead)
    if march.integrates:
        values = _measured_over(scene, ahead, live, cells, stored)
    else:
        values = _searched(classification, live, in_memory(live, measured, ahead, stored))
    alphas = in_memory(live, opacities, ahead, stored, values)
    shader = inline_shader(scene)
    ray, _ = ahead.place
    light = None if shader is None else light_terms(shader, scene, live, ray, partial(cells, ahead, stored))
    return Samples(list(cells(ahead, stored)), values, alphas, light)


def opaque_true(at: PyTree) -> Bool[Array, ""]:
    """A true value that XLA cannot fold, so that branches survive."""
    # testing whether any ray is alive would take 1 % of a frame
    return at.index[0] >= 0


def _searched(classification: Classification, live: Bool[Array, ""], read: list[Measured]) -> list[Measured]:
    """Measured values, in memory, with the results of the transfer function's search."""
    if classification.search is None:
        return read
    search = vmap_cells(classification.search)
    results = in_memory(live, lambda read: [search(values) for values in read], read)
    return [(*values, *result) for values, result in zip(read, results, strict=True)]


def _colors(scene: Scene, at: Progress, measured: list[Measured]) -> list[Any]:
    """The colours of cells, as classified."""
    classify = vmap_cells(scene.classification.of_cells)

    def all_(measured: list[Measured]) -> list[Any]:
        return [classify(values)[0] for values in measured]

    # Means and look-ups would be computed again for each use if they were fused into compositing.
    stored = scene.classification.search is not None or isinstance(scene.transfer, Together)
    return in_memory(opaque_true(at), all_, measured) if stored or scene.march.integrates else all_(measured)


def _measured_over(
    scene: Scene, ahead: Ahead, live: Bool[Array, ""], cells: Callable[..., tuple[Cell, ...]], stored: PyTree
) -> list[Measured]:
    """Values measured over the pieces of cells; joined pieces share their ends."""
    march, classification = scene.march, scene.classification
    at = vmap_cells(lambda ray, depth: classification.measure(ray.path(depth))[:1], (False, True))
    sample_attributes = vmap_cells(
        lambda ray, piece: classification.attributes(ray.path(march.sample(piece))), (False, True)
    )
    ends_of = vmap_cells(lambda ray, piece: march.ends(piece, ray), (False, True))

    def measured(ahead: Ahead, stored: PyTree) -> list[Measured]:
        """Values at the ends of all pieces; of joined pieces, at the first front and at all backs."""
        ray, _ = ahead.place
        ends = [ends_of(ray, piece) for piece in cells(ahead, stored)]
        if not march.joins:
            return [at(ray, depth) for pair in ends for depth in pair]
        # the front of a cell is the back of the last piece of the cell before
        first = jnp.concatenate([ends[0][0][:1], ends[-1][1]])
        return [at(ray, first), *(at(ray, back) for _, back in ends[:-1])]

    def attributes_of(ahead: Ahead, stored: PyTree) -> list[Measured]:
        return [sample_attributes(ahead.place[0], piece) for piece in cells(ahead, stored)]

    attributes = in_memory(live, attributes_of, ahead, stored)
    read = _searched(classification, live, in_memory(live, measured, ahead, stored))
    if not march.joins:
        fronts, backs = read[::2], read[1::2]
    else:
        joints, *inner = read
        backs = [*inner, jax.tree.map(lambda leaf: leaf[1:], joints)]
        fronts = [jax.tree.map(lambda leaf: leaf[:-1], joints), *inner]
    return [classification.spanned(*parts) for parts in zip(attributes, fronts, backs, strict=True)]
