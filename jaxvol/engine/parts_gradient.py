"""VJP of an image that was marched through one part of a volume after the other: as `gradients`, with a
second march through all parts, in the same order."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Int

from ..ray import begin
from ..scene.rendering import Rendering
from ..xla.trees import PyTree
from .acceleration import VolumeAcceleration
from .batch import CellRange, with_fields
from .devices import on_devices
from .gradients import Pull, Sums, cotangents_of
from .image import RenderOptions
from .parts import NOTHING, Underway, ended
from .rays import vmap_rays
from .replay import Cotangents
from .scene import Scene
from .wavefront import march_rays


class Pulled(eqx.Module):
    """The second march of an image, underway, of (tiles, groups, rays in a group).

    - `given`: cotangents of the rays.
    - `carry`: what the samples so far are worth. `of_rays`: what they gave the rays.
    """

    underway: Underway
    given: Cotangents
    carry: Array
    of_rays: PyTree


@on_devices("both")
def start_pull(
    scene: Scene, perturbed: Any, options: RenderOptions, rendering: Rendering, cotangent: Rendering
) -> tuple[Sums, Pulled]:
    """All rays at their entries, with the cotangents of their pixels. Of the volume, no voxel is read."""
    image = Pull.of(scene, perturbed, options, NOTHING)
    sums = image.zeros(perturbed)

    def one(each: tuple[Int[Array, ""], Rendering, Rendering]) -> tuple[Underway, Cotangents, Array, PyTree]:
        number, rendering, cotangent = each
        rays, _ = image.rays(number)
        at = vmap_rays(lambda ray: begin(image.pipeline, ray, None))(rays)
        given = Cotangents.of(rays, rendering, cotangent)
        replay = image.replay(rays, given, sums.total)
        underway = Underway(rays, with_fields(at, finished=rays.length <= 0))
        return underway, given, replay.carry, replay.sums

    parts = jax.tree.map(image.tiles.disassemble, (rendering, cotangent))
    underway, given, carry, of_rays = image.tiles.map(one, *parts)
    return sums, Pulled(underway, given, carry, of_rays)


@on_devices("both", dealt=("pulled", "ranges"))
def pull_part(
    scene: Scene,
    perturbed: Any,
    options: RenderOptions,
    acceleration: VolumeAcceleration,
    sums: Sums,
    pulled: Pulled,
    ranges: CellRange,
) -> tuple[Sums, Pulled]:
    """The second march behind these cells of its rays, as `march_part`."""
    image = Pull.of(scene, perturbed, options, acceleration)

    def one(sums: Sums, each: Any) -> tuple[Sums, Any]:
        number, underway, given, carry, of_rays, range_ = each
        replay = image.replay(underway.rays, given, sums.total)
        replay.carry, replay.sums = carry, of_rays
        after, (carry, of_rays, total) = march_rays(
            *(image.lit, image.empty_space, image.beams(underway.rays, number, range_), image.tiling),
            *(None, replay, underway.at),
        )
        over = underway.at.finished | ended(image.pipeline, underway.rays, after)
        underway = Underway(underway.rays, with_fields(after, finished=over))
        return sums._replace(total=total), (underway, given, carry, of_rays)

    every = pulled.underway, pulled.given, pulled.carry, pulled.of_rays, ranges
    sums, (underway, given, carry, of_rays) = image.tiles.scan(one, sums, *every)
    return sums, Pulled(underway, given, carry, of_rays)


@on_devices("whole", dealt=("pulled",))
def end_pull(
    scene: Scene,
    perturbed: Any,
    options: RenderOptions,
    sums: Sums,
    pulled: Pulled,
    rendering: Rendering,
    cotangent: Rendering,
) -> Any:
    """The cotangents of a scene's parts, from a march through all parts of its volume."""
    image = Pull.of(scene, perturbed, options, NOTHING)

    def one(sums: Sums, each: Any) -> tuple[Sums, None]:
        number, of_rays, rendering, cotangent = each
        _, pull = image.rays(number)
        return image.of_rays(sums, pull, of_rays, rendering, cotangent), None

    parts = jax.tree.map(image.tiles.disassemble, (rendering, cotangent))
    sums, _ = image.tiles.scan(one, sums, pulled.of_rays, *parts)
    return cotangents_of(scene, sums.total, sums.source, image.pull_shader)
