"""VJP of a whole image: sums, over its tiles, the gradients of all that `render` was given.

Rays are made and marched once more, tile by tile; `replay` pulls their samples back, and JAX the making of
rays.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._util.sharding import varying
from .._util.trees import PyTree, added, floats, zeros_of
from .._util.voxel_fetch import Fetch
from ..lighting.shading import Shader, Surroundings
from ..march import EmptySpaceIndex
from ..reference import Pipeline
from ..rendering import Rendering
from ..space import Ray, invalid
from ..volume import Volume, with_voxels, without_voxels
from .acceleration import VolumeAcceleration, empty_space_of
from .batch import Beams, CellRange
from .image import RenderOptions, fault_of, pipeline_of
from .rays import RayTiles
from .replay import Cotangents, Replay, Total
from .scene import Scene
from .tiling import Tiling
from .wavefront import march_rays


def render_vjp(
    scene: Scene,
    perturbed: Any,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    residuals: tuple[Rendering, CellRange | None],
    cotangent: Any,
) -> Any:
    """Vector–Jacobian product of `render`: a cotangent for each perturbed leaf of the scene.

    `residuals`: the image, and the visible cells of its rays where they were recorded. `cotangent`: of the
    image, None for what the loss does not use. A loss that uses a pixel that is NaN has the gradient NaN."""
    rendering, ranges = residuals
    whole = jax.tree.map(
        lambda leaf, part: jnp.zeros_like(leaf) if part is None and eqx.is_inexact_array(leaf) else part,
        *(rendering, cotangent),
        is_leaf=lambda leaf: leaf is None,
    )
    found = eqx.filter(
        _vjp_by_tiles(scene, perturbed, options, acceleration, rendering, ranges, whole), perturbed
    )
    # rays that are NaN are not marched, and would leave a gradient of 0
    floats_of = (jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)) for tree in (rendering, whole))
    lost = [jnp.any(jnp.isnan(leaf) & (part != 0)) for leaf, part in zip(*floats_of, strict=True)]
    fault = jnp.any(jnp.stack(lost))
    return jax.tree.map(lambda leaf: jnp.where(fault, jnp.nan, leaf), found)


class _Sums(NamedTuple):
    """Gradients summed over the tiles so far: of the scene's parts, and of where its rays come from."""

    total: Total
    source: PyTree


class _Image(NamedTuple):
    """What the tiles of an image share.

    `pipeline`: without lighting, since samples are pulled back through `shader`. `lit`: what rays are marched
    through: with lighting if that is inline, so that invisible samples have their light, too.
    """

    scene: Scene
    pipeline: Pipeline
    lit: Pipeline
    fetch: Fetch
    empty_space: EmptySpaceIndex | None
    shader: Shader | None
    fault: Bool[Array, ""]
    tiles: RayTiles
    tiling: Tiling

    def pull_tile(
        self,
        sums: _Sums,
        number: Int[Array, ""],
        range_: CellRange | None,
        rendering: Rendering,
        cotangent: Rendering,
    ) -> _Sums:
        """The sums with the gradients of one more tile, from its part of the image and of its cotangent."""
        volume, source, march = self.scene.volume, self.scene.source, self.scene.march

        def made(moving: PyTree) -> Ray:
            volume_, source_, march_ = eqx.combine(moving, (without_voxels(volume), source, march))
            space = march_.locate(with_voxels(volume_, volume.data))
            return invalid(self.tiles.rays(source_, space, number), self.fault)

        rays, pull = eqx.filter_vjp(made, floats((without_voxels(volume), source, march)))
        replay = Replay(
            *(self.pipeline, self.scene, self.fetch, rays, Cotangents.of(rays, rendering, cotangent)),
            *(sums.total, self.shader, self.tiling),
        )
        beams = Beams(rays, self.tiles.beam_count, self.tiles.box(source, rays, number), range_)
        _, (_, of_rays, total) = march_rays(self.lit, self.empty_space, beams, self.tiling, None, replay)
        if not total.geometric:
            return _Sums(total, sums.source)
        if cotangent.details.depth is not None:
            # depth is measured from the ray's origin, and a sample's from the entry
            toward = jnp.where(rendering.rgba[..., 3] > 0, cotangent.depth, 0)
            of_rays = eqx.tree_at(lambda ray: ray.t_in, of_rays, of_rays.t_in + toward)
        of_volume, of_source, of_march = pull(of_rays)[0]
        of_parts = added(total.volume, of_volume), added(total.march, of_march)
        total = eqx.tree_at(lambda t: (t.volume, t.march), total, of_parts)
        return _Sums(total, added(sums.source, of_source))


def _vjp_by_tiles(
    scene: Scene,
    perturbed: Any,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    rendering: Rendering,
    ranges: CellRange | None,
    cotangent: Rendering,
) -> Any:
    """The cotangents of a scene's parts, tile by tile."""
    volume, source, lighting = scene.volume, scene.source, scene.lighting
    of_voxels = eqx.is_inexact_array(volume.data) and perturbed.volume.data
    around = without_voxels(perturbed.volume), perturbed.source, perturbed.march
    geometric = any(jax.tree.leaves(around))
    packed, tiling = acceleration.packed(scene), options.tiling
    tiles, index = RayTiles.of(source, tiling), empty_space_of(scene, acceleration, tiling)
    if index is not None and ranges is not None:
        index = index.within_ranges()
    _, pipeline = pipeline_of(packed._replace(lighting=None), acceleration)
    shader, pull_shader = None, None
    if lighting is not None:
        shader, pull_shader = _shader_of(scene, packed.volume, voxels=of_voxels)
    lit = pipeline
    if shader is not None and shader.shading.inline:
        lit = pipeline._replace(classification=pipeline.classification._replace(light=shader))
    fetch = packed.volume.fetch
    image = _Image(*(scene, pipeline, lit, fetch, index, shader, fault_of(scene), tiles, tiling))
    of_transfer = any(jax.tree.leaves(perturbed.transfer))
    sums = _Sums(
        Total.zeros(scene, shader, transfer=of_transfer, geometric=geometric, voxels=of_voxels),
        zeros_of(source) if geometric else None,
    )
    parts = jax.tree.map(tiles.disassemble, (rendering, cotangent))
    sums, _ = jax.lax.scan(
        lambda sums, each: (image.pull_tile(sums, *each), None),
        varying(sums, parts),
        (jnp.arange(tiles.number), ranges, *parts),
    )
    return _cotangents(scene, *sums, pull_shader)


def _cotangents(
    scene: Scene, total: Total, of_source: PyTree, pull_shader: Callable[[PyTree], Any] | None
) -> Any:
    """The cotangents of a scene's parts; 0 for those that are not asked for."""
    volume, transfer, source, march, compositing, _ = scene
    compositing = zeros_of(compositing)  # a march does not depend on its parameters
    parts = without_voxels(volume), transfer, source, march
    sums = total.volume, total.transfer, of_source, total.march
    of_volume, of_transfer, of_source, of_march = (
        zeros_of(part) if found is None else found for part, found in zip(parts, sums, strict=True)
    )
    if total.voxels is not None:
        data = volume.data
        of_volume = with_voxels(of_volume, total.voxels.reshape(data.shape).astype(data.dtype))
    if pull_shader is None:
        return Scene(of_volume, of_transfer, of_source, of_march, compositing, None)
    more_volume, more_transfer, more_march, of_lighting = pull_shader(total.shader)[0]
    return Scene(
        added(of_volume, more_volume),
        added(of_transfer, more_transfer),
        of_source,
        added(of_march, more_march),
        compositing,
        of_lighting,
    )


def _shader_of(scene: Scene, packed: Volume, *, voxels: bool) -> tuple[Shader, Callable[[PyTree], Any]]:
    """What shades an image; and the pull-back of its leaves to volume, transfer function, march and
    lighting."""
    volume, transfer, _, march, _, lighting = scene
    parts = volume if voxels else without_voxels(volume), transfer, march, lighting
    moving, fixed = eqx.partition(parts, eqx.is_inexact_array)

    def made(moving: PyTree) -> tuple[PyTree, Shader]:
        moved, transfer, march, lighting = eqx.combine(moving, fixed)
        # the packed copy serves fetching only
        whole = moved if voxels else with_voxels(moved, volume.data)
        around = Surroundings(whole, transfer, march.locate(whole))
        shader = Shader(lighting.shading(around), around)
        return floats(shader.leaves), shader

    _, pull, shader = jax.vjp(made, moving, has_aux=True)
    return shader._replace(around=Surroundings(packed, transfer, march.locate(volume))), pull
