"""VJP of a whole image: sums, over its tiles, the gradients of all that `render` was given.

Rays are made and marched once more, tile by tile; `replay` pulls their samples back, and JAX differentiates
how rays are made. `of_x` is the cotangent of `x`, here and in `replay`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ..lighting.shading import Shader, Surroundings
from ..march.beams import EmptySpaceIndex, Skips
from ..ray import Progress, Scene, by_rules
from ..scene.rendering import Rendering
from ..scene.space import Ray
from ..scene.volume import Volume, voxels_of, with_voxels, without_voxels
from ..xla.sharding import varying
from ..xla.trees import PyTree, added, floats, zeros_of
from .acceleration import VolumeAcceleration, empty_space_of
from .rays import RayTiles
from .replay import Cotangents, Replay, Total
from .shifts import begin_rays
from .tiling import GROUPS_OF_BEAM, RenderOptions
from .voxel_gradient import asked_of, cotangents_of
from .wavefront import CellRange, Marched, Recorded, blinded, into_range, march_rays


def render_vjp(
    scene: Scene,
    perturbed: Any,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    residuals: tuple[Rendering, Recorded],
    cotangent: Any,
) -> Any:
    """Vector–Jacobian product of `render`: a cotangent for each perturbed leaf of the scene.

    `residuals`: the image, and what was recorded of its rays. `cotangent`: of the image, None for what the
    loss does not use. A loss that uses a pixel that is NaN has the gradient NaN."""
    rendering, recorded = residuals
    whole = of_all_outputs(rendering, cotangent)
    found = _vjp_by_tiles(scene, perturbed, options, acceleration, rendering, recorded, whole)
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


def moves_rays(perturbed: Any) -> bool:
    """Whether any leaf on which rays depend is perturbed."""
    return any(jax.tree.leaves((without_voxels(perturbed.volume), perturbed.source, perturbed.march)))


class Sums(NamedTuple):
    """Gradients summed over the tiles so far: of the scene's parts, and of where its rays come from."""

    total: Total
    source: PyTree


class ImageVjp(NamedTuple):
    """What the tiles of an image share.

    Attributes:
        scene: as given.
        prepared: without lighting, since samples are pulled back through `shader`.
        lit: through which rays are marched: with lighting if that is inline, so that invisible samples have
            their light, too.
        pull_shader: from the shader's leaves to volume, transfer function, march and lighting.
    """

    scene: Scene
    prepared: Scene
    lit: Scene
    empty_space: EmptySpaceIndex | None
    shader: Shader | None
    pull_shader: Callable[[PyTree], Any] | None
    tiles: RayTiles

    @classmethod
    def of(
        cls,
        scene: Scene,
        perturbed: Any,
        options: RenderOptions,
        acceleration: VolumeAcceleration,
        recorded: Recorded | None = None,
    ) -> "ImageVjp":
        """The pull-back of a scene's image; of what was `recorded` of all rays, by the tiles of that."""
        index, tiles = None, None
        if recorded is None or recorded.skips is None:
            index = empty_space_of(scene, acceleration, options.tiling)
        if recorded is not None and (leaves := jax.tree.leaves(recorded[:2])):
            number, groups = leaves[0].shape[:2]
            tiles = number, groups // GROUPS_OF_BEAM
        lit = prepared = by_rules(acceleration.prepared(scene._replace(lighting=None)))
        shader, pull_shader = None, None
        if scene.lighting is not None:
            shader, pull_shader = _shader_of(
                scene, prepared.volume, voxels=asked_of(scene.volume, perturbed.volume)
            )
            if shader.inline:
                lit = prepared._replace(classification=prepared.classification._replace(light=shader))
        tiles = RayTiles.of(scene.source, options.tiling, tiles=tiles)
        return cls(scene, prepared, lit, index, shader, pull_shader, tiles)

    def zeros(self, perturbed: Any) -> Sums:
        """Zeros, for what is perturbed."""
        geometric = moves_rays(perturbed)
        of_transfer = any(jax.tree.leaves(perturbed.transfer))
        total = Total.zeros(
            self.scene,
            self.shader,
            transfer=of_transfer,
            geometric=geometric,
            voxels=asked_of(self.scene.volume, perturbed.volume),
        )
        return Sums(total, zeros_of(self.scene.source) if geometric else None)

    def rays(self, number: Int[Array, ""]) -> tuple[Ray, Callable[[PyTree], Any]]:
        """The rays of a tile, and their pull-back to volume, source and march."""
        fault = self.scene.has_fault
        volume, source, march = self.scene.volume, self.scene.source, self.scene.march

        def made(moving: PyTree) -> Ray:
            volume_, source_, march_ = eqx.combine(moving, (without_voxels(volume), source, march))
            space = march_.locate(with_voxels(volume_, voxels_of(volume)))
            return self.tiles.rays(source_, space, number, fault)

        return eqx.filter_vjp(made, floats((without_voxels(volume), source, march)))

    def march(
        self,
        rays: Ray,
        number: Int[Array, ""],
        range_: CellRange | None,
        replay: Replay,
        start: Progress,
        *,
        skips: Skips | None = None,
    ) -> Marched:
        """Marches the rays of a tile once more, and pulls their samples back by `replay`."""
        tiles, step = self.tiles, self.scene.march.step
        skips = tiles.skips(self.empty_space, rays, step) if skips is None else skips
        start = blinded(skips, start)
        if range_ is not None:
            start = into_range(self.prepared, rays, start, range_, shifts=False)
        return march_rays(self.lit, rays, start, tiles.tiling, skips, replay, shifts=False)

    def begin(self, rays: Ray, shifted: Int[Array, "groups rays"] | None) -> Progress:
        """Rays at their entries, of which nothing but the opacity is computed. `shifted`: where they shift;
        None: that is found on the way."""
        march, tiling = self.scene.march, self.tiles.tiling
        return begin_rays(march, self.prepared, rays, tiling, None, shifted, finds_shifts=False)

    def replay(self, rays: Ray, given: Cotangents, total: Total) -> Replay:
        """What pulls the samples of rays back."""
        return Replay(self.scene, self.prepared, self.shader, self.tiles.tiling.chunk, rays, given, total)

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
            toward = jnp.where(rendering.opacity > 0, cotangent.depth, 0)
            of_rays = eqx.tree_at(lambda ray: ray.t_in, of_rays, of_rays.t_in + toward)
        of_volume, of_source, of_march = pull(of_rays)[0]
        total = total._replace(volume=added(total.volume, of_volume), march=added(total.march, of_march))
        return Sums(total, added(sums.source, of_source))

    def pull_rules(self, of_rules: PyTree) -> PyTree:
        """The cotangents of the march, from those of its rules."""
        moving, fixed = eqx.partition(self.scene.march, eqx.is_inexact_array)
        return jax.vjp(lambda moving: eqx.combine(moving, fixed).rules.moving, moving)[1](of_rules)[0]

    def cotangents(self, sums: Sums) -> Scene:
        """Those of the scene's parts; 0 for those that are not asked for."""
        total, volume = sums.total, self.scene.volume
        parts = without_voxels(volume), self.scene.transfer, self.scene.source, self.scene.march
        of_parts = total.volume, total.transfer, sums.source, total.march
        of_volume, of_transfer, of_source, of_march = (
            zeros_of(part) if found is None else found for part, found in zip(parts, of_parts, strict=True)
        )
        if total.rules is not None:
            of_march = added(of_march, self.pull_rules(total.rules))
        of_volume = with_voxels(of_volume, cotangents_of(volume, total.voxels))
        of_lighting = None
        if self.pull_shader is not None:
            more_volume, more_transfer, more_march, of_lighting = self.pull_shader(total.shader)[0]
            of_volume, of_transfer = added(of_volume, more_volume), added(of_transfer, more_transfer)
            of_march = added(of_march, more_march)
        # a march does not depend on the parameters of a mode
        return Scene(
            of_volume, of_transfer, of_source, of_march, zeros_of(self.scene.compositing), of_lighting
        )


def _vjp_by_tiles(
    scene: Scene,
    perturbed: Any,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    rendering: Rendering,
    recorded: Recorded,
    cotangent: Rendering,
) -> Any:
    """The cotangents of a scene's parts, tile by tile."""
    if moves_rays(perturbed):  # made again, to be pulled back
        recorded = recorded._replace(rays=None, skips=None)
    image = ImageVjp.of(scene, perturbed, options, acceleration, recorded)
    own, skips = recorded.rays, recorded.skips
    if image.empty_space is not None and recorded.range is not None:
        image = image._replace(empty_space=image.empty_space.within_ranges())

    def tile(sums: Sums, each: Any) -> tuple[Sums, None]:
        number, (range_, shifted), rendering, cotangent = each
        rays, pull = image.rays(number) if own is None else (own, lambda of_rays: ())
        replay = image.replay(rays, Cotangents.of(rays, rendering, cotangent), sums.total)
        start = image.begin(rays, shifted)
        _, of_rays, total = image.march(rays, number, range_, replay, start, skips=skips).visited
        return image.of_rays(sums._replace(total=total), pull, of_rays, rendering, cotangent), None

    parts = jax.tree.map(image.tiles.disassemble, (rendering, cotangent))
    sums, _ = image.tiles.scan(tile, varying(image.zeros(perturbed), parts), recorded[:2], *parts)
    return image.cotangents(sums)


def _shader_of(scene: Scene, packed: Volume, *, voxels: list[bool]) -> tuple[Shader, Callable[[PyTree], Any]]:
    """What shades an image; and the pull-back of its leaves to volume, transfer function, march and
    lighting."""
    volume, transfer, march, lighting = scene.volume, scene.transfer, scene.march, scene.lighting
    data = voxels_of(volume)
    asked = with_voxels(volume, [each if a else None for each, a in zip(data, voxels, strict=True)])
    moving, fixed = eqx.partition((asked, transfer, march, lighting), eqx.is_inexact_array)

    def made(moving: PyTree) -> tuple[PyTree, Shader]:
        moved, transfer, march, lighting = eqx.combine(moving, fixed)
        # the packed copy serves fetching only
        both = zip(voxels_of(moved), data, strict=True)
        whole = with_voxels(moved, [given if own is None else own for own, given in both])
        around = Surroundings(whole, transfer, march.locate(whole))
        shader = Shader.of(lighting, around)
        return floats(shader.leaves), shader

    _, pull, shader = jax.vjp(made, moving, has_aux=True)
    return shader._replace(around=Surroundings(packed, transfer, march.locate(volume))), pull
