"""How is an image rendered? The public functions: they check what they are given, and hand it to the fast
engine."""

import math
from dataclasses import replace
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._util.checks import Arrayable, finite_array, require
from ._util.sharding import shard_number, varying
from ._util.trees import strong
from .arguments import check_arguments
from .camera import Camera
from .compositing import Compositing, Mode, Selection, compositing_of
from .engine.acceleration import VolumeAcceleration
from .engine.adjoints import AbstractAdjoint, Adjoint, adjoint_of
from .engine.image import RenderOptions
from .engine.rays import OwnRays
from .engine.scene import Scene
from .engine.tiling import Tiling
from .lighting.shading import Lighting
from .march import March
from .reference import resolves
from .rendering import Details, Rendering
from .transfer import Transfer
from .volume import Volume


Asked = Literal["all", "rgba"]
"""What a caller may ask for. Of the engine's outputs, the depth alone is for lightings that shade pixels."""


def render(
    volume: Volume | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    march: March | Any,
    *,
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    outputs: Asked | Any = "all",
    adjoint: Adjoint | Any = "replay",
) -> Rendering:
    """Renders an image of a volume.

    **Arguments:**

    - `volume`, `transfer`: what is there, and how it looks.
    - `camera`: makes one ray for each pixel.
    - `march`: step and transforms.
    - `compositing`: how the cells of a ray become a pixel: `"over"`, or a `Weighting` or `Selection`. Where
      a `Selection` chooses a depth, no adjoint marches again: JAX differentiates what is computed there.
    - `lighting`: how samples are shaded, such as `lighting.ScattererTemplates`. Without, colours are those of
      the transfer function.
    - `outputs`: `"rgba"` computes the image and `exhausted` only, in some 5 % less time; `"all"` everything
      that a `Rendering` holds.
    - `adjoint`: how the image is differentiated. The image itself is the same.
        - `"replay"`: reverse mode (`jax.grad`). A second march computes the samples again, so that memory
          does not grow with their number: it takes one array like each leaf, and the rays of one tile.
        - `"forward"`: forward mode (`jax.jvp`, `jax.jacfwd`).
        - `"direct"`: both, and higher derivatives; JAX differentiates `render_ray_reference`. Memory grows
          with the number of samples.

    **Returns:** a `Rendering` with leading shape (height, width), in JAX's default float type. If a number on
    which all pixels depend is NaN or infinite (an entry of a transfer function whose fit diverged, say), all
    of the image is NaN, and so is its gradient. A voxel that is NaN makes those pixels NaN whose rays meet
    it, or leave the volume beside it.

    `jax.vmap`, over any of the arguments, renders one image after the other, in one program, and so for
    gradients, as a loop would. `"direct"` renders them side by side, and so does `"forward"` where the image
    is also differentiated, or compiled inside the `jax.vmap`.

    In float32, the gradient by the extinction drowns in rounding along rays of optical depth above 14
    (`experiments/stability.py`, "gradients of opaque rays").

    **Raises:** `ValueError`, naming the argument, for an argument of another kind (an array for a `Volume`, a
    camera in the march's place), for unknown outputs or an unknown adjoint, and for `"direct"` where the
    march or the spacing is traced and `march.max_samples` is not given. Under the wrong mode of
    differentiation, naming the adjoint to pass (except `jax.jvp` of a `jax.jit` under `"replay"`, which is
    JAX's `TypeError`).

    Without `AlphaCorrection` an image jumps when a sample crosses the exit. The gradient with respect to the
    camera, the spacing and everything else that moves the exit misses these jumps, and is wrong by them.
    """
    order = "render(volume, transfer, camera, march)"
    check_arguments(order, volume=volume, transfer=transfer, camera=camera, march=march, lighting=lighting)
    scene = Scene(volume, transfer, camera, march, compositing_of(compositing), lighting)
    return _render(scene, outputs, adjoint)


def render_rays(
    volume: Volume | Any,
    transfer: Transfer | Any,
    origins: Arrayable,
    directions: Arrayable,
    march: March | Any,
    *,
    pixels: Arrayable | None = None,
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    outputs: Asked | Any = "all",
    adjoint: Adjoint | Any = "replay",
) -> Rendering:
    """Renders arbitrary rays. As `render`, except:

    - `origins`, `directions`: (*rays, 3) world points, and directions of any length but 0. Distances
      are measured in world length whatever the length of a direction.
    - `pixels`: (*rays, 2) integers, (column, row), which key the random numbers of each ray. By default
      (index, 0), with the ray's index in the flattened array. Inside `jax.shard_map` over the first axis of
      the rays that is the index in the whole array. Under `check_vma=False`, JAX does not tell a shard that
      it is one: give pixels there, or each shard draws the same numbers.

    **Returns:** as `render`, with leading shape `*rays`.

    **Raises:** as `render`, and `ValueError` for shapes that differ or do not end in 3, NaN or
    infinity, and directions of length 0.
    """
    order = "render_rays(volume, transfer, origins, directions, march)"
    check_arguments(order, volume=volume, transfer=transfer, march=march, lighting=lighting)
    origins = finite_array("origins", origins, (..., 3))
    directions = finite_array("directions", directions, (..., 3))
    if origins.shape != directions.shape:
        raise ValueError(
            f"origins and directions must agree in shape; got {origins.shape} and {directions.shape}."
        )
    message = "directions must not have length 0."
    directions = require(directions, lambda d: (d != 0).any(axis=-1), message)
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    count = jnp.asarray(math.prod(origins.shape[:-1]), jnp.int32)
    first = shard_number(origins, directions) * count
    source = OwnRays(origins, directions, _pixels(pixels, origins), first)
    scene = Scene(volume, transfer, source, march, compositing_of(compositing), lighting)
    return _render(scene, outputs, adjoint)


def _render(scene: Scene, outputs: Any, adjoint: Any, tiling: Tiling | None = None) -> Rendering:
    """The image of a scene whose parts are what they should be. `tiling`: by default that of the backend."""
    for name, given, known in (("outputs", outputs, Asked), ("adjoint", adjoint, Adjoint)):
        if given not in get_args(known):
            raise ValueError(f"{name} must be one of {', '.join(get_args(known))}; got {given!r}.")
    scene = strong(scene._replace(march=scene.march.divided()))
    volume, transfer, _, march, _, lighting = scene
    how = adjoint_of(adjoint, volume, march)
    if lighting is not None:
        lighting = lighting.prepared(volume, transfer, march)
    options = RenderOptions(outputs, Tiling.of_backend() if tiling is None else tiling)
    acceleration = VolumeAcceleration.of(volume, march)
    scene, acceleration = varying((scene._replace(lighting=lighting), acceleration))
    if resolves(scene.compositing, lighting):
        return _resolved(scene, options, how, acceleration)
    return how.render(scene, options, acceleration)


def _resolved(
    scene: Scene, options: RenderOptions, how: AbstractAdjoint, acceleration: VolumeAcceleration
) -> Rendering:
    """The rays are marched without light, and pixels computed from what that found."""
    all_ = options.outputs == "all"
    unlit, options = scene._replace(lighting=None), replace(options, outputs="all" if all_ else "depth")
    if isinstance(scene.compositing, Selection):  # the choice is a constant
        unlit = jax.lax.stop_gradient(unlit)
    rendering = how.render(unlit, options, acceleration)
    details = rendering.details
    pixels = how.resolve(scene, options, acceleration, (rendering.rgba, rendering.depth, details.selected))
    details = details._replace(depth=pixels[..., 4], selected=None) if all_ else Details()
    return Rendering(pixels[..., :4], rendering.exhausted, details)


def _pixels(pixels: Arrayable | None, origins: Float[Array, "*rays 3"]) -> Int[Array, "*rays 2"] | None:
    if pixels is None:
        return None
    pixels, shape = jnp.asarray(pixels), (*origins.shape[:-1], 2)
    if pixels.shape != shape or not jnp.issubdtype(pixels.dtype, jnp.integer):
        raise ValueError(f"pixels must be integers of shape {shape}; got {pixels.dtype} of {pixels.shape}.")
    return pixels.astype(jnp.int32)
