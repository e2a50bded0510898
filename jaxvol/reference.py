"""What does one ray see? The definition: one ray, one cell after the other.

Every combination of transforms means what this file says. There is no acceleration here. A cell of extinction
σ and width w has the opacity α = 1 - exp(-σ w); how cells become a pixel is `compositing`'s.
"""

import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._util.checks import Arrayable, all_finite, finite_array, is_traced
from ._util.sharding import varying
from ._util.vec3 import Scalar, Vec3, along, apart
from .compositing import Over
from .lighting.deferred import Deferred, Line, lit_once
from .lighting.shading import Lighting, Sample, classification
from .march import Cell, March
from .rendering import AbstractPicture, DepthPicture, Found, Picture, Rendering
from .scene import check_scene
from .space import Ray, enter, invalid
from .transfer import Classification, Measured, Transfer
from .volume import Volume, without_voxels


class Progress(eqx.Module):
    """How far a ray has come.

    The front of the next cell lies at `(offset + index) d`. Counting steps, rather than adding them up,
    keeps the ten-thousandth sample as exact as the first; `offset` holds what transforms add, in steps.
    `seen` is what the cells so far have come to. `shift`, in steps, is added to `offset` behind the first
    transparent cell, and is 0 from then on. What is not asked for is None.
    """

    index: Int[Array, ""]
    offset: Scalar
    seen: Over
    met: "Met | None"
    finished: Bool[Array, ""]
    shift: Scalar | None


class Met(eqx.Module):
    """What a ray has met."""

    samples: Int[Array, ""]
    aligned: Bool[Array, ""]


def has_fault(volume: Volume, transfer: Transfer, march: March, lighting: Lighting | None) -> Bool[Array, ""]:
    """Whether a number on which all pixels depend is NaN or infinite, or the step leads nowhere. A comparison
    with NaN is false, and turns it into nothing seen: a fit that has diverged would look like one that has
    converged. Of rays and voxels it is found out ray by ray."""
    return ~(all_finite((without_voxels(volume), transfer, march, lighting)) & (march.step > 0))


def begin(march: March, ray: Ray, outputs: Found | None = "all") -> Progress:
    """A ray at its entry, which will find out so much, or nothing but its opacity."""
    zero, no = jnp.zeros_like(ray.length), jnp.zeros(ray.length.shape, bool)
    count = jnp.zeros(ray.length.shape, jnp.int32)
    return Progress(
        index=count,
        offset=march.start(ray),
        seen=Over.begin(zero, color=outputs is not None, moment=outputs in ("all", "depth")),
        met=Met(count, no) if outputs == "all" else None,
        finished=no,
        shift=march.shift(ray) if march.may_shift else None,
    )


def pieces(march: March, ray: Ray, volume: Volume, front: Scalar) -> tuple[Cell, ...]:
    """The pieces of the cell that begins at depth `front`."""
    return march.cut(Cell(front, march.step, jnp.zeros(front.shape, bool)), ray, volume)


def measure(march: March, ray: Ray, seen: Classification, piece: Cell) -> Measured:
    """What is read from the volume at the piece's sample, and what the transfer function finds of it."""
    return seen.searched(seen.measure(ray.path(march.sample(piece))))


def contained(ray: Ray, depth: Scalar) -> Bool[Array, ""]:
    """Whether the volume is at this depth: neither past the exit nor in a gap."""
    inside = depth < ray.length
    return inside & ray.path.contains(ray.path(depth)) if ray.path.gaps else inside


def opacity(march: March, ray: Ray, seen: Classification, piece: Cell, measured: Measured) -> Scalar:
    """Opacity of a piece; 0 past the exit, and in gaps."""
    _, extinction = seen.classify(measured)
    optical_depth = jnp.where(contained(ray, march.sample(piece)), extinction, 0) * piece.width
    # 1 - exp(-τ), and thin cells keep their digits, as under expm1, which takes half as much time again
    t = jnp.tanh(optical_depth / 2)
    return 2 * t / (1 + t)


def color(
    march: March, ray: Ray, seen: Classification, piece: Cell, measured: Measured, transmittance: Scalar
) -> Vec3:
    """Colour of a piece, of which so much reaches the camera; as lit, where there is a light."""
    color, extinction = seen.classify(measured)
    if seen.light is None:
        return color
    point = along(ray.entry, ray.direction, march.sample(piece))
    return seen.light(Sample(point, ray.direction, measured, color, extinction, transmittance, ray.pixel))


def counts(march: March, ray: Ray, piece: Cell) -> Bool[Array, ""]:
    """Whether a piece is one of a ray's samples. Of a whole cell some pieces have width 0."""
    return (march.sample(piece) < ray.length) & (piece.width > 0)


def blend(
    march: March,
    ray: Ray,
    at: Progress,
    cell: tuple[tuple[Cell, Vec3, Scalar], ...],
) -> Progress:
    """What has been accumulated behind a cell. Of its pieces are known colour and opacity."""
    seen, met = at.seen, at.met
    for piece, own, alpha in cell:
        weight = jnp.where(at.finished, 0, seen.weight(alpha))
        seen = seen.add(weight, own, march.sample(piece))
        if met is not None:
            taken = ~at.finished & counts(march, ray, piece)
            met = Met(
                met.samples + taken.astype(met.samples.dtype),
                met.aligned | (piece.cut & (weight > 0)),
            )
    return replace(at, seen=seen, met=met, finished=at.finished | march.stop(seen.transmittance))


def move(
    march: March, ray: Ray, at: Progress, transparent: Bool[Array, ""] | None, cells: Any = 1
) -> Progress:
    """On over this many cells, of which the last one, or all, may have been transparent; None for a ray
    without a shift ahead. The ray is finished where the next one begins past the exit."""
    at = replace(at, index=at.index + cells)
    if at.shift is not None and transparent is not None:
        shift = jnp.where(transparent, at.shift, 0)
        at = replace(at, offset=at.offset + shift, shift=jnp.where(transparent, 0, at.shift))
    return replace(at, finished=at.finished | (front(march, at) >= ray.length))


def front(march: March, at: Progress, ahead: Any = 0) -> Scalar:
    """Depth at which the next cell begins, or one so many cells ahead."""
    return (at.offset + (at.index + ahead).astype(at.offset.dtype)) * march.step


def step(march: March, ray: Ray, volume: Volume, seen: Classification, at: Progress) -> Progress:
    """Sample one cell, blend it, and move on. Changes nothing once the ray is finished."""
    cut = pieces(march, ray, volume, front(march, at))
    measured = [measure(march, ray, seen, piece) for piece in cut]
    alphas = [opacity(march, ray, seen, piece, read) for piece, read in zip(cut, measured, strict=True)]
    transparent = jnp.all(jnp.stack(alphas) == 0, axis=0)
    before, colors = at.seen, []
    for piece, read, alpha in zip(cut, measured, alphas, strict=True):
        colors.append(color(march, ray, seen, piece, read, before.transmittance))
        before = before.add(before.weight(alpha))
    after = blend(march, ray, at, tuple(zip(cut, colors, alphas, strict=True)))
    return move(march, ray, after, transparent)


def end(ray: Ray, at: Progress) -> AbstractPicture:
    """What the ray has seen: with its depth, and with what it met, if it was to find that out."""
    valid = ~jnp.isnan(ray.t_in)
    # by a product, since the derivative of a choice would be 0
    rgba = at.seen.rgba() * jnp.where(valid, 1, jnp.nan).astype(ray.length.dtype)
    exhausted = ~at.finished
    if at.seen.moment is None:
        return Picture(rgba, exhausted)
    mean = at.seen.mean_depth()
    depth = jnp.where(valid & jnp.isinf(mean), jnp.inf, ray.t_in + mean)
    if at.met is None:
        return DepthPicture(rgba, exhausted, depth)
    return Rendering(rgba, exhausted, depth, at.met.samples, at.met.aligned)


def render_ray_reference(
    volume: Volume | Any,
    transfer: Transfer | Any,
    origin: Arrayable,
    direction: Arrayable,
    march: March | Any,
    *,
    pixel: tuple[Any, Any] = (0, 0),
    lighting: Lighting | Any | None = None,
) -> Rendering:
    """What one ray sees, by a plain scan over its cells.

    It runs in the float type of `origin` and `direction`, and is differentiable forwards and
    backwards, any number of times. Memory for a backward pass grows with the number of samples.

    **Arguments:**

    - `origin`, `direction`: world point and unit direction of the ray.
    - `pixel`: (column, row), on which everything random depends.
    - `lighting`: how samples are lit.

    **Returns:** a `Rendering` of a single pixel: `rgba` has shape (4,), all else ().

    **Raises:** `ValueError` where the march or the spacing is traced and `march.max_samples` is not given:
    the length of the scan cannot be known.
    """
    order = "render_ray_reference(volume, transfer, origin, direction, march)"
    check_scene(order, volume=volume, transfer=transfer, march=march, lighting=lighting)
    origin, direction = _vector("origin", origin), _vector("direction", direction)
    column, row = pixel
    pixel = jnp.asarray(column, jnp.int32), jnp.asarray(row, jnp.int32)
    space = march.locate(volume)
    line = Line(apart(origin), apart(direction), pixel)
    ray = invalid(enter(space, *line), has_fault(volume, transfer, march, lighting))
    lit = classification(volume, transfer, space, lighting)
    seen = transfer.over(volume) if isinstance(lighting, Deferred) else lit

    def one(at: Progress, _: None) -> tuple[Progress, None]:
        return step(march, ray, volume, seen, at), None

    at, _ = jax.lax.scan(one, varying(begin(march, ray), ray), None, length=steps_across(volume, march))
    rendering = end(ray, at)
    assert isinstance(rendering, Rendering)
    if isinstance(lighting, Deferred):
        rgba = lit_once(lit, space, line, rendering.rgba, rendering.depth)
        rendering = replace(rendering, rgba=rgba)
    return rendering


def _vector(name: str, value: Arrayable) -> Float[Array, "3"]:
    """An array of floats keeps its type; all else is made JAX's default one."""
    floats = hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jnp.floating)
    if floats and value.shape == (3,):
        return jnp.asarray(value)
    return finite_array(name, value, (3,))


def steps_across(volume: Volume, march: March) -> int:
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
        steps = diagonal / float(march.step) if march.step > 0 else math.nan
    if not math.isfinite(steps):  # then nothing is marched, and NaN is seen
        return 1
    # the first cell may begin a step early, one step finds the exit, one more is shortened by a jitter
    return min(math.ceil(steps) + 4, march.most_samples)
