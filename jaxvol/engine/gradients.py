"""VJP of an image: the cotangents of all arguments of `render`, summed over tiles.

Rays are generated and marched once more, tile by tile; `replay` pulls their samples back, and JAX
differentiates their generation. `of_x` is the cotangent of `x`, as in `replay`.
"""

from collections.abc import Callable
from typing import NamedTuple

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
from ..xla.compiling import compiled
from ..xla.sharding import varying
from ..xla.trees import PyTree, added, floats, is_none, zeros_of
from .acceleration import VolumeAcceleration, empty_space_of
from .rays import RayTiles
from .replay import Cotangents, Replay, Total
from .shifts import begin_rays
from .tiling import GROUPS_OF_BEAM, RenderOptions
from .voxel_gradient import asked_of, cotangents_of
from .wavefront import CellRange, Marched, Recorded, finish_blind, into_range, march_rays


def render_vjp(
    scene: Scene,
    perturbed: PyTree,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    residuals: tuple[Rendering, Recorded],
    cotangent: PyTree,
) -> PyTree:
    """Vector–Jacobian product of `render`: a cotangent for each perturbed leaf of the scene.

    `residuals`: the image, and the record of its rays. `cotangent`: of the image, None for outputs that the
    loss does not use. If the loss uses a pixel that is NaN, all cotangents are NaN."""
    rendering, recorded = residuals
    cotangent = jax.tree.map(
        lambda leaf, part: jnp.zeros_like(leaf) if part is None and eqx.is_inexact_array(leaf) else part,
        *(rendering, cotangent),
        is_leaf=is_none,
    )
    result = _vjp_by_tiles(scene, perturbed, options, acceleration, rendering, recorded, cotangent)
    # rays that are NaN are not marched, and would leave a gradient of 0
    pairs = zip(*(jax.tree.leaves(floats(tree)) for tree in (rendering, cotangent)), strict=True)
    fault = jnp.any(jnp.stack([jnp.any(jnp.isnan(leaf) & (part != 0)) for leaf, part in pairs]))
    return jax.tree.map(lambda leaf: jnp.where(fault, jnp.nan, leaf), eqx.filter(result, perturbed))


def moves_rays(perturbed: PyTree) -> bool:
    """True if any leaf on which rays depend is perturbed."""
    return any(jax.tree.leaves((without_voxels(perturbed.volume), perturbed.source, perturbed.march)))


class Sums(NamedTuple):
    """Cotangents summed over the tiles so far: of the scene's parts, and of the source of rays."""

    total: Total
    source: PyTree


class ImageVjp(NamedTuple):
    """The VJP of an image, shared by its tiles.

    Attributes:
        scene: the differentiated scene.
        prepared: the scene prepared without lighting, since samples are pulled back through `shader`.
        lit: the scene that is marched: `prepared`, with lighting if it is inline, so that invisible samples
            are lit, too.
        pull_shader: pull-back from the shader's leaves to volume, transfer function, march and lighting.
    """

    scene: Scene
    prepared: Scene
    lit: Scene
    empty_space: EmptySpaceIndex | None
    shader: Shader | None
    pull_shader: Callable[[PyTree], PyTree] | None
    tiles: RayTiles

    @classmethod
    def of(
        cls,
        scene: Scene,
        perturbed: PyTree,
        options: RenderOptions,
        acceleration: VolumeAcceleration,
        recorded: Recorded | None = None,
    ) -> "ImageVjp":
        """The VJP of a scene's image. The tiles are those of the record, if any."""
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

    def zeros(self, perturbed: PyTree) -> Sums:
        """Zeros for all perturbed parts."""
        geometric = moves_rays(perturbed)
        of_transfer, of_mode = (
            any(jax.tree.leaves(part)) for part in (perturbed.transfer, perturbed.compositing)
        )
        total = Total.zeros(
            self.scene,
            self.shader,
            transfer=of_transfer,
            mode=of_mode,
            geometric=geometric,
            voxels=asked_of(self.scene.volume, perturbed.volume),
        )
        return Sums(total, zeros_of(self.scene.source) if geometric else None)

    def rays(self, number: Int[Array, ""]) -> tuple[Ray, Callable[[PyTree], PyTree]]:
        """The rays of a tile, and their pull-back to volume, source and march."""
        fault = self.scene.has_fault
        volume, source, march = self.scene.volume, self.scene.source, self.scene.march

        def make_rays(moving: PyTree) -> Ray:
            volume_, source_, march_ = eqx.combine(moving, (without_voxels(volume), source, march))
            space = march_.locate(with_voxels(volume_, voxels_of(volume)))
            return self.tiles.rays(source_, space, number, fault)

        return eqx.filter_vjp(make_rays, floats((without_voxels(volume), source, march)))

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
        start = finish_blind(skips, start)
        if range_ is not None:
            start = into_range(self.prepared, rays, start, range_, shifts=False)
        return march_rays(self.lit, rays, start, tiles.tiling, skips, replay, shifts=False)

    def begin(self, rays: Ray, shifted: Int[Array, "groups rays"] | None) -> Progress:
        """Rays at their entries, with opacity as the only output. `shifted`: the cell behind which each ray
        shifts; None: the march finds it."""
        march, tiling = self.scene.march, self.tiles.tiling
        return begin_rays(march, self.prepared, rays, tiling, None, shifted, finds_shifts=False)

    def of_rays(
        self,
        sums: Sums,
        pull: Callable[[PyTree], PyTree],
        of_rays: PyTree,
        rendering: Rendering,
        cotangent: Rendering,
    ) -> Sums:
        """Adds the pull-back of a tile's rays to the sums, from the rays' cotangents summed over samples."""
        total = sums.total
        if not total.geometric:
            return sums
        if cotangent.details.depth is not None:
            # a pixel's depth is measured from the ray's origin, a sample's from the entry
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
        """Cotangents of the scene's parts; 0 for parts that are not perturbed."""
        total, volume = sums.total, self.scene.volume
        _, transfer, source, march, mode, *_ = self.scene
        parts = without_voxels(volume), transfer, source, march, mode
        of_parts = total.volume, total.transfer, sums.source, total.march, total.mode
        of_volume, of_transfer, of_source, of_march, of_mode = (
            zeros_of(part) if bar is None else bar for part, bar in zip(parts, of_parts, strict=True)
        )
        if total.rules is not None:
            of_march = added(of_march, self.pull_rules(total.rules))
        of_volume = with_voxels(of_volume, cotangents_of(volume, total.voxels))
        of_lighting = None
        if self.pull_shader is not None:
            more_volume, more_transfer, more_march, of_lighting = self.pull_shader(total.shader)[0]
            of_volume, of_transfer = added(of_volume, more_volume), added(of_transfer, more_transfer)
            of_march = added(of_march, more_march)
        return Scene(of_volume, of_transfer, of_source, of_march, of_mode, of_lighting)


def _vjp_by_tiles(
    scene: Scene,
    perturbed: PyTree,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    rendering: Rendering,
    recorded: Recorded,
    cotangent: Rendering,
) -> Scene:
    """The cotangents of a scene's parts, tile by tile."""
    if moves_rays(perturbed):  # rays are generated again, to be pulled back
        recorded = recorded._replace(rays=None, skips=None)
    image = ImageVjp.of(scene, perturbed, options, acceleration, recorded)
    kept_rays, skips = recorded.rays, recorded.skips
    if image.empty_space is not None and recorded.range is not None:
        image = image._replace(empty_space=image.empty_space.within_ranges())

    def tile(sums: Sums, inputs: PyTree) -> tuple[Sums, None]:
        number, (range_, shifted), rendering, cotangent = inputs
        rays, pull = image.rays(number) if kept_rays is None else (kept_rays, lambda of_rays: ())
        cotangents, chunk = Cotangents.of(rays, rendering, cotangent), image.tiles.tiling.chunk
        replay = Replay(scene, image.prepared, image.shader, chunk, rays, cotangents, sums.total)
        start = image.begin(rays, shifted)
        _, of_rays, total = image.march(rays, number, range_, replay, start, skips=skips).visited
        return image.of_rays(sums._replace(total=total), pull, of_rays, rendering, cotangent), None

    parts = jax.tree.map(image.tiles.disassemble, (rendering, cotangent))
    sums, _ = image.tiles.scan(tile, varying(image.zeros(perturbed), parts), recorded[:2], *parts)
    return image.cotangents(sums)


def _shader_of(
    scene: Scene, packed: Volume, *, voxels: list[bool]
) -> tuple[Shader, Callable[[PyTree], PyTree]]:
    """The shader of a scene, and the pull-back of its leaves to volume, transfer, march and lighting."""
    volume, transfer, march, lighting = scene.volume, scene.transfer, scene.march, scene.lighting
    data = voxels_of(volume)
    differentiated = with_voxels(
        volume, [array if wanted else None for array, wanted in zip(data, voxels, strict=True)]
    )
    moving, fixed = eqx.partition((differentiated, transfer, march, lighting), eqx.is_inexact_array)

    def make_shader(moving: PyTree) -> tuple[PyTree, Shader]:
        moved, transfer, march, lighting = eqx.combine(moving, fixed)
        # the packed copy serves fetching only
        pairs = zip(voxels_of(moved), data, strict=True)
        moved = with_voxels(moved, [original if array is None else array for array, original in pairs])
        around = Surroundings(moved, transfer, march.locate(moved))
        shader = Shader.of(lighting, around)
        return floats(shader.leaves), shader

    _, pull, shader = jax.vjp(make_shader, moving, has_aux=True)
    return shader._replace(around=Surroundings(packed, transfer, march.locate(volume))), pull


image_vjp = compiled(render_vjp, by_jvp=True)
