"""How does a scene become an image, and by which rule does JAX differentiate it, for each `adjoint=`?

An image is one compiled program, and its gradient another; `gradients` has the VJP of `"replay"`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

import equinox as eqx
import jax
from jaxtyping import Array, Int

from ..compositing.selection import Selection
from ..lighting.template_lighting import with_baked_light
from ..ray import Scene, by_rules, check_channels, end
from ..reference import step, steps_across
from ..scene.camera import GivenRays, without_ends
from ..scene.rendering import Rendering
from ..scene.space import Ray, Space
from ..xla.compiling import compiled, in_program
from ..xla.differentiation import forward_only, nan_derivatives, transformations
from ..xla.linear import differentiable, moving_leaves, recomputed
from ..xla.platform import is_traced
from ..xla.sharding import varying
from ..xla.trees import constant, floats, strong
from .acceleration import VolumeAcceleration, empty_space_of
from .devices import check_not_sharded, mesh_of, on_all, over_devices
from .gradients import render_vjp
from .rays import RayTiles, vmap_rays
from .resolve import Found, resolve_image, with_pixels
from .shifts import begin_rays
from .stages import is_staged, staged_image
from .tiling import Adjoint, RenderOptions, Tiling
from .wavefront import Recorded, blinded, march_rays


RenderOutputs: TypeAlias = Literal["all", "rgba"]
"""What a caller may ask for. (`"depth"` is the engine's own, for pixels that are computed after the
march.)"""

WRONG_MODE = {
    "replay": 'adjoint="replay" is for derivatives in either mode, and for forward mode over these (jax.jvp '
    'of jax.grad, jax.hessian). For reverse mode (jax.grad) over either one, pass adjoint="direct".',
    "forward": 'adjoint="forward" is for forward mode (jax.jvp, jax.jacfwd). For reverse mode (jax.grad, '
    'jax.vjp) pass adjoint="replay", the default; for both, adjoint="direct".',
}


def render_scene(
    scene: Scene, outputs: Any, adjoint: Any, tiling: Tiling | None = None, devices: Any = None
) -> Rendering:
    """The image of a scene whose arguments have been checked.

    Raises:
        ValueError: for unknown outputs or an unknown adjoint; for `"direct"` where the march or the spacing
            is traced and `march.max_samples` is not given; and as `mesh_of` and `check_not_sharded` do for
            devices.
    """
    for name, given, known in (("outputs", outputs, RenderOutputs), ("adjoint", adjoint, Adjoint)):
        if given not in get_args(known):
            raise ValueError(f"{name} must be one of {', '.join(get_args(known))}; got {given!r}.")
    mesh, tiling = mesh_of(devices), Tiling.of_backend() if tiling is None else tiling
    tiling = tiling._replace(cells=scene.march.tested_every or tiling.cells)
    if mesh is not None:
        check_not_sharded(scene)
    scene = strong(scene)
    volume, march, lighting = scene.volume, scene.march, scene.lighting
    check_channels(volume, scene.transfer, march, scene.compositing, lighting)
    steps = None
    if adjoint == "direct":
        # rounded up to one of few lengths, so that a change of step rarely compiles the program again
        steps = min(-(-steps_across(volume, march) // 64) * 64, march.most_samples)
    if lighting is not None:
        scene = scene._replace(lighting=with_baked_light(lighting, volume, scene.transfer, march))
    options = RenderOptions(outputs, tiling, adjoint, steps)
    acceleration = VolumeAcceleration.of(volume, scene.transfer, march, scene.lighting, scene.compositing)
    scene, acceleration = varying((scene, acceleration))
    image = _resolved if scene.resolves else _image
    rays = without_ends(scene.source)
    if mesh is None or (isinstance(rays, GivenRays) and rays.origins.size == 0):
        return image(scene, options, acceleration)
    scene, acceleration = on_all(mesh, (scene, acceleration))
    return over_devices(mesh, image, scene, options, acceleration)


def _resolved(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    """The rays are marched without light, and pixels computed from what that found."""
    # a mode's parameters have no gradient through the march: it ignores them, or its result is a constant
    marched = scene.marched._replace(compositing=jax.lax.stop_gradient(scene.compositing))
    if isinstance(scene.compositing, Selection):
        marched = constant(marched)
    outputs = options.outputs
    options = replace(options, outputs="all" if outputs == "all" else "depth")
    rendering = _image(marched, options, acceleration)
    found = rendering.rgba, rendering.depth, rendering.details.selected
    return with_pixels(scene, rendering, _pixels(scene, options, acceleration, found), outputs)


def _image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    """The image, with the derivatives of its adjoint."""
    if options.adjoint == "direct":
        return _direct_image(scene, options, acceleration)
    if options.adjoint == "forward":
        return forward_only(_forward_image(scene, options, acceleration), WRONG_MODE["forward"])
    if not is_traced(scene):  # nothing is differentiated; to go through a custom rule takes milliseconds
        return _plain_image(scene, options, acceleration)
    # inside `jax.shard_map`, JAX has custom rules only under `jax.jit`
    sharded = any("ShardMapTracer" in transformations(leaf) for leaf in jax.tree.leaves(scene))
    image = _replayed_in_shard if sharded else _replayed
    return image(scene, options, jax.lax.stop_gradient(acceleration))


def _pixels(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, found: Found) -> Array:
    """Pixels that are computed after the march, with the derivatives of its adjoint."""
    if options.adjoint == "replay":
        return _pixels_recomputed(scene, options, acceleration, found)
    pixels = _pixels_kept(scene, options, acceleration, found)
    return forward_only(pixels, WRONG_MODE["forward"]) if options.adjoint == "forward" else pixels


def march_image(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration, *, record: bool = False
) -> tuple[Rendering, Recorded]:
    """The image; and, if `record` asks for it, what the second march needs of the first."""
    tiles, tiling = RayTiles.of(scene.source, options.tiling), options.tiling
    index = empty_space_of(acceleration.packed(scene), acceleration, tiling)
    # voxels are fetched from their packed copy from here on
    prepared = by_rules(acceleration.prepared(scene))

    def marched(tile: Int[Array, ""], rays: Ray) -> tuple[Rendering, Recorded]:
        start = begin_rays(scene.march, prepared, rays, tiling, options.outputs)
        skips = tiles.skips(index, rays, scene.march.step)
        known = record and skips is not None
        found = march_rays(prepared, rays, blinded(skips, start), tiling, skips, record=known)
        recorded = Recorded(found.range, start.track.shifted if record else None)
        if record and only:
            recorded = recorded.with_rays(rays, skips)
        return vmap_rays(partial(end, prepared))(rays, found.at), recorded

    only = tiles.number == 1
    rendering, recorded = _over_tiles(scene, prepared.space, tiles, marched)
    own = jax.tree.map(lambda leaf: leaf[0], (recorded.rays, recorded.skips))
    return rendering, recorded._replace(rays=own[0], skips=own[1])


def scan_image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    """The image, by `options.steps` steps of the reference engine along each ray, which JAX can
    differentiate."""
    tiles = RayTiles.of(scene.source, options.tiling, direct=True)
    scene = nan_derivatives(scene, scene.has_fault)
    prepared = acceleration.prepared(scene)

    def scanned(_: Int[Array, ""], rays: Ray) -> tuple[Rendering, None]:
        one = vmap_rays(partial(step, prepared))
        start = begin_rays(scene.march, prepared, rays, options.tiling, options.outputs, finds_shifts=False)
        start = varying(start, rays)
        at, _ = jax.lax.scan(lambda at, none: (one(rays, at), none), start, None, length=options.steps)
        return vmap_rays(partial(end, prepared))(rays, at), None

    return _over_tiles(scene, prepared.space, tiles, scanned)[0]


def _over_tiles(
    scene: Scene, space: Space, tiles: RayTiles, one: Callable[[Int[Array, ""], Ray], tuple[Rendering, Any]]
) -> tuple[Rendering, Any]:
    """Calls `one(tile, rays)` for each tile in turn. Returns the renderings, assembled to an image, and what
    else it returned, stacked."""
    fault = scene.has_fault

    def tile(each: tuple[Int[Array, ""]]) -> tuple[Rendering, Any]:
        return one(each[0], tiles.rays(scene.source, space, each[0], fault))

    renderings, more = tiles.map(tile)
    return nan_derivatives(jax.tree.map(tiles.assemble, renderings), fault), more


def _marched_image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    return march_image(scene, options, acceleration)[0]


_forward_image = compiled(_marched_image, has_jvp=True)
_whole_image = compiled(_marched_image)
_recorded_image = compiled(partial(march_image, record=True), by_jvp=True)
_image_vjp = compiled(render_vjp, by_jvp=True)
_direct_image = compiled(scan_image, has_jvp=True)
_pixels_kept = compiled(resolve_image, has_jvp=True)
_pixels_recomputed = recomputed(resolve_image, WRONG_MODE["replay"])


def _plain_image(scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Rendering:
    if in_program(scene, acceleration) or not is_staged(scene, options):
        return _whole_image(scene, options, acceleration)
    return staged_image(scene, options, acceleration)[0]


def _recorded(
    scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration
) -> tuple[Rendering, tuple[Rendering, Recorded]]:
    staged = not in_program(scene, acceleration) and is_staged(scene, options)
    image = partial(staged_image, record=True) if staged else _recorded_image
    rendering, recorded = image(scene, options, acceleration)
    return rendering, (rendering, recorded)


def _push(tangents: Any, scene: Scene, options: RenderOptions, acceleration: VolumeAcceleration) -> Any:
    def floats_of(moving: Any) -> Any:
        return floats(march_image(eqx.combine(moving, scene), options, acceleration)[0])

    return jax.jvp(floats_of, (moving_leaves(scene, tangents),), (tangents,))[1]


def _pull(
    cotangent: Rendering,
    perturbed: Any,
    residuals: Any,
    scene: Scene,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
) -> Any:
    return _image_vjp(scene, perturbed, options, acceleration, residuals, cotangent)


_replayed = differentiable(
    _plain_image, _recorded, compiled(_push, has_jvp=True), _pull, WRONG_MODE["replay"]
)
_replayed_in_shard = eqx.filter_jit(_replayed)
