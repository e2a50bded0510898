"""Starts rays at their entries, and finds their shifts before they are marched.

A shift (`Transform.shift`) moves all cells behind a ray's first transparent one. Most rays begin in such a
cell. The cells of the others are tested in order, by chunks of rays, before any cell is composited.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..compositing.blending import Outputs, Over, Weighting
from ..march.march import March
from ..ray import NEVER, Progress, Scene, begin, front, is_sample, measure, opacity, pieces, track_of
from ..scene.space import Ray
from ..xla.compaction import Chosen
from ..xla.memory import in_memory
from ..xla.sharding import varying
from ..xla.trees import with_fields
from .rays import vmap_rays
from .tiling import Tiling


CELLS = 8
"""Number of cells of a ray that are tested for transparency at a time."""


def begin_rays(
    march: March,
    scene: Scene,
    rays: Ray,
    tiling: Tiling,
    outputs: Outputs | None,
    shifted: Int[Array, "groups rays"] | None = None,
    *,
    finds_shifts: bool = True,
) -> Progress:
    """Rays at their entries; those that miss the volume are finished.

    Args:
        march: the march.
        scene: the prepared scene, with the `rules` of the march.
        rays: rays of shape (groups, rays in a group).
        outputs: outputs besides the opacity; None: no colours either.
        shifted: the cell behind which each ray shifts, if known.
        finds_shifts: whether to search for the shifts if `shifted` is None.
    """
    track = vmap_rays(partial(track_of, march))(rays)
    at = vmap_rays(lambda ray, track: begin(scene, ray, track, outputs))(rays, track)
    at = with_fields(at, finished=rays.length <= 0)
    if track.shifted is None or not (finds_shifts or shifted is not None):
        return at
    if shifted is None:
        at = find_shifts(scene, rays, at, tiling)
    else:
        at = eqx.tree_at(lambda at: at.track.shifted, at, shifted)
    return skip_first_cells(scene, rays, at)


def find_shifts(scene: Scene, rays: Ray, at: Progress, tiling: Tiling) -> Progress:
    """Rays at their entries, with `Track.shifted`."""
    return eqx.tree_at(lambda at: at.track.shifted, at, _shifted(scene, rays, at, tiling))


def skip_first_cells(scene: Scene, rays: Ray, at: Progress) -> Progress:
    """Moves rays that shift behind their first cell to the second: a segment would end there (`segment`). Not
    for a `Selection`, which may use transparent cells."""
    if not isinstance(scene.compositing, Weighting):
        return at

    def advance(ray: Ray, at: Progress) -> Progress:
        cut = pieces(scene, ray, at)
        if len(cut) > 1:  # pieces that may not be samples
            return at
        moves = (at.track.shifted == 1) & ~at.finished & is_sample(scene.march, ray, *cut, divided=False)
        stats = at.stats
        if stats is not None:
            stats = with_fields(stats, samples=stats.samples + moves.astype(stats.samples.dtype))
        return with_fields(at, index=jnp.where(moves, 1, at.index), stats=stats)

    return vmap_rays(advance)(rays, at)


def _shifted(scene: Scene, rays: Ray, at: Progress, tiling: Tiling) -> Int[Array, "groups rays"]:
    """Index of the cell behind the first transparent cell of each ray; NEVER without one before its end."""
    clear = vmap_rays(lambda ray, at: _opacity(scene, ray, at, 0) == 0)(rays, at)
    shape = clear.shape
    shifted = jnp.where(clear, jnp.int32(1), jnp.int32(NEVER))
    chosen = Chosen.of([~clear & ~at.finished], tiling.chunk)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (rays, at))

    def search(indices: Int[Array, " chunk"], shifted: Int[Array, " rays"]) -> Int[Array, " rays"]:
        rays, at = jax.tree.map(lambda leaf: leaf.at[indices].get(mode="clip"), flat)
        return shifted.at[indices].set(_search(scene, rays, at), mode="drop")

    return chosen.fold(search, varying(shifted.reshape(-1), rays)).reshape(shape)


def _search(scene: Scene, rays: Ray, at: Progress) -> Int[Array, " rays"]:
    """Computes `_shifted` for a chunk of rays."""
    rules: Any = scene.march
    # with factors, a ray may need cells behind opaque ones
    over = isinstance(scene.compositing, Over) and not rules.reweights

    def test_cells(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        index, shifted, transmittance = state
        numbers = jnp.arange(CELLS, dtype=index.dtype)

        def opacities(index: Array) -> Array:
            rays_of = jax.vmap(partial(_opacity, scene), in_axes=(0, 0, None))
            return jax.vmap(rays_of, in_axes=(None, None, 0))(rays, with_fields(at, index=index), numbers)

        alpha = in_memory(index[0] >= 0, opacities, index)
        first = jnp.min(jnp.where(alpha == 0, numbers[:, None], jnp.int32(CELLS)), axis=0)
        shifted = jnp.where((shifted == NEVER) & (first < CELLS), index + first + 1, shifted)
        # cells behind an opaque one are not visible
        transmittance = transmittance * jnp.prod(1 - alpha, axis=0) if over else transmittance
        return index + CELLS, shifted, transmittance

    def searching(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        index, shifted, transmittance = state
        front_of = jax.vmap(lambda ray, at: front(rules, ray, at))
        depth = front_of(rays, with_fields(at, index=index))
        opaque = jax.vmap(rules.stop)(transmittance) | (transmittance <= 0)
        searched = (shifted == NEVER) & (depth < rays.length) & (index < at.track.until)
        return jnp.any(searched & ~(opaque if over else jnp.zeros_like(opaque)))

    none = jnp.full_like(at.index, NEVER)
    state = varying((at.index, none, jnp.ones_like(rays.length)), rays)
    return jax.lax.while_loop(searching, test_cells, state)[1]


def _opacity(scene: Scene, ray: Ray, at: Progress, number: Any) -> Array:
    """The greatest opacity of a cell's pieces."""
    cut = pieces(scene, ray, at, number)
    alphas = [opacity(scene, ray, piece, measure(scene, ray, piece)) for piece in cut]
    return jnp.max(jnp.stack(alphas), axis=0)
