"""What does one ray see? The definition: one ray, cell by cell.

This file defines what every combination of transforms means, by the step of one ray. The fast engine imports
parts of it, so that a fault in these shows in both: the independent check is `tests/oracle.py`. A cell of
extinction σ and width w has the opacity α = 1 - exp(-σ w); `compositing` says how cells become a pixel.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._util.checks import Arrayable, all_finite, check_answer, finite_array
from ._util.vec3 import Scalar, Vec3, apart
from .arguments import check_arguments
from .compositing.compositing import Compositing, Fragment, Outputs, Weighting
from .compositing.modes import Mode, compositing_of
from .compositing.selection import RaySampler, Selection
from .lighting.deferred import Deferred
from .lighting.shading import Lighting, lit_classification
from .march.march import Cell, March
from .scene.rendering import Details, Rendering
from .scene.space import Line, Ray, Space, enter, invalid, world_gradient
from .scene.transfer import Classification, Measured, Transfer, classification_of
from .scene.variation import Windows
from .scene.volume import Volume, without_voxels
from .xla.platform import is_traced
from .xla.sharding import varying
from .xla.trees import PyTree
from .xla.xla import in_memory


class Pipeline(NamedTuple):
    """What turns the rays of an image into pixels: how they step, through which volume; how its samples are
    measured, classified and shaded; how cells are composited."""

    march: March
    volume: Volume
    classification: Classification
    compositing: Compositing[Any]


class Progress(eqx.Module):
    """How far a ray has come.

    The front of the next cell lies at `(offset + index) d`. Counting steps rather than summing them keeps the
    ten-thousandth sample as exact as the first; `offset` holds what transforms add, in steps. `composite` is
    the compositing mode's state after all cells so far. `shift`, in steps, is added to `offset` after the
    first transparent cell, and is 0 from then on. `stride`: steps of each cell of the current run, which ends
    at a multiple of RUN of them, counted from `phase` steps before the ray's first cell. What is not asked
    for, or not needed, is None.
    """

    index: Int[Array, ""]
    offset: Scalar
    composite: PyTree
    stats: "SampleStats | None"
    finished: Bool[Array, ""]
    shift: Scalar | None
    stride: Int[Array, ""] | None = None
    phase: Int[Array, ""] | None = None


class SampleStats(eqx.Module):
    """What `Rendering.samples` and `Rendering.aligned` report, and the square of `Rendering.error`."""

    samples: Int[Array, ""]
    aligned: Bool[Array, ""]
    error: Scalar | None


def has_fault(volume: Volume, march: March, *others: Any) -> Bool[Array, ""]:
    """Whether a number on which all pixels depend is NaN or infinite, or the step is not positive.
    Comparisons with NaN are false and would make it invisible, so that a fit that diverged would look
    converged. Rays and voxels are checked ray by ray."""
    return ~(all_finite((without_voxels(volume), march, others)) & (march.step > 0))


def begin(pipeline: Pipeline, ray: Ray, outputs: Outputs | None = "all") -> Progress:
    """A ray at its entry. Without `outputs` nothing but its opacity is computed."""
    march, _, _, compositing = pipeline
    zero, no = jnp.zeros_like(ray.length), jnp.zeros(ray.length.shape, bool)
    count, strides = jnp.zeros(ray.length.shape, jnp.int32), march.strides_vary
    return Progress(
        index=count,
        offset=march.start(ray),
        composite=compositing.begin(zero, outputs),
        stats=SampleStats(count, no, zero if strides else None) if outputs == "all" else None,
        finished=no,
        shift=march.shift(ray) if march.may_shift else None,
        stride=count + 1 if strides else None,
        phase=march.phase(ray) if strides else None,
    )


def with_stride(
    pipeline: Pipeline, ray: Ray, at: Progress, steps: Int[Array, ""] | int = 0
) -> tuple[Progress, Int[Array, ""] | int]:
    """The ray, with the stride of the cells that begin so many steps ahead of it, up to which all is
    transparent; and the steps to where the first of them begins."""
    if at.stride is None:
        return at, steps
    transmittance = pipeline.compositing.transmittance(at.composite)
    ahead = pipeline.march.strides(ray, at.index, at.stride, at.index + steps, transmittance, at.phase)
    leaves = (steps > 0) & (front(pipeline.march, at, steps) >= ray.length)  # all the way
    begin, stride = jnp.where(leaves, steps, ahead.begin - at.index), jnp.where(leaves, 1, ahead.stride)
    stats = at.stats
    if stats is not None:
        assert stats.error is not None
        ended = leaves | at.finished | (ray.length <= 0) | (at.index >= pipeline.march.most_samples)
        error = jnp.where(ended, 0, ahead.error)
        stats = replace(stats, error=stats.error + error**2)
    return replace(at, stride=stride, stats=stats), begin


def pieces(pipeline: Pipeline, ray: Ray, at: Progress, number: Int[Array, ""] | int = 0) -> tuple[Cell, ...]:
    """The pieces of the ray's next cell, or the one so many cells behind it in its run."""
    march, stride = pipeline.march, 1 if at.stride is None else at.stride
    width = jnp.asarray(stride, march.step.dtype) * march.step
    begin = front(march, at, number * stride)
    return march.cut(Cell(begin, width, jnp.zeros(begin.shape, bool)), ray, pipeline.volume)


def measure(pipeline: Pipeline, ray: Ray, piece: Cell, *, recorded: bool = False) -> Measured:
    """The measured values at a piece's sample, or over the piece where it is integrated, and what the
    transfer function's search finds for them. `recorded`: for the engine's `Recording`, which cannot record
    fetches inside branches."""
    march, classification = pipeline.march, pipeline.classification
    if not march.integrates:
        return classification.at(ray.path(march.sample(piece)))

    def measured(depth: Scalar) -> Measured:
        return classification.measure(ray.path(depth))[:1]

    # In branches of their own, which XLA does not fuse: where a kernel interpolates both values, one of them
    # may come out as that of the next node (jaxlib 0.10 on CPU with FMA; seen by
    # `test_render_agrees_with_the_reference`).
    ends = march.ends(piece, ray)
    front, back = (measured(s) if recorded else in_memory(march.step > 0, measured, s) for s in ends)
    beside = classification.beside(ray.path(march.sample(piece)))
    return classification.spanned(beside, *(classification.searched(end) for end in (front, back)))


def opacity(pipeline: Pipeline, ray: Ray, piece: Cell, measured: Measured) -> Scalar:
    """Opacity of a piece; 0 past the exit, and in gaps."""
    _, extinction = pipeline.classification.of_cells(measured)
    inside = ray.contains(pipeline.march.sample(piece))
    optical_depth = jnp.where(inside, extinction, 0) * piece.width
    # 1 - exp(-τ), exact for thin cells, as is expm1, which takes 1.5 times as long
    t = jnp.tanh(optical_depth / 2)
    return 2 * t / (1 + t)


def is_sample(march: March, ray: Ray, piece: Cell, *, alone: bool) -> Bool[Array, ""]:
    """Whether a piece counts as a sample. `alone`: cells are never divided; otherwise some pieces of those
    that are not have width 0."""
    before_exit = march.sample(piece) < ray.length
    # not where it is known: it would take 15 % of a frame whose last cells are cut
    return before_exit if alone else before_exit & (piece.width > 0)


def add(
    pipeline: Pipeline,
    ray: Ray,
    at: Progress,
    piece: Cell,
    measured: Measured,
    color: Vec3 | None,
    alpha: Scalar,
    *,
    alone: bool,
) -> Progress:
    """Composites a piece of the next cell. A ray that is finished sees no more. `measured`: of `Fragment`.
    `alone`: of `is_sample`."""
    march, _, _, compositing = pipeline
    depth, taken = march.sample(piece), ~at.finished & is_sample(march, ray, piece, alone=alone)
    alpha = jnp.where(at.finished, 0, alpha)
    fragment = Fragment(alpha, depth, piece, measured, color, taken & ray.contains(depth))
    stats = at.stats
    if stats is not None:
        shows = (alpha > 0) & (compositing.transmittance(at.composite) > 0)
        samples = stats.samples + taken.astype(stats.samples.dtype)
        stats = replace(stats, samples=samples, aligned=stats.aligned | (piece.cut & shows))
    composite = compositing.add(at.composite, fragment)
    check_answer(compositing, "add", composite, at.composite)
    return replace(at, composite=composite, stats=stats)


def stop(pipeline: Pipeline, at: Progress) -> Progress:
    """Finishes a ray that needs no other cell."""
    return replace(at, finished=at.finished | stopped(pipeline, at.composite))


def stopped(pipeline: Pipeline, composite: Any) -> Bool[Array, ""]:
    """Whether a ray in this state of compositing needs no other cell."""
    march, _, _, compositing = pipeline
    stops, finished = march.stop(compositing.transmittance(composite)), compositing.finished(composite)
    check_answer(compositing, "finished", finished, stops)
    return stops | finished


def move(march: March, ray: Ray, at: Progress, transparent: Bool[Array, ""] | None, steps: Any) -> Progress:
    """Moves on by this many steps. `transparent`: whether the last cell, or all of them, are, so that the ray
    shifts; None where no shift is ahead. The ray is finished if the next cell begins past the exit."""
    at = replace(at, index=at.index + steps)
    if at.shift is not None and transparent is not None:
        shift = jnp.where(transparent, at.shift, 0)
        at = replace(at, offset=at.offset + shift, shift=jnp.where(transparent, 0, at.shift))
    return replace(at, finished=at.finished | (front(march, at) >= ray.length))


def front(march: March, at: Progress, ahead: Any = 0) -> Scalar:
    """Depth at which the next cell begins, or the one so many steps ahead of it."""
    return (at.offset + (at.index + ahead).astype(at.offset.dtype)) * march.step


def step(pipeline: Pipeline, ray: Ray, at: Progress) -> Progress:
    """Samples one cell, composites it, and moves on."""
    march, _, classification, compositing = pipeline
    at, _ = with_stride(pipeline, ray, at)
    stride, sampler = 1 if at.stride is None else at.stride, RaySampler(ray, classification)
    after, alphas, color = at, [], None
    cut = pieces(pipeline, ray, at)
    for piece in cut:
        measured = measure(pipeline, ray, piece)
        alphas.append(opacity(pipeline, ray, piece, measured))
        if not isinstance(compositing, Selection):
            transmittance = compositing.transmittance(after.composite)
            classified = classification.of_cells(measured)
            color = sampler.color(march.sample(piece), measured, classified, transmittance)
        after = add(pipeline, ray, after, piece, measured, color, alphas[-1], alone=len(cut) == 1)
    transparent = jnp.all(jnp.stack(alphas) == 0, axis=0)
    after = move(march, ray, stop(pipeline, after), transparent, stride)
    if at.stride is None:  # a scan has as many steps as a ray may take
        return after
    return jax.tree.map(lambda a, b: jnp.where(at.index < march.most_samples, a, b), after, at)


def end(pipeline: Pipeline, ray: Ray, at: Progress) -> Rendering:
    """The rendering of a ray, with the outputs that it was begun with. Modes that resolve leave the pixel to
    `resolve`."""
    valid, details = ~jnp.isnan(ray.t_in), Details()
    rgba, depth = pipeline.compositing.end(at.composite)
    # a product, since the derivative of a `where` would be 0
    rgba = rgba * jnp.where(valid, 1, jnp.nan).astype(ray.length.dtype)
    if depth is not None:
        details = Details(jnp.where(valid & jnp.isinf(depth), jnp.inf, ray.t_in + depth))
    if at.stats is not None:
        details = details._replace(samples=at.stats.samples, aligned=at.stats.aligned)
        if at.stats.error is not None:
            details = details._replace(error=jnp.where(valid, jnp.sqrt(at.stats.error), jnp.nan))
    if isinstance(pipeline.compositing, Selection):
        details = details._replace(selected=at.composite)
    return Rendering(rgba, ~at.finished, details)


def resolves(compositing: Compositing[Any], lighting: Lighting | None) -> bool:
    """Whether pixels are computed after the march, by `resolve`. Rays are then marched without light."""
    return compositing.resolves or isinstance(lighting, Deferred)


class Pixel(NamedTuple):
    """What is computed after the march: premultiplied colour and opacity, the distance from the ray's origin,
    infinite where nothing is visible, and a unit normal, if the mode has one."""

    rgba: Float[Array, "4"]
    depth: Scalar
    normal: Float[Array, "3"] | None = None


def resolve(
    pipeline: Pipeline,
    lighting: Lighting | None,
    space: Space,
    line: Line,
    rgba: Float[Array, "4"],
    depth: Scalar,
    selected: PyTree,
) -> Pixel:
    """The pixel of a ray that is not transparent, from what its march found: by the compositing mode, or else
    by the lighting."""
    compositing = pipeline.compositing
    if isinstance(compositing, Selection):
        return _selected(compositing, pipeline, space, line, rgba, selected)
    if compositing.resolves:
        assert isinstance(compositing, Weighting)
        found = compositing.resolved(pipeline.classification, rgba)
        check_answer(compositing, "resolved", found, rgba)
        return Pixel(found, depth)
    assert isinstance(lighting, Deferred)
    return Pixel(lighting.shade_pixel(pipeline.classification, space, line, rgba, depth), depth)


def _selected(
    compositing: Selection[Any],
    pipeline: Pipeline,
    space: Space,
    line: Line,
    rgba: Float[Array, "4"],
    state: PyTree,
) -> Pixel:
    ray, (march, volume, classification, _) = enter(space, *line), pipeline
    # 1, with a derivative: the selected depths are numbers of steps, and so grow with the step
    scale = march.step / jax.lax.stop_gradient(march.step)
    sampler = RaySampler(ray, classification, scale, partial(world_gradient, volume, space))
    found = compositing.pixel(sampler, jax.lax.stop_gradient(state))
    check_answer(compositing, "pixel", found, (rgba, rgba[3]))
    pixel, depth = found
    normal = compositing.normal(sampler, depth)
    if normal is not None:
        check_answer(compositing, "normal", normal, rgba[:3])
    valid = jnp.where(jnp.isnan(rgba[3]), jnp.nan, 1).astype(pixel.dtype)
    # a product with infinity would have the derivative NaN
    seen = ~jnp.isinf(depth)
    depth = jnp.where(seen, ray.t_in + jnp.where(seen, depth, 0) * scale, jnp.inf)
    return Pixel(pixel * valid, depth, None if normal is None else normal * valid)


def render_ray_reference(
    volume: Volume | Any,
    transfer: Transfer | Any,
    origin: Arrayable,
    direction: Arrayable,
    march: March | Any,
    *,
    pixel: tuple[Any, Any] = (0, 0),
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
) -> Rendering:
    """What one ray sees, by a plain scan over its cells.

    Computes in the float type of `origin` and `direction`. Differentiable in forward and reverse mode, any
    number of times; the memory of reverse mode grows with the number of samples.

    **Arguments:**

    - `volume`, `transfer`, `march`: what is there, how it looks, and where it is sampled.
    - `origin`, `direction`: world point and unit direction of the ray.
    - `pixel`: (column, row), which keys random numbers.
    - `compositing`: how cells become a pixel.
    - `lighting`: how samples are shaded.

    **Returns:** a `Rendering` of a single pixel: `rgba` has shape (4,), all else ().

    **Raises:** `ValueError` where the step, the spacing or a transform that bends space is traced, and
    `march.max_samples` is not given: the length of the scan cannot be known.
    """
    order = "render_ray_reference(volume, transfer, origin, direction, march)"
    check_arguments(order, volume=volume, transfer=transfer, march=march, lighting=lighting)
    mode = compositing_of(compositing)
    origin, direction = _vector("origin", origin), _vector("direction", direction)
    column, row = pixel
    pixel = jnp.asarray(column, jnp.int32), jnp.asarray(row, jnp.int32)
    march = march.divided()
    length, space = steps_across(volume, march), march.locate(volume)
    line = Line(apart(origin), apart(direction), pixel)
    ray = invalid(enter(space, *line), has_fault(volume, march, transfer, mode, lighting))
    lit = lit_classification(volume, transfer, space, lighting, integrated=march.integrates)
    pipeline = shown = Pipeline(march, volume, lit, mode)
    if later := resolves(mode, lighting):
        transfer, march = mode.marched(transfer, march, volume)
        unlit = classification_of(transfer, volume, integrated=march.integrates)
        pipeline = Pipeline(march, volume, unlit, mode)
    windows = Windows.of(volume) if march.looks_ahead else None
    pipeline = pipeline._replace(march=march.prepared(space, windows, partial(mode.variation, transfer)))

    def one(at: Progress, _: None) -> tuple[Progress, None]:
        return step(pipeline, ray, at), None

    start = varying(begin(pipeline, ray), ray)
    at, _ = jax.lax.scan(one, start, None, length=length)
    rendering = end(pipeline, ray, at)
    if not later:
        return rendering
    visible, details = rendering.rgba[3] != 0, rendering.details
    # a transparent ray has no depth at which anything could be computed
    given = jax.tree.map(
        lambda leaf: jnp.where(visible, leaf, jnp.zeros_like(leaf)), (rendering.depth, details.selected)
    )
    found = resolve(shown, lighting, space, line, rendering.rgba, *given)
    rgba, depth = jnp.where(visible, found.rgba, 0), jnp.where(visible, found.depth, jnp.inf)
    normal = None if found.normal is None else jnp.where(visible, found.normal, 0)
    return replace(rendering, rgba=rgba, details=details._replace(depth=depth, normal=normal, selected=None))


def _vector(name: str, value: Arrayable) -> Float[Array, "3"]:
    """A vector. Floats keep their type, all else becomes JAX's default float type."""
    floats = hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jnp.floating)
    if floats and value.shape == (3,):
        return jnp.asarray(value)
    return finite_array(name, value, (3,))


def steps_across(volume: Volume, march: March) -> int:
    """Number of steps that suffices for any ray: across the volume's diagonal, and a few more for
    transforms."""
    with jax.ensure_compile_time_eval():
        diagonal = march.locate(volume).diagonal
        traced = is_traced(march.step, diagonal)
        steps = math.nan if traced or not march.step > 0 else float(diagonal) / float(march.step)
    if traced:
        if march.max_samples is not None:
            return march.max_samples
        raise ValueError(
            "March(max_samples=...) must be given where march.step or volume.spacing is traced: "
            "the length of a scan must be known before the program is compiled."
        )
    if not math.isfinite(steps):  # then nothing is marched, and the image is NaN
        return 1
    # the first cell may begin a step early, one step finds the exit, and a jitter may shorten one more
    return min(math.ceil(steps) + 4, march.most_samples)
