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

from ..lighting.shading import Shader, Surroundings
from ..march.march import EmptySpaceIndex
from ..reference import Pipeline
from ..scene.rendering import Rendering
from ..scene.space import Ray
from ..scene.volume import Volume, with_voxels, without_voxels
from ..scene.voxel_fetch import Fetch
from ..xla.sharding import varying
from ..xla.trees import PyTree, added, floats, zeros_of
from .acceleration import VolumeAcceleration, empty_space_of
from .batch import Beams, CellRange
from .devices import on_devices
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
    whole = of_all_outputs(rendering, cotangent)
    found = _vjp_by_tiles(scene, perturbed, options, acceleration, rendering, ranges, whole)
    return of_perturbed(found, perturbed, rendering, whole)


def of_all_outputs(rendering: Rendering, cotangent: Any) -> Rendering:
    """The cotangent of an image, with zeros for what the loss does not use."""
    return jax.tree.map(
        lambda leaf, part: jnp.zeros_like(leaf) if part is None and eqx.is_inexact_array(leaf) else part,
        *(rendering, cotangent),
        is_leaf=lambda leaf: leaf is None,
    )


def of_perturbed(found: Any, perturbed: Any, rendering: Rendering, whole: Rendering) -> Any:
    """Of the cotangents of a scene those that are asked for; NaN if the loss uses a pixel that is NaN."""
    found = eqx.filter(found, perturbed)
    # rays that are NaN are not marched, and would leave a gradient of 0
    floats_of = (jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array)) for tree in (rendering, whole))
    lost = [jnp.any(jnp.isnan(leaf) & (part != 0)) for leaf, part in zip(*floats_of, strict=True)]
    fault = jnp.any(jnp.stack(lost))
    return jax.tree.map(lambda leaf: jnp.where(fault, jnp.nan, leaf), found)


class Sums(NamedTuple):
    """Gradients summed over the tiles so far: of the scene's parts, and of where its rays come from."""

    total: Total
    source: PyTree


class Pull(NamedTuple):
    """What the tiles of an image share.

    `pipeline`: without lighting, since samples are pulled back through `shader`. `lit`: what rays are marched
    through: with lighting if that is inline, so that invisible samples have their light, too. `pull_shader`:
    from the shader's leaves to volume, transfer function, march and lighting.
    """

    scene: Scene
    pipeline: Pipeline
    lit: Pipeline
    fetch: Fetch
    empty_space: EmptySpaceIndex | None
    shader: Shader | None
    pull_shader: Callable[[PyTree], Any] | None
    fault: Bool[Array, ""]
    tiles: RayTiles
    tiling: Tiling

    @classmethod
    def of(
        cls, scene: Scene, perturbed: Any, options: RenderOptions, acceleration: VolumeAcceleration
    ) -> "Pull":
        """That of a scene."""
        packed, tiling = acceleration.packed(scene), options.tiling
        index = empty_space_of(scene, acceleration, tiling)
        _, pipeline = pipeline_of(packed._replace(lighting=None), acceleration)
        shader, pull_shader = None, None
        if scene.lighting is not None:
            shader, pull_shader = _shader_of(scene, packed.volume, voxels=_of_voxels(scene, perturbed))
        lit = pipeline
        if shader is not None and shader.inline:
            lit = pipeline._replace(classification=pipeline.classification._replace(light=shader))
        tiles, fetch = RayTiles.of(scene.source, tiling), packed.volume.fetch
        faulty = fault_of(scene)
        return cls(scene, pipeline, lit, fetch, index, shader, pull_shader, faulty, tiles, tiling)

    def zeros(self, perturbed: Any) -> Sums:
        """Sums of no tile yet, for what is perturbed."""
        around = without_voxels(perturbed.volume), perturbed.source, perturbed.march
        geometric = any(jax.tree.leaves(around))
        of_transfer = any(jax.tree.leaves(perturbed.transfer))
        total = Total.zeros(
            self.scene,
            self.shader,
            transfer=of_transfer,
            geometric=geometric,
            voxels=_of_voxels(self.scene, perturbed),
        )
        return Sums(total, zeros_of(self.scene.source) if geometric else None)

    def rays(self, number: Int[Array, ""]) -> tuple[Ray, Callable[[PyTree], Any]]:
        """The rays of a tile, and their pull-back to volume, source and march."""
        volume, source, march = self.scene.volume, self.scene.source, self.scene.march

        def made(moving: PyTree) -> Ray:
            volume_, source_, march_ = eqx.combine(moving, (without_voxels(volume), source, march))
            space = march_.locate(with_voxels(volume_, volume.data))
            return self.tiles.rays(source_, space, number, self.fault)

        return eqx.filter_vjp(made, floats((without_voxels(volume), source, march)))

    def replay(self, rays: Ray, given: Cotangents, total: Total) -> Replay:
        """What looks at the samples of rays."""
        return Replay(self.pipeline, self.scene, self.fetch, rays, given, total, self.shader, self.tiling)

    def beams(self, rays: Ray, number: Int[Array, ""], range_: CellRange | None) -> Beams:
        """The rays of a tile, to be marched."""
        return Beams(rays, self.tiles.beam_count, self.tiles.box(self.scene.source, rays, number), range_)

    def of_rays(
        self,
        sums: Sums,
        pull: Callable[[PyTree], Any],
        of_rays: PyTree,
        rendering: Rendering,
        cotangent: Rendering,
    ) -> Sums:
        """The sums with what a tile's rays pull back to, from the cotangents that their samples gave them."""
        total = sums.total
        if not total.geometric:
            return sums
        if cotangent.details.depth is not None:
            # depth is measured from the ray's origin, and a sample's from the entry
            toward = jnp.where(rendering.rgba[..., 3] > 0, cotangent.depth, 0)
            of_rays = eqx.tree_at(lambda ray: ray.t_in, of_rays, of_rays.t_in + toward)
        of_volume, of_source, of_march = pull(of_rays)[0]
        of_parts = added(total.volume, of_volume), added(total.march, of_march)
        total = eqx.tree_at(lambda t: (t.volume, t.march), total, of_parts)
        return Sums(total, added(sums.source, of_source))


def _of_voxels(scene: Scene, perturbed: Any) -> bool:
    return eqx.is_inexact_array(scene.volume.data) and perturbed.volume.data


@on_devices("whole", dealt=("ranges",))
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
    image = Pull.of(scene, perturbed, options, acceleration)
    if image.empty_space is not None and ranges is not None:
        image = image._replace(empty_space=image.empty_space.within_ranges())

    def tile(sums: Sums, each: Any) -> tuple[Sums, None]:
        number, range_, rendering, cotangent = each
        rays, pull = image.rays(number)
        replay = image.replay(rays, Cotangents.of(rays, rendering, cotangent), sums.total)
        beams = image.beams(rays, number, range_)
        _, (_, of_rays, total) = march_rays(image.lit, image.empty_space, beams, image.tiling, None, replay)
        return image.of_rays(sums._replace(total=total), pull, of_rays, rendering, cotangent), None

    parts = jax.tree.map(image.tiles.disassemble, (rendering, cotangent))
    sums, _ = image.tiles.scan(tile, varying(image.zeros(perturbed), parts), ranges, *parts)
    return cotangents_of(scene, sums.total, sums.source, image.pull_shader)


def cotangents_of(
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
        shader = Shader.of(lighting, around)
        return floats(shader.leaves), shader

    _, pull, shader = jax.vjp(made, moving, has_aux=True)
    return shader._replace(around=Surroundings(packed, transfer, march.locate(volume))), pull
