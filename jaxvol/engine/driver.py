"""How does a scene become an image? The march is made ready, and an adjoint renders."""

from dataclasses import replace
from typing import Any, Literal, get_args

import jax

from ..compositing.selection import Selection
from ..lighting.template_lighting import with_baked_light
from ..reference import resolves
from ..scene.rendering import Rendering
from ..xla.sharding import varying
from ..xla.trees import strong
from .acceleration import VolumeAcceleration
from .adjoints import AbstractAdjoint, Adjoint, adjoint_of
from .devices import check_not_sharded, mesh_of, on_all
from .image import RenderOptions
from .scene import Scene
from .tiling import Tiling


Asked = Literal["all", "rgba"]
"""What a caller may ask for. Of the engine's outputs, the depth alone is for lightings that shade pixels."""


def render_scene(
    scene: Scene, outputs: Any, adjoint: Any, tiling: Tiling | None = None, devices: Any = None
) -> Rendering:
    """The image of a scene whose parts are what they should be.

    `outputs`, `adjoint`, `devices`: as for `render`. `tiling`: by default that of the devices.

    **Raises:** `ValueError` for unknown outputs or an unknown adjoint, and for devices that are none."""
    for name, given, known in (("outputs", outputs, Asked), ("adjoint", adjoint, Adjoint)):
        if given not in get_args(known):
            raise ValueError(f"{name} must be one of {', '.join(get_args(known))}; got {given!r}.")
    tiling = Tiling.of_backend(mesh_of(devices)) if tiling is None else tiling
    check_not_sharded(tiling.devices, scene)
    scene = strong(scene._replace(march=scene.march.divided()))
    volume, transfer, _, march, _, lighting = scene
    how = adjoint_of(adjoint, volume, march)
    if lighting is not None:
        lighting = with_baked_light(lighting, volume, transfer, march)
    options = RenderOptions(outputs, tiling)
    acceleration = VolumeAcceleration.of(volume, transfer, march, lighting)
    scene, acceleration = varying((scene._replace(lighting=lighting), acceleration))
    scene, acceleration = on_all(tiling.devices, (scene, acceleration))
    if resolves(scene.compositing, lighting):
        return _resolved(scene, options, how, acceleration)
    return how.render(scene, options, acceleration)


def _resolved(
    scene: Scene, options: RenderOptions, how: AbstractAdjoint, acceleration: VolumeAcceleration
) -> Rendering:
    """The rays are marched without light, and pixels computed from what that found."""
    all_, compositing = options.outputs == "all", scene.compositing
    options = replace(options, outputs="all" if all_ else "depth")
    transfer, march = compositing.marched(scene.transfer, scene.march, scene.volume)
    # the march does not depend on parameters of the mode, or what it finds is a constant
    unlit = Scene(scene.volume, transfer, scene.source, march, jax.lax.stop_gradient(compositing))
    if isinstance(compositing, Selection):
        unlit = jax.lax.stop_gradient(unlit)
    rendering = how.render(unlit, options, acceleration)
    details = rendering.details
    pixels = how.resolve(scene, options, acceleration, (rendering.rgba, rendering.depth, details.selected))
    if not all_:
        return Rendering(pixels[..., :4], rendering.exhausted)
    normal = pixels[..., 5:] if pixels.shape[-1] > 5 else None
    details = details._replace(depth=pixels[..., 4], normal=normal, selected=None)
    return Rendering(pixels[..., :4], rendering.exhausted, details)
