"""Where do rays begin, and where do they shift? Both are known before they are marched.

A shift (`Transform.shift`) moves all cells behind a ray's first transparent one. Most rays begin in such a
cell. The cells of all others are looked at in order, some rays at a time, before any is composited.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..compositing.blending import Outputs, Over, Weighting
from ..march.march import March
from ..ray import NEVER, Progress, Scene, begin, is_sample, measure, move, opacity, pieces, track_of
from ..scene.space import Ray
from ..xla.compaction import Chosen
from ..xla.memory import in_memory
from ..xla.sharding import varying
from ..xla.trees import with_fields
from .rays import vmap_rays
from .tiling import Tiling


CELLS = 8
"""Cells of a ray that are looked at before it is asked whether one of them is transparent."""


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
        march: as given.
        scene: prepared, with the march's `rules`.
        rays: of shape (groups, rays in a group).
        outputs: without them, nothing but the opacity is computed.
        shifted: where the rays shift, if that is known.
        finds_shifts: whether to find it out, otherwise.
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
    return behind_first_cells(scene, rays, at)


def find_shifts(scene: Scene, rays: Ray, at: Progress, tiling: Tiling) -> Progress:
    """Rays at their entries, of which is then known where they shift."""
    return eqx.tree_at(lambda at: at.track.shifted, at, _shifted(scene, rays, at, tiling))


def behind_first_cells(scene: Scene, rays: Ray, at: Progress) -> Progress:
    """Rays, behind their first cells where they shift there, if that saves a segment."""
    if scene.march.integrates and isinstance(scene.compositing, Weighting):
        return vmap_rays(partial(_behind_first_cell, scene))(rays, at)
    return at


def _behind_first_cell(scene: Scene, ray: Ray, at: Progress) -> Progress:
    """A ray, behind its first cell if it shifts there: a segment of cells that are integrated would end there
    (`segment`). Not for a `Selection`, to which transparent cells may matter."""
    moves = (at.track.shifted == 1) & ~at.finished
    moved = move(scene.march, ray, at, None, 1)
    if moved.stats is not None:
        cut = pieces(scene, ray, at)
        count = [is_sample(scene.march, ray, piece, divided=len(cut) > 1) for piece in cut]
        samples = moved.stats.samples + jnp.sum(jnp.stack(count)).astype(jnp.int32)
        moved = eqx.tree_at(lambda moved: moved.stats.samples, moved, samples)
    return jax.tree.map(lambda a, b: jnp.where(moves, a, b), moved, at)


def _shifted(scene: Scene, rays: Ray, at: Progress, tiling: Tiling) -> Int[Array, "groups rays"]:
    """For each ray, the cell behind its first transparent one; NEVER if it meets none before its end."""
    clear = vmap_rays(lambda ray, at: _opacity(scene, ray, at, 0) == 0)(rays, at)
    shape = clear.shape
    found = jnp.where(clear, jnp.int32(1), jnp.int32(NEVER))
    chosen = Chosen.of([~clear & ~at.finished], tiling.chunk)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (rays, at))

    def search(indices: Int[Array, " chunk"], found: Int[Array, " rays"]) -> Int[Array, " rays"]:
        rays, at = jax.tree.map(lambda leaf: leaf.at[indices].get(mode="clip"), flat)
        return found.at[indices].set(_search(scene, rays, at), mode="drop")

    return chosen.fold(search, varying(found.reshape(-1), rays)).reshape(shape)


def _search(scene: Scene, rays: Ray, at: Progress) -> Int[Array, " rays"]:
    """As `_shifted`, of a few rays."""
    rules: Any = scene.march
    over = isinstance(scene.compositing, Over)

    def look(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        index, found, left = state
        each = jnp.arange(CELLS, dtype=index.dtype)

        def opacities(index: Array) -> Array:
            rays_of = jax.vmap(partial(_opacity, scene), in_axes=(0, 0, None))
            return jax.vmap(rays_of, in_axes=(None, None, 0))(rays, with_fields(at, index=index), each)

        alpha = in_memory(index[0] >= 0, opacities, index)
        first = jnp.min(jnp.where(alpha == 0, each[:, None], jnp.int32(CELLS)), axis=0)
        found = jnp.where((found == NEVER) & (first < CELLS), index + first + 1, found)
        # what lies behind the end of an opaque ray does not show
        left = left * jnp.prod(1 - alpha, axis=0) if over else left
        return index + CELLS, found, left

    def going(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        index, found, left = state
        front = jax.vmap(lambda track, index: track.front(index, rules.step))(at.track, index)
        opaque = jax.vmap(rules.stop)(left) | (left <= 0)
        searched = (found == NEVER) & (front < rays.length) & (index < at.track.until)
        return jnp.any(searched & ~(opaque if over else jnp.zeros_like(opaque)))

    none = jnp.full_like(at.index, NEVER)
    state = varying((at.index, none, jnp.ones_like(rays.length)), rays)
    return jax.lax.while_loop(going, look, state)[1]


def _opacity(scene: Scene, ray: Ray, at: Progress, number: Any) -> Array:
    """The greatest opacity of a cell's pieces."""
    cut = pieces(scene, ray, at, number)
    alphas = [opacity(scene, ray, piece, measure(scene, ray, piece)) for piece in cut]
    return jnp.max(jnp.stack(alphas), axis=0)
