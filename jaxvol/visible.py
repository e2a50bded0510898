"""Which samples are seen, and worth lighting? Few of those that are taken; they are put together and lit.

To light a sample costs many times as much as to take it. So those of a segment whose weight is positive
are gathered from all its rays, and lit so many at a time.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .lighting.seam import Sample
from .locate import Ray
from .march import Cell, March
from .reference import Progress
from .transfer import Classification, Measured
from .triple import Scalar, Triple, along


CHUNK = 2048
"""Samples that are lit at a time."""


class Weighed(NamedTuple):
    """What each of some samples, arrays (cells, rays), adds to its ray's opacity; the opacity in front of it,
    and behind it; and whether the ray was finished before."""

    weight: list[Scalar]
    front: list[Scalar]
    behind: list[Scalar]
    finished: list[Bool[Array, "cells rays"]]


def weighed(march: March, at: Progress, alphas: list[Scalar]) -> Weighed:
    """The weights of cells that come after each other, from the opacity of each of their pieces."""
    opacity, finished = at.opacity, at.finished
    found: list[list[tuple[Array, ...]]] = [[] for _ in alphas]
    for k in range(alphas[0].shape[0]):
        for i, alpha in enumerate(alphas):
            weight = jnp.where(finished, 0, (1 - opacity) * alpha[k])
            found[i].append((weight, opacity, opacity + weight, finished))
            opacity = opacity + weight
        finished |= jax.vmap(march.stop)(1 - opacity)
    each = [[jnp.stack(parts) for parts in zip(*pieces, strict=True)] for pieces in found]
    return Weighed(*(list(parts) for parts in zip(*each, strict=True)))


class Visible(NamedTuple):
    """The visible samples of a segment.

    - `place`: which ones, counted through cells and rays of all pieces; in front those that are visible.
    - `number`: how many are.
    - `rays`: how many rays the segment has.
    """

    place: Int[Array, " samples"]
    number: Int[Array, ""]
    rays: int

    @classmethod
    def of(cls, weights: list[Float[Array, "cells rays"]]) -> "Visible":
        visible = jnp.concatenate([weight > 0 for weight in weights])
        rays = visible.shape[1]
        missing = -visible.size % CHUNK
        place = jnp.nonzero(visible.reshape(-1), size=visible.size, fill_value=visible.size)[0]
        place = jnp.pad(place.astype(jnp.int32), (0, missing), constant_values=visible.size)
        return cls(place, jnp.sum(visible, dtype=jnp.int32), rays)

    def over(self, one: Callable[[Int[Array, " chunk"], PyTree], PyTree], start: PyTree) -> PyTree:
        """`one(places, carry)` for the visible samples, a chunk after the other."""

        def chunk(state: tuple[Int[Array, ""], PyTree]) -> tuple[Int[Array, ""], PyTree]:
            i, carry = state
            return i + 1, one(jax.lax.dynamic_slice_in_dim(self.place, i * CHUNK, CHUNK), carry)

        begin = jnp.zeros((), jnp.int32), start
        return jax.lax.while_loop(lambda state: state[0] * CHUNK < self.number, chunk, begin)[1]

    def take(self, pieces: list[PyTree], places: Int[Array, " chunk"]) -> PyTree:
        """Those at these places, of arrays (cells, rays) for each piece."""

        def taken(*leaves: Array) -> Array:
            return jnp.concatenate(leaves).reshape(-1).at[places].get(mode="clip")

        return jax.tree.map(taken, *pieces)

    def put(self, whole: PyTree, places: Int[Array, " chunk"], part: PyTree) -> PyTree:
        """These in their places."""
        return jax.tree.map(lambda leaf, new: leaf.at[places].set(new, mode="drop"), whole, part)

    def apart(self, whole: PyTree, pieces: int) -> list[PyTree]:
        """Arrays (cells, rays) for each piece, from those of all."""
        leaves, tree = jax.tree.flatten(whole)
        each = (leaf.reshape(pieces, -1, self.rays) for leaf in leaves)
        return [jax.tree.unflatten(tree, piece) for piece in zip(*each, strict=True)]

    def samples(
        self,
        seen: Classification,
        march: March,
        ray: Ray,
        cells: list[Cell],
        measured: list[Measured],
        known: Weighed,
        places: Int[Array, " chunk"],
    ) -> Sample:
        """Those at these places."""
        of_ray = places % self.rays
        entry, direction, pixel = jax.tree.map(
            lambda leaf: leaf.at[of_ray].get(mode="clip"), (ray.entry, ray.direction, ray.pixel)
        )
        depths = [march.sample(cell) for cell in cells]
        depth, read, front = self.take(list(zip(depths, measured, known.front, strict=True)), places)
        color, extinction = jax.vmap(seen.classify)(read)
        return Sample(along(entry, direction, depth), direction, read, color, extinction, 1 - front, pixel)


def lit_colors(
    seen: Classification,
    march: March,
    ray: Ray,
    at: Progress,
    cells: list[Cell],
    measured: list[Measured],
    alphas: list[Scalar],
) -> list[Triple]:
    """Colours of a segment's samples as lit; 0 for those that are not seen."""
    known, light = weighed(march, at, alphas), seen.light
    visible = Visible.of(known.weight)
    assert light is not None

    def one(places: Int[Array, " chunk"], colors: Triple) -> Triple:
        samples = visible.samples(seen, march, ray, cells, measured, known, places)
        return visible.put(colors, places, jax.vmap(light)(samples))

    none = jnp.zeros(sum(alpha.size for alpha in alphas), alphas[0].dtype)
    return visible.apart(visible.over(one, (none, none, none)), len(alphas))
