"""What does one ray see? The definition: one ray, one cell after the other.

Every combination of transforms means what this file says. There is no acceleration here. Front to
back, a cell of extinction σ, colour c and width w, behind opacity A, adds its weight:

    α = 1 - exp(-σ w)        C ← C + (1 - A) α c        A ← A + (1 - A) α

so that the weights of a ray and the transmittance T = 1 - A that is left sum to 1. It is A that is kept:
in float32, taking thousands of small equal weights from a T near 1 would round the same way each time.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .checks import is_traced
from .locate import Ray, enter
from .march import Cell, March
from .rendering import Rendering
from .transfer import Classify, Transfer
from .triple import Scalar, Triple, apart
from .volume import Volume


class Progress(eqx.Module):
    """How far a ray has come.

    The front of the next cell lies at `offset + index d`. Counting steps, rather than adding them up,
    keeps the ten-thousandth sample as exact as the first; `offset` holds what transforms add.
    """

    index: Int[Array, ""]
    offset: Scalar
    color: Triple
    opacity: Scalar
    moment: Scalar
    """Σ weight × depth past the entry."""
    samples: Int[Array, ""]
    aligned: Bool[Array, ""]
    finished: Bool[Array, ""]
    memory: tuple[Any, ...]


def begin(march: March, ray: Ray) -> Progress:
    """A ray at its entry."""
    zero, no = jnp.zeros_like(ray.length), jnp.zeros(ray.length.shape, bool)
    count = jnp.zeros(ray.length.shape, jnp.int32)
    return Progress(
        index=count,
        offset=march.start(ray) * march.step,
        color=(zero, zero, zero),
        opacity=zero,
        moment=zero,
        samples=count,
        aligned=no,
        finished=no,
        memory=march.remember(ray),
    )


def step(march: March, ray: Ray, volume: Volume, classify: Classify, at: Progress) -> Progress:
    """Sample one cell, blend it, and move on. Changes nothing once the ray is finished."""
    front = at.offset + at.index.astype(ray.length.dtype) * march.step
    cell = Cell(front, march.step, jnp.zeros_like(at.finished))
    (r, g, b), opacity, moment = at.color, at.opacity, at.moment
    samples, aligned = at.samples, at.aligned
    inside, transparent = jnp.zeros_like(at.finished), jnp.ones_like(at.finished)

    for piece in march.cut(cell, ray, volume):
        depth = march.sample(piece)
        live = ~at.finished & (depth < ray.length)
        coordinate = ray.path(depth)
        (red, green, blue), extinction = classify(coordinate)
        extinction = jnp.where(live & ray.path.contains(coordinate), extinction, 0)
        weight = (1 - opacity) * -jnp.expm1(-extinction * piece.width)  # expm1: thin cells keep their digits
        r, g, b = r + weight * red, g + weight * green, b + weight * blue
        opacity, moment = opacity + weight, moment + weight * depth
        samples, inside = samples + live.astype(samples.dtype), inside | live
        transparent &= extinction == 0
        aligned |= piece.cut & (extinction > 0)

    steps, memory = march.advance(at.memory, ray, transparent)
    return Progress(
        index=at.index + 1,
        offset=at.offset + (steps - 1) * march.step,
        color=(r, g, b),
        opacity=opacity,
        moment=moment,
        samples=samples,
        aligned=aligned,
        finished=at.finished | ~inside | march.stop(1 - opacity),
        memory=memory,
    )


def end(ray: Ray, at: Progress) -> Rendering:
    """What the ray has seen."""
    seen = at.opacity > 0
    depth = ray.t_in + at.moment / jnp.where(seen, at.opacity, 1)
    return Rendering(
        rgba=jnp.stack([*at.color, at.opacity]),
        depth=jnp.where(seen, depth, jnp.inf),
        samples=at.samples,
        aligned=at.aligned,
        exhausted=~at.finished,
    )


def render_ray_reference(
    volume: Volume,
    transfer: Transfer,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    march: March,
    *,
    pixel: tuple[Any, Any] = (0, 0),
) -> Rendering:
    """What one ray sees, by a plain scan over its cells.

    It runs in the float type of `origin` and `direction`, and is differentiable forwards and
    backwards, any number of times. Memory for a backward pass grows with the number of samples.

    **Arguments:**

    - `origin`, `direction`: world point and unit direction of the ray.
    - `pixel`: (column, row), on which everything random depends.

    **Returns:** a `Rendering` of a single pixel: `rgba` has shape (4,), all else ().

    **Raises:** `ValueError` where the march or the spacing is traced and `march.max_samples` is not given:
    the length of the scan cannot be known.
    """
    column, row = pixel
    pixel = jnp.asarray(column, jnp.int32), jnp.asarray(row, jnp.int32)
    ray = enter(march.locate(volume), apart(origin), apart(direction), pixel)
    classify = transfer.over(volume)

    def one(at: Progress, _: None) -> tuple[Progress, None]:
        return step(march, ray, volume, classify, at), None

    at, _ = jax.lax.scan(one, begin(march, ray), None, length=samples_across(volume, march))
    return end(ray, at)


def samples_across(volume: Volume, march: March) -> int:
    """Steps that suffice for any ray through the volume: its diagonal, and a few that transforms may add."""
    if is_traced(volume.spacing, march):
        if march.max_samples is not None:
            return march.max_samples
        raise ValueError(
            "March(max_samples=...) must be given where the march or volume.spacing is traced: "
            "the length of a scan must be known before the program is compiled."
        )
    with jax.ensure_compile_time_eval():
        diagonal = float(march.locate(volume).diagonal)
    # the first cell may begin a step early, one step finds the exit, one more is shortened by a jitter
    return min(int(np.ceil(diagonal / float(march.step))) + 4, march.most_samples)
