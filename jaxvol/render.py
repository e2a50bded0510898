"""How is an image rendered, and differentiated?

Rays are made wave by wave, in the order of `waves`. How the rays of a wave are marched is `wavefront`'s
business; what they see is `reference`'s; and what a loss sees of it, `backward`'s.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeAlias, get_args, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._util.checks import Arrayable, finite_array, is_traced, require
from ._util.sharding import shard_number, varying
from ._util.xla import compiled, forward_only, recomputed, transformations
from .camera import Camera
from .engine.acceleration import Scene, VolumeAcceleration, empty_space_of
from .engine.gradients import render_vjp
from .engine.packing import with_words
from .engine.replay import VisibleRangeRecorder
from .engine.tiles import OwnRays, RayTiles, line, vmap_rays
from .engine.wavefront import Beams, CellRange, march_rays
from .lighting.deferred import Deferred, lit_picture
from .lighting.shading import Lighting, classification
from .march import March
from .reference import begin, end, has_fault, step, steps_across
from .rendering import AbstractPicture, Found, Outputs, Picture, Rendering
from .scene import check_scene
from .space import invalid
from .transfer import Transfer
from .volume import Volume


Adjoint: TypeAlias = Literal["replay", "forward", "direct"]

WRONG_WAY = {
    "replay": 'adjoint="replay" is for reverse mode (jax.grad, jax.vjp). For forward mode (jax.jvp, '
    'jax.jacfwd) pass adjoint="forward"; for both, and for higher derivatives, adjoint="direct".',
    "forward": 'adjoint="forward" is for forward mode (jax.jvp, jax.jacfwd). For reverse mode (jax.grad, '
    'jax.vjp) pass adjoint="replay", the default; for both, adjoint="direct".',
}

DIRECT_WAVE = 64
"""Beams in a wave of `"direct"`, which keeps all its states to be differentiated."""


@overload
def render(
    volume: Volume,
    transfer: Transfer,
    camera: Camera,
    march: March,
    *,
    lighting: Lighting | None = None,
    outputs: Literal["all"] = "all",
    adjoint: Adjoint = "replay",
) -> Rendering: ...


@overload
def render(
    volume: Volume,
    transfer: Transfer,
    camera: Camera,
    march: March,
    *,
    lighting: Lighting | None = None,
    outputs: Literal["rgba"],
    adjoint: Adjoint = "replay",
) -> Picture: ...


def render(
    volume: Volume | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    march: March | Any,
    *,
    lighting: Lighting | Any | None = None,
    outputs: Any = "all",
    adjoint: Adjoint = "replay",
) -> Any:
    """The image of a volume.

    **Arguments:**

    - `volume`, `transfer`: what is there, and how it looks.
    - `camera`: one ray for each pixel.
    - `march`: step and transforms.
    - `lighting`: how samples are lit, such as `lighting.ScattererTemplates`. Without, colours are those of
      the transfer function.
    - `outputs`: `"rgba"` for the image alone, in some 5 % less time; `"all"` for what its rays met, too.
    - `adjoint`: how the image is differentiated; the image itself is the same.
        - `"replay"`: reverse mode (`jax.grad`). A second march computes the samples again, so that memory
          does not grow with their number: it takes one array like each leaf, and a wave's rays.
        - `"forward"`: forward mode (`jax.jvp`, `jax.jacfwd`).
        - `"direct"`: both, and higher derivatives, by letting JAX differentiate
          `render_ray_reference`. Memory grows with the number of samples.

    **Returns:** a `Rendering` with leading shape (height, width), in JAX's default float type; or, for the
    image alone, a `Picture`. Where a number on which all pixels depend is NaN or infinite (an entry of a
    transfer function whose fit diverged, say), all of the image is NaN, and so is its gradient; a voxel that
    is NaN makes those pixels NaN whose rays meet it, or leave the volume beside it.

    Under `jax.vmap`, over any of the arguments, images are rendered one after the other, in one program, and
    so are their gradients, as a loop would. `"direct"` renders them side by side, and so
    does `"forward"` where the image is also differentiated, or compiled inside the `jax.vmap`.

    **Raises:** `ValueError`, naming the argument, for one that is something else than its name says (an array
    for a `Volume`, a camera in the march's place), for unknown outputs or an unknown adjoint, and for
    `"direct"` where the march or the spacing is traced and `march.max_samples` is not given. Under the wrong
    mode of differentiation, with the adjoint to pass (but for `jax.jvp` of a `jax.jit` under `"replay"`,
    which is JAX's `TypeError`).

    Without `AlphaCorrection` the gradient of an image with respect to the camera, the spacing and
    whatever else moves the exit is wrong by the jumps made when a sample crosses the exit.
    """
    order = "render(volume, transfer, camera, march)"
    check_scene(order, volume=volume, transfer=transfer, camera=camera, march=march, lighting=lighting)
    how, lighting = _How.of(outputs, adjoint, volume, march), _prepared(lighting, volume, transfer, march)
    return _render((volume, transfer, camera, march, lighting), how, VolumeAcceleration.of(volume, march))


@overload
def render_rays(
    volume: Volume,
    transfer: Transfer,
    origins: Arrayable,
    directions: Arrayable,
    march: March,
    *,
    pixels: Arrayable | None = None,
    lighting: Lighting | None = None,
    outputs: Literal["all"] = "all",
    adjoint: Adjoint = "replay",
) -> Rendering: ...


@overload
def render_rays(
    volume: Volume,
    transfer: Transfer,
    origins: Arrayable,
    directions: Arrayable,
    march: March,
    *,
    pixels: Arrayable | None = None,
    lighting: Lighting | None = None,
    outputs: Literal["rgba"],
    adjoint: Adjoint = "replay",
) -> Picture: ...


def render_rays(
    volume: Volume | Any,
    transfer: Transfer | Any,
    origins: Arrayable,
    directions: Arrayable,
    march: March | Any,
    *,
    pixels: Arrayable | None = None,
    lighting: Lighting | Any | None = None,
    outputs: Any = "all",
    adjoint: Adjoint = "replay",
) -> Any:
    """What rays of one's own see. As `render`, but for:

    - `origins`, `directions`: (*rays, 3) world points, and directions of any length but 0. Distances
      are measured in world length whatever the length of a direction.
    - `pixels`: (*rays, 2) integers, (column, row), by which all that is random along a ray is keyed. By
      default (place, 0), with the ray's place in the flattened array. Inside `jax.shard_map` over the first
      axis of the rays that is the place in the whole array; under `check_vma=False`, where JAX does not tell
      a shard that it is one, give pixels, or each shard draws the same numbers.

    **Returns:** as `render`, with leading shape `*rays`.

    **Raises:** as `render`, and `ValueError` for shapes that differ or do not end in 3, NaN or
    infinity, and directions of length 0.
    """
    order = "render_rays(volume, transfer, origins, directions, march)"
    check_scene(order, volume=volume, transfer=transfer, march=march, lighting=lighting)
    origins = finite_array("origins", origins, (..., 3))
    directions = finite_array("directions", directions, (..., 3))
    if origins.shape != directions.shape:
        raise ValueError(
            f"origins and directions must agree in shape; got {origins.shape} and {directions.shape}."
        )
    message = "directions must not have length 0."
    directions = require(directions, lambda d: (d != 0).any(axis=-1), message)
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    how, lighting = _How.of(outputs, adjoint, volume, march), _prepared(lighting, volume, transfer, march)
    count = jnp.asarray(math.prod(origins.shape[:-1]), jnp.int32)
    source = OwnRays(origins, directions, _pixels(pixels, origins), shard_number(origins, directions) * count)
    return _render((volume, transfer, source, march, lighting), how, VolumeAcceleration.of(volume, march))


class _How(eqx.Module):
    """What is found out, and by which loop rays are marched to their ends."""

    outputs: Found = eqx.field(static=True)
    adjoint: Adjoint = eqx.field(static=True)
    length: int = eqx.field(static=True)
    """Of the loop of `"direct"`."""

    @classmethod
    def of(cls, outputs: Any, adjoint: Any, volume: Volume, march: March) -> "_How":
        for name, given, known in (("outputs", outputs, Outputs), ("adjoint", adjoint, Adjoint)):
            if given not in get_args(known):
                raise ValueError(f"{name} must be one of {', '.join(get_args(known))}; got {given!r}.")
        if adjoint != "direct":
            return cls(outputs, adjoint, 0)
        length = steps_across(volume, march)
        # to the next of few lengths, so that a change of step rarely compiles the program again
        return cls(outputs, adjoint, min(-(-length // 64) * 64, march.most_samples))


def _render(scene: Scene, how: _How, known: VolumeAcceleration) -> Any:
    scene, known = varying((scene, known))
    if isinstance(scene[-1], Deferred):
        return _deferred(scene, how, known)
    if how.adjoint == "replay":
        return _replayed(scene, how, known)
    picture = _image(scene, how, known)
    return forward_only(picture, WRONG_WAY["forward"]) if how.adjoint == "forward" else picture


def _deferred(scene: Scene, how: _How, known: VolumeAcceleration) -> AbstractPicture:
    """An image that is rendered without light, and lit as a whole."""
    found = "all" if how.outputs == "all" else "depth"
    rendering = _render((*scene[:-1], None), replace(how, outputs=found), known)
    lit = _lit_replayed if how.adjoint == "replay" else _lit
    rgba = lit(scene, known, rendering.rgba, rendering.depth)
    return Picture(rgba, rendering.exhausted) if how.outputs == "rgba" else replace(rendering, rgba=rgba)


def _light(
    scene: Scene, known: VolumeAcceleration, rgba: Float[Array, "*rays 4"], depth: Float[Array, "*rays"]
) -> Float[Array, "*rays 4"]:
    volume, transfer, source, march, lighting = scene
    volume = with_words(volume, known.words)
    space = march.locate(volume)
    seen = classification(volume, transfer, space, lighting)
    lit = lit_picture(seen, space, partial(line, source), rgba, depth)
    return lit * jnp.where(has_fault(volume, transfer, march, lighting), jnp.nan, 1).astype(lit.dtype)


def _replayed(scene: Scene, how: _How, known: VolumeAcceleration) -> AbstractPicture:
    """The image; in reverse mode, its derivative by a second march."""
    if not is_traced(scene):  # a rule for derivatives takes milliseconds
        return _image_in_turn(scene, how, known)
    kinds = [transformations(leaf) for leaf in jax.tree.leaves(scene)]
    if any("JVPTracer" in kind or kind.count("LinearizeTracer") > 1 for kind in kinds):
        raise ValueError(WRONG_WAY["replay"])  # JAX's own error names neither argument nor remedy
    # JAX has such rules inside `jax.shard_map` only under `jax.jit`
    image = _image_by_shard if any("ShardMapTracer" in kind for kind in kinds) else _image_by_replay
    return image(scene, how, jax.lax.stop_gradient(known))


@eqx.filter_custom_vjp
def _image_by_replay(scene: Scene, how: _How, known: VolumeAcceleration) -> AbstractPicture:
    return _image_in_turn(scene, how, known)


@_image_by_replay.def_fwd
def _(perturbed: Any, scene: Scene, how: _How, known: VolumeAcceleration) -> tuple[AbstractPicture, Any]:
    rendering, spans = _watched(scene, how, known)
    return rendering, (rendering, spans)


@_image_by_replay.def_bwd
def _(
    left: Any, gradient: AbstractPicture, perturbed: Any, scene: Scene, how: _How, known: VolumeAcceleration
) -> Any:
    return _pulled(scene, perturbed, known, left, gradient)


_image_by_shard = eqx.filter_jit(_image_by_replay)


def _marched(
    scene: Scene, how: _How, known: VolumeAcceleration, *, watch: bool = False
) -> tuple[AbstractPicture, CellRange | None]:
    """The image; and where rays leap, if it is to be watched, the spans of each wave's rays."""
    volume, transfer, source, march, lighting = scene
    volume = with_words(volume, known.words)
    direct = how.adjoint == "direct"
    waves, space = RayTiles.of(source, DIRECT_WAVE if direct else None), march.locate(volume)
    index = None if direct else empty_space_of((volume, transfer, source, march, None), known)
    seen = classification(volume, transfer, space, lighting)
    fault = has_fault(volume, transfer, march, lighting)

    def wave(number: Int[Array, ""]) -> tuple[AbstractPicture, CellRange | None]:
        rays, spans = invalid(waves.rays(source, space, number), fault), None
        if direct:
            one = vmap_rays(lambda ray, at: step(march, ray, volume, seen, at))
            start = vmap_rays(lambda ray: begin(march, ray, how.outputs))(rays)
            at, _ = jax.lax.scan(
                lambda at, _: (one(rays, at), None), varying(start, rays), None, length=how.length
            )
        else:
            beams = Beams(rays, waves.beams, waves.box(source, rays, number))
            watcher = VisibleRangeRecorder(rays.length.shape) if watch and index is not None else None
            at, (spans, *_) = march_rays(march, volume, seen, index, beams, how.outputs, watcher)
        return vmap_rays(end)(rays, at), spans

    pictures, spans = jax.lax.map(wave, jnp.arange(waves.number))
    return jax.tree.map(waves.assemble, pictures), spans


def _only_marched(scene: Scene, how: _How, known: VolumeAcceleration) -> AbstractPicture:
    return _marched(scene, how, known)[0]


def _pull(
    scene: Scene,
    perturbed: Any,
    known: VolumeAcceleration,
    left: tuple[AbstractPicture, CellRange | None],
    gradient: Any,
) -> Any:
    rendering, spans = left
    # None stands for what the loss does not use
    whole = jax.tree.map(
        lambda leaf, part: jnp.zeros_like(leaf) if part is None and eqx.is_inexact_array(leaf) else part,
        *(rendering, gradient),
        is_leaf=lambda leaf: leaf is None,
    )
    found = eqx.filter(render_vjp(scene, perturbed, known, rendering, spans, whole), perturbed)
    # a loss that looks at what is NaN has no gradient: that of a ray that is not marched would be 0
    floats = (jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)) for tree in (rendering, whole))
    lost = [jnp.any(jnp.isnan(leaf) & (part != 0)) for leaf, part in zip(*floats, strict=True)]
    fault = jnp.any(jnp.stack(lost))
    return jax.tree.map(lambda leaf: jnp.where(fault, jnp.nan, leaf), found)


# An image is one program, and its gradient another.

_image = compiled(_only_marched, has_jvp=True)
_image_in_turn = compiled(_only_marched)
_watched = compiled(partial(_marched, watch=True))
_pulled = compiled(_pull)
_lit = compiled(_light, has_jvp=True)
_lit_replayed = recomputed(_light)


def _prepared(lighting: Lighting | None, volume: Volume, transfer: Transfer, march: March) -> Lighting | None:
    return None if lighting is None else lighting.prepared(volume, transfer, march)


def _pixels(pixels: Arrayable | None, origins: Float[Array, "*rays 3"]) -> Int[Array, "*rays 2"] | None:
    if pixels is None:
        return None
    pixels, shape = jnp.asarray(pixels), (*origins.shape[:-1], 2)
    if pixels.shape != shape or not jnp.issubdtype(pixels.dtype, jnp.integer):
        raise ValueError(f"pixels must be integers of shape {shape}; got {pixels.dtype} of {pixels.shape}.")
    return pixels.astype(jnp.int32)
