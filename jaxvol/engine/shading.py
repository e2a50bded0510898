"""Which samples are seen, and worth lighting? Few of those that are taken; they are put together and lit.

To light a sample costs many times as much as to take it. So those of a segment whose weight is positive
are gathered from all its rays, and lit so many at a time.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.compaction import Chosen
from .._util.vec3 import Scalar, Vec3, along
from ..lighting.shading import Sample
from ..march import Cell, March
from ..reference import Progress
from ..space import Ray
from ..transfer import Classification, Measured


class Weighed(NamedTuple):
    """What each of some samples, arrays (cells, rays), adds to its ray's opacity; the transmittance in front
    of it, and behind it; and whether the ray was finished before."""

    weight: list[Scalar]
    front: list[Scalar]
    behind: list[Scalar]
    finished: list[Bool[Array, "cells rays"]]


def weighed(march: March, at: Progress, alphas: list[Scalar]) -> Weighed:
    """The weights of cells that come after each other, from the opacity of each of their pieces."""
    seen, finished = at.seen, at.finished
    found: list[list[tuple[Array, ...]]] = [[] for _ in alphas]
    for k in range(alphas[0].shape[0]):
        for i, alpha in enumerate(alphas):
            weight, before = jnp.where(finished, 0, seen.weight(alpha[k])), seen.transmittance
            seen = seen.add(weight)
            found[i].append((weight, before, seen.transmittance, finished))
        finished |= jax.vmap(march.stop)(seen.transmittance)
    each = [[jnp.stack(parts) for parts in zip(*pieces, strict=True)] for pieces in found]
    return Weighed(*(list(parts) for parts in zip(*each, strict=True)))


def visible(known: Weighed) -> Chosen:
    """The samples that add anything."""
    return Chosen.of([weight > 0 for weight in known.weight])


def samples_of(
    chosen: Chosen,
    places: Int[Array, " chunk"],
    seen: Classification,
    march: March,
    ray: Ray,
    cells: list[Cell],
    measured: list[Measured],
    known: Weighed,
) -> Sample:
    """The samples at these places of a segment."""
    entry, direction, pixel = jax.tree.map(
        lambda leaf: leaf.at[places % chosen.columns].get(mode="clip"), (ray.entry, ray.direction, ray.pixel)
    )
    depths = [march.sample(cell) for cell in cells]
    depth, read, front = chosen.take(list(zip(depths, measured, known.front, strict=True)), places)
    color, extinction = jax.vmap(seen.classify)(read)
    return Sample(along(entry, direction, depth), direction, read, color, extinction, front, pixel)


def shaded_colors(
    seen: Classification,
    march: March,
    ray: Ray,
    at: Progress,
    cells: list[Cell],
    measured: list[Measured],
    alphas: list[Scalar],
) -> list[Vec3]:
    """Colours of a segment's samples as lit; 0 for those that are not seen."""
    known, light = weighed(march, at, alphas), seen.light
    chosen = visible(known)
    assert light is not None

    def one(places: Int[Array, " chunk"], colors: Vec3) -> Vec3:
        samples = samples_of(chosen, places, seen, march, ray, cells, measured, known)
        return chosen.put(colors, places, jax.vmap(light)(samples))

    none = jnp.zeros(sum(alpha.size for alpha in alphas), alphas[0].dtype)
    return chosen.apart(chosen.over(one, (none, none, none)), len(alphas))
