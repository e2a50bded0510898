"""What is rendered, and what is known of it before any ray is marched?"""

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

from ..camera import Camera
from ..lighting.shading import Lighting
from ..march import EmptySpaceIndex, March, View
from ..occupancy import Blocks
from ..reference import end
from ..rendering import Rendering
from ..transfer import Transfer
from ..transforms.space_leaping import FirstHit
from ..volume import Volume
from .packing import words_of
from .tiles import OwnRays, RayTiles, lines, vmap_rays
from .wavefront import Beams, march_rays


Scene: TypeAlias = tuple[Volume, Transfer, Camera | OwnRays, March, Lighting | None]


class VolumeAcceleration(eqx.Module):
    """What was found out about a volume before, and is found out anew for other voxels."""

    words: UInt32[Array, " voxels"] | None
    blocks: Blocks | None

    @classmethod
    def of(cls, volume: Volume, march: March) -> "VolumeAcceleration":
        return cls(words_of(volume), Blocks.of(volume) if march.leaps else None)


def empty_space_of(scene: Scene, known: VolumeAcceleration) -> EmptySpaceIndex | None:
    """What is known of empty space. Nothing of it has a gradient."""
    volume, transfer, source, march, _ = jax.lax.stop_gradient(scene)
    if known.blocks is None:
        return None
    space = march.locate(volume)
    occupancy = space.occupancy(transfer.visible(known.blocks) | known.blocks.unordered)
    if isinstance(source, OwnRays):
        return march.empty_space(occupancy, None)

    def first_hit(index: EmptySpaceIndex, columns: Int[Array, "*rays"], rows: Int[Array, "*rays"]) -> Array:
        first = March(march.step, (FirstHit(),), march.quadrature, max_samples=march.max_samples)
        through = lines(source, columns.reshape(1, -1), rows.reshape(1, -1))
        ends = (jnp.stack(end, axis=-1) for end in (through.origin, through.direction))
        own, none = OwnRays(*ends), jnp.zeros((), jnp.int32)
        waves = RayTiles.of(own, columns.size)
        rays = waves.rays(own, space, none)
        beams = Beams(rays, waves.beams, waves.box(own, rays, none))
        at, _ = march_rays(first, volume, transfer.over(volume), index, beams)
        seen = vmap_rays(end)(rays, at)
        assert isinstance(seen, Rendering)
        return waves.assemble(seen.depth[None]).reshape(columns.shape)

    return march.empty_space(occupancy, View(source.ray, source.size, source.first_pixel, first_hit))
