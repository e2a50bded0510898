"""Renders a scene, with the rule of differentiation that `adjoint` selects.

An image is one compiled program, and its gradient another; `gradients` has the VJP of `"replay"`.
"""

from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias, get_args

import equinox as eqx
import jax
from jaxtyping import Array, Int

from ..compositing.blending import OpticalDepths, Weighting
from ..compositing.selection import Selection
from ..ray import Scene, by_rules, check_channels, end
from ..scene.camera import GivenRays, without_ends
from ..scene.rendering import Rendering
from ..scene.space import Ray
from ..xla.compiling import compiled, in_program
from ..xla.differentiation import forward_only, transformations
from ..xla.linear import differentiable, moving_leaves, recomputed
from ..xla.platform import is_traced
from ..xla.sharding import varying
from ..xla.trees import PyTree, constant, floats, strong
from .acceleration import VolumeAcceleration, empty_space_of
from .devices import Devices, check_not_sharded, mesh_of, on_all, over_devices
from .rays import RayTiles, over_tiles, vmap_rays
from .resolve import MarchResult, resolve_image, with_pixels
from .shifts import begin_rays
from .stages import is_staged, staged_image
from .tiling import Adjoint, RenderOptions, Tiling
from .wavefront import Recorded, finish_blind, march_rays


RenderOutputs: TypeAlias = Literal["all", "rgba"]
"""The argument `outputs` of the renderers. (`"depth"` is internal, for pixels computed after the march.)"""

WRONG_MODE = {
    "replay": 'adjoint="replay" supports first derivatives in either mode, and forward mode over these '
    '(jax.jvp of jax.grad, jax.hessian). For jax.grad over a derivative, pass adjoint="direct".',
    "forward": 'adjoint="forward" supports forward mode (jax.jvp, jax.jacfwd). For reverse mode (jax.grad, '
    'jax.vjp) pass adjoint="replay", the default; for both, adjoint="direct".',
}


def render_scene(
    scene: Scene,
    outputs: RenderOutputs,
    adjoint: Adjoint,
    tiling: Tiling | None = None,
    devices: Devices | None = None,
    most_samples: int | None = None,
) -> Rendering:
    """The image of a scene whose arguments have been checked. `most_samples`: number of samples that are kept
    of each ray, as `Rendering.ray_samples`; None: no samples.

    Raises:
        ValueError: if `outputs` or `adjoint` is unknown; if `adjoint` is `"direct"`, the march or the spacing
            is traced, and `march.max_samples` is None; by `mesh_of` and `check_not_sharded` for `devices`.
    """
    for name, value, choices in (("outputs", outputs, RenderOutputs), ("adjoint", adjoint, Adjoint)):
        if value not in get_args(choices):
            more = '; and "samples", by render_rays' if name == "outputs" else ""
            raise ValueError(f"{name} must be one of {', '.join(get_args(choices))}{more}; got {value!r}.")
    mesh, tiling = mesh_of(devices), Tiling.of_backend() if tiling is None else tiling
    tiling = tiling._replace(cells=scene.march.tested_every or tiling.cells)
    if mesh is not None:
        check_not_sharded(scene)
    scene = strong(scene)
    volume, march, lighting = scene.volume, scene.march, scene.lighting
    check_channels(volume, scene.transfer, march, scene.compositing, lighting)
    steps = None
    if most_samples is not None:
        if not isinstance(scene.compositing, Weighting) or scene.resolves:
            name = type(scene.compositing).__name__
            raise ValueError(f'compositing must weight samples for outputs="samples", as "over"; got {name}.')
        adjoint, steps = "direct", most_samples
    elif adjoint == "direct":
        from .direct import steps_of  # here and below, since few images need it

        steps = steps_of(volume, march)
    if lighting is not None:
        scene = scene._replace(lighting=lighting.baked(volume, scene.transfer, march))
    options = RenderOptions(outputs, tiling, adjoint, steps, most_samples is not None)
    acceleration = VolumeAcceleration.of(volume, scene.transfer, march, scene.lighting, scene.compositing)
    scene, acceleration = varying((scene, acceleration))
    image = _resolved if scene.resolves else _image
    rays = without_ends(scene.source)
    if mesh is None or (isinstance(rays, GivenRays) and rays.origins.size == 0):
        return image(scene, options, acceleration)
    scene, acceleration = on_all(mesh, (scene, acceleration))
    return over_devices(mesh, image, scene, options, acceleration)


def _resolved(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    """Marches the rays without light, and computes the pixels from the result."""
    marched, mode = scene.marched, scene.compositing
    if isinstance(mode, Selection):
        marched = constant(marched)
    elif isinstance(mode, OpticalDepths):  # weights without parameters
        marched = marched._replace(compositing=constant(mode))
    outputs = options.outputs
    options = replace(options, outputs="all" if outputs == "all" else "depth")
    rendering = _image(marched, options, acceleration)
    result = rendering.rgba, rendering.depth, rendering.details.selected
    return with_pixels(scene, rendering, _pixels(scene, options, acceleration, result), outputs)


def _image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    """The image, with the derivatives of its adjoint."""
    if options.adjoint == "direct":
        from .direct import direct_image

        return direct_image(scene, options, acceleration)
    if options.adjoint == "forward":
        return forward_only(_forward_image(scene, options, acceleration), WRONG_MODE["forward"])
    if not is_traced(scene):  # nothing is differentiated, and a custom rule takes milliseconds
        return _plain_image(scene, options, acceleration)
    # inside `jax.shard_map`, JAX supports custom rules only under `jax.jit`
    sharded = any("ShardMapTracer" in transformations(leaf) for leaf in jax.tree.leaves(scene))
    image = _replayed_in_shard if sharded else _replayed
    return image(scene, options, jax.lax.stop_gradient(acceleration))


def _pixels(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, marched: MarchResult
) -> Array:
    """Pixels that are computed after the march, with the derivatives of its adjoint."""
    if options.adjoint == "replay":
        return _pixels_recomputed(scene, options, acceleration, marched)
    pixels = _pixels_kept(scene, options, acceleration, marched)
    return forward_only(pixels, WRONG_MODE["forward"]) if options.adjoint == "forward" else pixels


def march_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, *, record: bool = False
) -> tuple[Rendering, Recorded]:
    """The image; and, with `record`, the `Recorded` part of the march that a second march needs."""
    tiles, tiling = RayTiles.of(scene.source, options.tiling), options.tiling
    index = empty_space_of(acceleration.packed(scene), acceleration, tiling)
    prepared = by_rules(acceleration.prepared(scene))

    def march_tile(tile: Int[Array, ""], rays: Ray) -> tuple[Rendering, Recorded]:
        start = begin_rays(scene.march, prepared, rays, tiling, options.outputs)
        skips = tiles.skips(index, rays, scene.march.step)
        ranges = record and skips is not None
        marched = march_rays(prepared, rays, finish_blind(skips, start), tiling, skips, record=ranges)
        recorded = Recorded(marched.range, start.track.shifted if record else None)
        if record and tiles.number == 1:
            recorded = recorded.with_rays(rays, skips)
        return vmap_rays(partial(end, prepared))(rays, marched.at), recorded

    rendering, recorded = over_tiles(scene, prepared.space, tiles, march_tile)
    rays, skips = jax.tree.map(lambda leaf: leaf[0], (recorded.rays, recorded.skips))
    return rendering, recorded._replace(rays=rays, skips=skips)


def _marched_image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    return march_image(scene, options, acceleration)[0]


_forward_image = compiled(_marched_image, has_jvp=True)
_compiled_image = compiled(_marched_image)
_recorded_image = compiled(partial(march_image, record=True), by_jvp=True)
_pixels_kept = compiled(resolve_image, has_jvp=True)
_pixels_recomputed = recomputed(resolve_image, WRONG_MODE["replay"])


def _plain_image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    if in_program(scene, acceleration) or not is_staged(scene, options):
        return _compiled_image(scene, options, acceleration)
    return staged_image(scene, options, acceleration)[0]


def _recorded(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration
) -> tuple[Rendering, tuple[Rendering, Recorded]]:
    staged = not in_program(scene, acceleration) and is_staged(scene, options)
    image = partial(staged_image, record=True) if staged else _recorded_image
    rendering, recorded = image(scene, options, acceleration)
    return rendering, (rendering, recorded)


def _push(tangents: PyTree, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> PyTree:
    def floats_of(moving: PyTree) -> PyTree:
        return floats(march_image(eqx.combine(moving, scene), options, acceleration)[0])

    return jax.jvp(floats_of, (moving_leaves(scene, tangents),), (tangents,))[1]


def _pull(
    cotangent: Rendering,
    perturbed: PyTree,
    residuals: tuple[Rendering, Recorded],
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
) -> PyTree:
    from .gradients import image_vjp  # here, since images alone do not need it

    return image_vjp(scene, perturbed, options, acceleration, residuals, cotangent)


_replayed = differentiable(
    _plain_image, _recorded, compiled(_push, has_jvp=True), _pull, WRONG_MODE["replay"]
)
_replayed_in_shard = eqx.filter_jit(_replayed)
