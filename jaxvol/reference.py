"""What does one ray see? The definition: one ray, one cell after the other.

Every combination of transforms means what this file says. There is no acceleration here. Front to
back, a cell of extinction σ, colour c and width w, behind transmittance T, adds its weight:

    α = 1 - exp(-σ w)        C ← C + T α c        T ← T - T α

so that the weights of a ray and the transmittance that is left sum to 1.
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
from .transfer import Classify, TransferFunction
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
    transmittance: Scalar
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
        transmittance=jnp.ones_like(zero),
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
    (r, g, b), transmittance, moment = at.color, at.transmittance, at.moment
    samples, aligned = at.samples, at.aligned
    inside, transparent = jnp.zeros_like(at.finished), jnp.ones_like(at.finished)

    for piece in march.cut(cell, ray, volume):
        depth = march.sample(piece)
        live = ~at.finished & (depth < ray.length)
        (red, green, blue), extinction = classify(ray.path(depth))
        extinction = jnp.where(live, extinction, 0)
        weight = transmittance * -jnp.expm1(-extinction * piece.width)  # expm1: thin cells keep their digits
        r, g, b = r + weight * red, g + weight * green, b + weight * blue
        transmittance, moment = transmittance - weight, moment + weight * depth
        samples, inside = samples + live, inside | live
        transparent &= extinction == 0
        aligned |= piece.cut & (extinction > 0)

    steps, memory = march.advance(at.memory, ray, transparent)
    return Progress(
        index=at.index + 1,
        offset=at.offset + (steps - 1) * march.step,
        color=(r, g, b),
        transmittance=transmittance,
        moment=moment,
        samples=samples,
        aligned=aligned,
        finished=at.finished | ~inside | march.stop(transmittance),
        memory=memory,
    )


def end(ray: Ray, at: Progress) -> Rendering:
    """What the ray has seen."""
    opacity = 1 - at.transmittance
    seen = opacity > 0
    depth = ray.t_in + at.moment / jnp.where(seen, opacity, 1)
    return Rendering(
        rgba=jnp.stack([*at.color, opacity]),
        depth=jnp.where(seen, depth, jnp.inf),
        samples=at.samples,
        aligned=at.aligned,
        exhausted=~at.finished,
    )


def render_ray_reference(
    volume: Volume,
    transfer: TransferFunction,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    march: March,
    *,
    pixel: tuple[Any, Any] = (0, 0),
    max_samples: int | None = None,
) -> Rendering:
    """What one ray sees, by a plain scan over its cells.

    It runs in the float type of `origin` and `direction`, and is differentiable forwards and
    backwards, any number of times. Memory for a backward pass grows with the number of samples.

    **Arguments:**

    - `origin`, `direction`: world point and unit direction of the ray.
    - `pixel`: (column, row), on which everything random depends.
    - `max_samples`: length of the scan. The default suffices for every ray through the volume;
      it cannot be derived where the step or the spacing is traced, and must be given there.

    **Returns:** a `Rendering` of a single pixel: `rgba` has shape (4,), all else ().
    """
    column, row = pixel
    pixel = jnp.asarray(column, jnp.int32), jnp.asarray(row, jnp.int32)
    ray = enter(march.locate(volume), apart(origin), apart(direction), pixel)
    length = samples_across(volume, march) if max_samples is None else max_samples
    classify = transfer.over(volume)

    def one(at: Progress, _: None) -> tuple[Progress, None]:
        return step(march, ray, volume, classify, at), None

    at, _ = jax.lax.scan(one, begin(march, ray), None, length=length)
    return end(ray, at)


def samples_across(volume: Volume, march: March) -> int:
    """Steps that suffice for any ray through the volume: its diagonal, and a few that transforms may add."""
    if is_traced(volume.spacing, march.step):
        raise ValueError(
            "max_samples must be given where march.step or volume.spacing is traced: "
            "the length of a scan must be known before the program is compiled."
        )
    low, high = volume.corners
    diagonal = float(np.linalg.norm(np.asarray(high - low)))
    # the first cell may begin a step early, one step finds the exit, one more is shortened by a jitter
    return min(int(np.ceil(diagonal / float(march.step))) + 4, march.max_samples)
