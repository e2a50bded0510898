"""Merges the pieces of each cell to one part of its ray. Few cells are divided by faces of labels: these are
gathered in chunks, and only their pieces are sampled."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.vec3 import Color, Scalar
from ..compositing.blending import Composite, Over, joined
from ..march.march import Cell, CellRules
from ..ray import Progress, SampleStats, Scene, add, measure, opacity, transmittance
from ..scene.space import Ray
from ..scene.transfer import Measured
from ..xla.compaction import Chosen
from ..xla.memory import in_memory
from ..xla.sharding import varying
from ..xla.trees import with_fields
from .rays import vmap_cells


CHUNK = 1024
"""Divided cells that are sampled at a time."""

ROW = 32
"""Cells that are counted by one product."""


class Part(NamedTuple):
    """Contribution of a cell to its ray: composite and statistics of its pieces alone."""

    composite: Composite
    stats: SampleStats | None


def merges(scene: Scene, chunk: int) -> bool:
    """True if pieces can be merged, under "over" without light, and it is known where cells may be divided.
    `chunk`: `Tiling.chunk`."""
    rules, mode, fetch = scene.march, scene.compositing, scene.volume.fetch
    tests = isinstance(rules, CellRules) and rules.may_divide is not None and not rules.custom
    known = chunk > 0 and fetch.changes is not None
    return tests and known and type(mode) is Over and scene.classification.light is None


def merged(
    scene: Scene,
    live: Bool[Array, ""],
    ray: Ray,
    at: Progress,
    cell: Cell,
    measured: Measured,
    color: Color,
    alpha: Scalar,
) -> Part:
    """The parts of cells (cells, rays), from samples of undivided ones. `live`: as for `in_memory`."""
    rules, volume = scene.march, scene.volume
    assert isinstance(rules, CellRules)
    test, divide = rules.may_divide, rules.divide
    assert test is not None
    assert divide is not None

    def part(ray: Ray, *pieces: tuple[Cell, Measured, Color, Scalar]) -> Part:
        added = jax.tree.map(lambda leaf: jnp.zeros((), leaf.dtype), at)
        for piece in pieces:
            added = add(scene, ray, added, *piece, divided=True)
        return Part(added.composite, added.stats)

    # as many parts for all cells, since a loop of one length is faster
    count = jnp.max(vmap_cells(test.parts, (True, False))(cell, ray).astype(jnp.float32)).astype(jnp.int32)

    def tested(number: Int[Array, ""], divided: Bool[Array, "cells rays"]) -> Bool[Array, "cells rays"]:
        def one(cell: Cell, ray: Ray) -> Bool[Array, ""]:
            return test.part(cell, ray, volume, number, count)

        return divided | vmap_cells(one, (True, False))(cell, ray)

    start = varying(jnp.zeros(cell.front.shape, bool), cell)
    divided = jax.lax.fori_loop(0, count, tested, start)
    chosen = Chosen.of([divided & (cell.width > 0) & (cell.front < ray.end[None])], CHUNK, ROW)

    def pieces_of(cell: Cell, ray: Ray) -> tuple[Cell, ...]:
        return divide(cell, ray, volume)

    def sampled(indices: Int[Array, " chunk"], parts: Part) -> Part:
        column = indices % chosen.columns
        rays = jax.tree.map(lambda leaf: leaf.at[column].get(mode="clip"), ray)
        cells = chosen.take([cell], indices)
        pieces = in_memory(live, jax.vmap(pieces_of), cells, rays)
        of_pieces = jax.vmap(partial(measure, scene))
        values = in_memory(live, lambda: [of_pieces(rays, piece) for piece in pieces])

        def one(ray: Ray, pieces: tuple[Cell, ...], values: list[Measured]) -> Part:
            colors = (scene.classification.of_cells(measured)[0] for measured in values)
            alphas = (opacity(scene, ray, *pair) for pair in zip(pieces, values, strict=True))
            return part(ray, *zip(pieces, (value[:1] for value in values), colors, alphas, strict=True))

        return chosen.put(parts, indices, in_memory(live, jax.vmap(one), rays, pieces, values))

    undivided = vmap_cells(part, (False, True))(ray, (cell, measured[:1], color, alpha))
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1), undivided)
    return chosen.split(chosen.fold(sampled, flat), 1)[0]


def join(scene: Scene, at: Progress, part: Part) -> Progress:
    """Composites the next cell of a ray, unless it is finished."""
    composite, stats = jax.tree.map(lambda leaf: jnp.where(at.finished, jnp.zeros_like(leaf), leaf), part)
    if at.stats is not None:
        shows = stats.aligned & (transmittance(scene, at.composite) > 0)
        stats = SampleStats(at.stats.samples + stats.samples, at.stats.aligned | shows)
    return with_fields(at, composite=joined(at.composite, composite), stats=stats)
