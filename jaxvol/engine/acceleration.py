"""What is found out about voxels and empty space before an image is marched?"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

from .._util.checks import check_answer
from ..compositing.selection import FirstVisible
from ..lighting.shading import Lighting
from ..march.march import EmptySpaceIndex, March, View
from ..march.strides import stride_control
from ..reference import Pipeline, end
from ..scene.occupancy import Blocks
from ..scene.transfer import Transfer, classification_of
from ..scene.variation import Windows
from ..scene.volume import Volume
from .batch import Beams
from .packing import slopes_of, with_words, words_of
from .rays import OwnRays, RayTiles, lines, vmap_rays
from .scene import Scene
from .tiling import Tiling
from .wavefront import march_rays


class VolumeAcceleration(eqx.Module):
    """What depends on the voxels alone: a packed copy for fetching, the slopes of nodes, the ranges of
    blocks, and how values vary around them; None where the image has no use for it. Made once for an array of
    voxels, and anew for another one."""

    words: UInt32[Array, " voxels"] | None
    slopes: UInt32[Array, " voxels"] | None
    blocks: Blocks | None
    windows: Windows | None

    @classmethod
    def of(
        cls, volume: Volume, transfer: Transfer, march: March, lighting: Lighting | None = None
    ) -> "VolumeAcceleration":
        lit_by_gradient = lighting is not None and lighting.reads_gradient
        slopes = transfer.reads_gradient or lit_by_gradient
        # a part of a volume is rendered once: to pack it takes longer than to fetch voxels one by one, unless
        # six cubes of them are fetched for a sample
        packs = slopes or volume.first is None
        return cls(
            words_of(volume) if packs else None,
            slopes_of(volume) if slopes else None,
            Blocks.of(volume, slopes=transfer.reads_gradient) if march.leaps else None,
            None if stride_control(march) is None else Windows.of(volume),
        )

    def packed(self, scene: Scene) -> Scene:
        """The scene, with voxels fetched from their packed copy."""
        return scene._replace(volume=with_words(scene.volume, self.words, self.slopes))


def empty_space_of(scene: Scene, acceleration: VolumeAcceleration, tiling: Tiling) -> EmptySpaceIndex | None:
    """Where the scene is empty; None where the march does not leap. It carries no gradient."""
    volume, transfer, source, march, compositing, _ = jax.lax.stop_gradient(scene)
    blocks = acceleration.blocks
    if blocks is None:
        return None
    space = march.locate(volume)
    visible = compositing.occupied(transfer, blocks)
    check_answer(compositing, "occupied", visible, blocks.unordered)
    visible |= blocks.unordered
    if march.may_shift:  # what is leapt over is taken as transparent
        visible |= transfer.visible(blocks)
    corner = volume.first
    occupancy = space.occupancy(visible) if corner is None else space.occupancy(visible, corner)
    if isinstance(source, OwnRays):
        return march.empty_space(occupancy, None)

    def first_hit(index: EmptySpaceIndex, columns: Int[Array, "*rays"], rows: Int[Array, "*rays"]) -> Array:
        if compositing.resolves and not isinstance(compositing, FirstVisible):
            name = type(compositing).__name__
            raise ValueError(
                f'SpaceLeaping("min_distance") starts rays at what is visible first; {name} may show what '
                "lies before. Use another method."
            )
        plain = March(march.step, (), march.quadrature, max_samples=march.max_samples)
        fault = jnp.zeros((), bool)
        through = lines(source, columns.reshape(1, -1), rows.reshape(1, -1), fault)
        own = OwnRays(*(jnp.stack(part, axis=-1) for part in (through.origin, through.direction)))
        one_tile = tiling._replace(tile=columns.size, devices=None)
        tiles, only = RayTiles.of(own, one_tile), jnp.zeros((), jnp.int32)
        rays = tiles.rays(own, space, only, fault)
        beams = Beams(rays, tiles.beam_count, tiles.box(own, rays, only))
        pipeline = Pipeline(
            plain, volume, classification_of(transfer, volume, integrated=march.integrates), FirstVisible()
        )
        at, _ = march_rays(pipeline, index, beams, tiling, "depth")
        seen = vmap_rays(partial(end, pipeline))(rays, at)
        return tiles.assemble(seen.depth[None]).reshape(columns.shape)

    return march.empty_space(occupancy, View(source.ray, source.size, source.first_pixel, first_hit))
