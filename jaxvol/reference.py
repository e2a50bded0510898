"""Reference rendering of one ray: a plain scan over its cells, by the functions of `ray`."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._util.checks import Arrayable, finite_array
from ._util.vec3 import apart
from .compositing.blending import Compositing, Weighting
from .compositing.modes import Mode, compositing_of
from .compositing.selection import RaySampler, Selection
from .lighting.shading import Lighting
from .march.march import March
from .ray import (
    Progress,
    Scene,
    add,
    begin,
    check_arguments,
    check_channels,
    end,
    is_sample,
    measure,
    move,
    opacity,
    pieces,
    resolve,
    reweigh,
    stop,
    track_of,
)
from .scene.rendering import RaySamples, Rendering
from .scene.several import together
from .scene.space import Line, Ray, enter, invalid
from .scene.transfer import Transfer
from .scene.volume import Volume
from .xla.differentiation import nan_derivatives
from .xla.platform import is_traced
from .xla.sharding import varying


def render_ray_reference(
    volume: Volume | Sequence[Volume],
    transfer: Transfer | Sequence[Transfer],
    origin: Arrayable,
    direction: Arrayable,
    march: March,
    *,
    pixel: tuple[Arrayable, Arrayable] = (0, 0),
    compositing: Mode | Compositing[Any] = "over",
    lighting: Lighting | None = None,
) -> Rendering:
    """Render one ray by a plain scan over its cells.

    Computes in the float type of `origin` and `direction`. Differentiable in forward and reverse mode, any
    number of times; the memory of reverse mode grows with the number of samples. `render` agrees to 1e-9 in
    float64 and to 2e-5 in float32, except where a steep transfer function magnifies rounding errors, or
    rounding decides a comparison (docs/features.md, "One reference").

    Args:
        volume: a volume, or a list of volumes on different grids.
        transfer: transfer function, or a list with one for each volume.
        origin: world point where the ray begins.
        direction: unit vector.
        march: step and transforms, which place the samples.
        pixel: (column, row), which keys random numbers.
        compositing: mode that makes a pixel of the cells, as for `render`.
        lighting: shading of samples, as for `render`.

    Returns:
        A `Rendering` of a single pixel: `rgba` has shape (4,), all else ().

    Raises:
        ValueError: where the step, the volume's place or a transform that bends space is traced, and
            `march.max_samples` is not set: the length of the scan cannot be known.
    """
    order = "render_ray_reference(volume, transfer, origin, direction, march)"
    grid, function = together(volume, transfer)
    check_arguments(order, volume=grid, transfer=function, march=march, lighting=lighting)
    if lighting is not None:
        function = lighting.medium(function)
    scene = Scene(grid, function, None, march, compositing_of(compositing), lighting)
    check_channels(grid, function, march, scene.compositing, lighting)
    length = steps_across(grid, march)
    column, row = (jnp.asarray(number, jnp.int32) for number in pixel)
    line = Line(apart(_vector("origin", origin)), apart(_vector("direction", direction)), (column, row))
    fault = _has_fault(scene)
    scene = nan_derivatives(scene, fault)
    shown = scene.prepared()
    ray = invalid(enter(shown.space, *line), fault)
    marched = scene.marched.prepared()

    def advance(at: Progress, _: None) -> tuple[Progress, None]:
        return step(marched, ray, at)[0], None

    start = begin(marched, ray, track_of(marched.march, ray))
    at, _ = jax.lax.scan(advance, varying(start, ray), None, length=length)
    rendering = end(marched, ray, at)
    return resolved(shown, line, rendering) if scene.resolves else rendering


@eqx.filter_jit  # operations by themselves would be a program each
def _has_fault(scene: Scene) -> Bool[Array, ""]:
    return scene.has_fault


def step(scene: Scene, ray: Ray, at: Progress) -> tuple[Progress, RaySamples | None]:
    """Sample one cell, composite it, and move on. Also the samples of its pieces, of width 0 where a piece is
    no sample of the ray; None for a `Selection`."""
    march, compositing = scene.march, scene.compositing
    sampler = RaySampler(ray, scene.classification, space=scene.space)
    progress, alphas, color, samples = at, [], None, []
    cut = pieces(scene, ray, at)
    for piece in cut:
        measured = measure(scene, ray, piece)
        alphas.append(opacity(scene, ray, piece, measured))
        if not isinstance(compositing, Selection):
            transmittance = compositing.transmittance(progress.composite)
            classified = scene.classification.of_cells(measured)
            color = sampler.color(march.sample(piece), measured, classified, transmittance)
        if isinstance(compositing, Weighting) and color is not None:
            depth, before = march.sample(piece), progress.composite.opacity
            counts = ~at.finished & is_sample(march, ray, piece, divided=len(cut) > 1) & ray.contains(depth)
            depth = ray.t_in + jnp.where(counts, depth, ray.length)
            weight = jnp.where(counts, compositing.weight(alphas[-1], before), 0)
            if (factor := progress.composite.factor) is not None:
                weight = weight * factor
            width, shown = jnp.where(counts, piece.width, 0), jnp.where(counts, jnp.stack(color), 0)
            samples.append(RaySamples(*(jnp.stack([part]) for part in (depth, width, weight, shown))))
        progress = add(scene, ray, progress, piece, measured, color, alphas[-1], divided=len(cut) > 1)
    transparent = jnp.all(jnp.stack(alphas) == 0, axis=0)
    pieces_of = jax.tree.map(lambda *parts: jnp.concatenate(parts), *samples) if samples else None
    progress = reweigh(scene, ray, progress, alphas)
    return move(march, ray, stop(scene, progress), transparent, 1), pieces_of


def resolved(scene: Scene, line: Line, rendering: Rendering) -> Rendering:
    """Rendering of a ray whose pixel is computed after the march; a transparent ray has no depth."""
    visible, details = rendering.rgba[3] != 0, rendering.details
    results = rendering.depth, details.selected
    results = jax.tree.map(lambda leaf: jnp.where(visible, leaf, jnp.zeros_like(leaf)), results)
    pixel = resolve(scene, line, rendering.rgba, *results)
    compositing = scene.compositing
    shown = visible | (isinstance(compositing, Weighting) and compositing.resolves_transparent)
    rgba, depth = jnp.where(shown, pixel.rgba, 0), jnp.where(visible, pixel.depth, jnp.inf)
    normal = None if pixel.normal is None else jnp.where(visible, pixel.normal, 0)
    return replace(rendering, rgba=rgba, details=details._replace(depth=depth, normal=normal, selected=None))


def _vector(name: str, value: Arrayable) -> Float[Array, "3"]:
    """Convert to a vector. Floats keep their type, other numbers get JAX's default float type."""
    floats = hasattr(value, "dtype") and jnp.issubdtype(value.dtype, jnp.floating)
    if floats and value.shape == (3,):
        return jnp.asarray(value)
    return finite_array(name, value, (3,))


def steps_across(volume: Volume, march: March) -> int:
    """Upper bound of the steps of any ray: those along the volume's diagonal, and four more."""
    with jax.ensure_compile_time_eval():
        diagonal = march.locate(volume).diagonal
        traced = is_traced(march.step, diagonal)
        steps = math.nan if traced or not march.step > 0 else float(diagonal) / float(march.step)
    if traced:
        if march.max_samples is not None:
            return march.max_samples
        raise ValueError(
            "March(max_samples=...) must be given where march.step or the volume's place is traced: "
            "the length of a scan must be known before the program is compiled."
        )
    if not math.isfinite(steps):  # then nothing is marched, and the image is NaN
        return 1
    # the first cell may begin a step early, one step detects the exit, jitter may shorten one, and one is for
    # rounding
    return min(math.ceil(steps) + 4, march.most_samples)
