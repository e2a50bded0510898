"""What does every part of a scene get of an image's gradient?

Rays are made and marched once more, wave by wave. What each of their samples gets is `replay`'s business.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._util.sharding import varying
from .._util.trees import added, floats
from ..lighting.shading import Surroundings
from ..reference import has_fault
from ..rendering import AbstractDepthPicture, AbstractPicture
from ..space import Ray, invalid
from ..volume import Volume, with_voxels, without_voxels
from .acceleration import Scene, VolumeAcceleration, empty_space_of
from .packing import with_words
from .replay import Cotangents, Replay, Total
from .shading_gradient import Lit
from .tiles import RayTiles
from .wavefront import Beams, CellRange, march_rays


def render_vjp(
    scene: Scene,
    perturbed: Any,
    known: VolumeAcceleration,
    rendering: AbstractPicture,
    spans: CellRange | None,
    gradient: AbstractPicture,
) -> Any:
    """Vector–Jacobian product of `render`: a cotangent for each perturbed leaf of the scene."""
    volume, transfer, source, march, lighting = scene
    of_voxels = eqx.is_inexact_array(volume.data) and perturbed[0].data
    places = any(jax.tree.leaves((perturbed[0], *perturbed[2:4])))
    packed = with_words(volume, known.words)
    waves, index = RayTiles.of(source), empty_space_of(scene, known)
    if index is not None and spans is not None:
        index = index.within_ranges()
    seen, fault = transfer.over(packed), has_fault(volume, transfer, march, lighting)
    light, pull_light = None, None
    if lighting is not None:
        light, pull_light = _light(scene, packed, voxels=of_voxels)

    def wave(
        sums: tuple[Total, PyTree], given: tuple[Array, CellRange | None, AbstractPicture, AbstractPicture]
    ) -> Any:
        (total, of_source), (number, span, rendering, gradient) = sums, given

        def made(moving: PyTree) -> Ray:
            volume_, source_, march_ = eqx.combine(moving, (without_voxels(volume), source, march))
            space = march_.locate(with_voxels(volume_, volume.data))
            return invalid(waves.rays(source_, space, number), fault)

        moving = floats((without_voxels(volume), source, march))
        rays, pull = eqx.filter_vjp(made, moving)
        replay = Replay(
            (volume, known.words, transfer, march),
            seen,
            *(rays, Cotangents.of(rays, rendering, gradient), total, light),
            places=places,
        )
        beams = Beams(rays, waves.beams, waves.box(source, rays, number), span)
        _, (_, of_rays, total) = march_rays(march, packed, seen, index, beams, None, replay)
        if not places:
            return (total, of_source), None
        if isinstance(gradient, AbstractDepthPicture):
            # a depth counts from the ray's origin, a sample's from the entry
            toward = jnp.where(rendering.rgba[..., 3] > 0, gradient.depth, 0)
            of_rays = eqx.tree_at(lambda ray: ray.t_in, of_rays, of_rays.t_in + toward)
        of_volume, of_rays_source, of_march = pull(of_rays)[0]
        total = eqx.tree_at(
            lambda t: (t.volume, t.march),
            total,
            (added(total.volume, of_volume), added(total.march, of_march)),
        )
        return (total, added(of_source, of_rays_source)), None

    start = (
        Total.zeros(volume, transfer, march, light, voxels=of_voxels),
        jax.tree.map(jnp.zeros_like, floats(source)),
    )
    image = jax.tree.map(waves.apart, (rendering, gradient))
    (total, of_source), _ = jax.lax.scan(
        wave, varying(start, image), (jnp.arange(waves.number), spans, *image)
    )
    of_volume = total.volume
    if total.voxels is not None:
        voxels = total.voxels.reshape(volume.data.shape).astype(volume.data.dtype)
        of_volume = with_voxels(of_volume, voxels)
    if pull_light is None:
        return of_volume, total.transfer, of_source, total.march, None
    more_volume, more_transfer, more_march, of_lighting = pull_light(total.light)[0]
    return (
        added(of_volume, more_volume),
        added(total.transfer, more_transfer),
        of_source,
        added(total.march, more_march),
        of_lighting,
    )


def _light(scene: Scene, packed: Volume, *, voxels: bool) -> tuple[Lit, Callable[[PyTree], Any]]:
    """By what an image is lit; and what volume, transfer function, march and lighting get of the gradient of
    that."""
    volume, transfer, _, march, lighting = scene
    parts = volume if voxels else without_voxels(volume), transfer, march, lighting
    moving, fixed = eqx.partition(parts, eqx.is_inexact_array)

    def made(moving: PyTree) -> tuple[PyTree, Lit]:
        moved, transfer, march, lighting = eqx.combine(moving, fixed)
        # the packed copy is for fetching alone
        whole = moved if voxels else with_voxels(moved, volume.data)
        around = Surroundings(whole, transfer, march.locate(whole))
        light = Lit(lighting.over(around), around)
        return floats(light.leaves), light

    _, pull, light = jax.vjp(made, moving, has_aux=True)
    return light._replace(around=Surroundings(packed, transfer, march.locate(volume))), pull
