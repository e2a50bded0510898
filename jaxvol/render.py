"""How is an image rendered? The public functions: they check what they are given, and hand it to the fast
engine."""

import math
import warnings
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._util.checks import Arrayable, described, finite_array, require
from .compositing.blending import Compositing
from .compositing.modes import Mode, compositing_of
from .engine.devices import Devices
from .engine.image import Adjoint, RenderOutputs, render_scene
from .lighting.shading import Lighting
from .march.march import March
from .planning import plan
from .ray import Scene, check_arguments
from .scene.camera import Camera, GivenRays
from .scene.rendering import Rendering
from .scene.transfer import Transfer
from .scene.volume import Volume
from .xla.sharding import shard_number


PLANNED = 1 / 255
"""Tolerance of `march="auto"`: one level of an 8-bit image."""


def render(
    volume: Volume | Any,
    transfer: Transfer | Any,
    camera: Camera | Any,
    march: March | Literal["auto"] | Any,
    *,
    tolerance: float | Any | None = None,
    compositing: Mode | Compositing[Any] | Any = "over",
    lighting: Lighting | Any | None = None,
    outputs: RenderOutputs | Any = "all",
    adjoint: Adjoint | Any = "replay",
    devices: Devices | Any | None = None,
) -> Rendering:
    """Renders an image of a volume.

    **Arguments:**

    - `volume`, `transfer`: what is there, and how it looks.
    - `camera`: makes one ray for each pixel.
    - `march`: step and transforms; or `"auto"`: those of `plan`, which is called for each image,
      without transforms that are part of the scene (a `ToroidalMap`, a `Clip`). To plan with these, call
      `found = plan(volume, transfer, camera, tolerance, transforms=(clip,))`, and render by `found.march`.
    - `tolerance`: with `"auto"`, the RMSE that the image's colours may have; by default 1/255.
    - `compositing`: how the cells of a ray become a pixel: `"over"`; `"maximum"`, `"minimum"` or `"average"`,
      the projections of VTK (`Maximum` and its siblings take a `thickness`); an `Isosurface(value)`; or
      another `Weighting` or `Selection`. Where a `Selection` chooses a depth, no adjoint marches again: JAX
      differentiates what is computed there.
    - `lighting`: how samples are shaded: `lighting.Phong(lights)`, or `lighting.ScattererTemplates(materials,
      lights)`. Without, colours are those of the transfer function.
    - `outputs`: `"rgba"` computes the image and `exhausted` only, in some 5 % less time; `"all"` everything
      that a `Rendering` holds.
    - `adjoint`: how the image is differentiated. The image itself is the same.
        - `"replay"`: reverse mode (`jax.grad`). A second march computes the samples again, so that memory
          does not grow with their number: it takes one array like each leaf, and the rays of one tile.
        - `"forward"`: forward mode (`jax.jvp`, `jax.jacfwd`).
        - `"direct"`: both, and higher derivatives; JAX differentiates `render_ray_reference`. Memory grows
          with the number of samples.
    - `devices`: a sequence of JAX's devices, or a `jax.sharding.Mesh` of one axis, to which the rays are
      dealt out by `jax.shard_map`: beams of 8 x 8 pixels in turn. The image and its gradient are the same,
      jitter included, and lie on all of these devices. So does the scene: a volume is copied to each once in
      its lifetime. By default JAX decides where the image is computed, on one device. In a program of several
      processes (`jax.distributed.initialize()`) pass `jax.devices()`, and make the same calls in all of them;
      each has the whole image then (`examples/several_processes.py`).

    **Returns:** a `Rendering` with leading shape (height, width), in JAX's default float type. If a number on
    which all pixels depend is NaN or infinite (an entry of a transfer function whose fit diverged, say), all
    of the image is NaN, and so is its gradient. A voxel that is NaN makes those pixels NaN whose rays meet
    it, or leave the volume next to it.

    `jax.vmap`, over any of the arguments, renders one image after the other, in one program, and so for
    gradients, as a loop would. `"direct"` renders them side by side, and so does `"forward"` where the image
    is also differentiated, or compiled inside the `jax.vmap`.

    In float32, the gradient by the extinction drowns in rounding along rays of optical depth above 14
    (`experiments/stability.py`, "gradients of opaque rays").

    **Raises:** `ValueError`, naming the argument, for an argument of another kind (an array for a `Volume`, a
    camera in the march's place), for unknown outputs or an unknown adjoint, and for `"direct"` where the
    march or the spacing is traced and `march.max_samples` is not given. For `"auto"` where arrays are
    traced, and for a tolerance without it. For `devices` that are none, and for any inside a `jax.shard_map`.
    Under the wrong mode of differentiation, naming the adjoint to pass (except `jax.jvp` of a `jax.jit` under
    `"replay"`, which is JAX's `TypeError`).

    Without `AlphaCorrection` an image jumps when a sample crosses the exit. The gradient with respect to the
    camera, the spacing and everything else that moves the exit misses these jumps, and is wrong by them.
    """
    order = "render(volume, transfer, camera, march)"
    if isinstance(march, str):
        if march != "auto":
            raise ValueError(f'march must be a jaxvol March or "auto"; got {march!r}.')
        check_arguments(order, volume=volume)
        given = PLANNED if tolerance is None else tolerance
        found = plan(volume, transfer, camera, given, compositing=compositing, lighting=lighting)
        if not found.within:
            warnings.warn(f"the image may not be within the tolerance: {found}", stacklevel=2)
        march = found.march
    elif tolerance is not None:
        raise ValueError(f'tolerance goes with march="auto"; got {tolerance!r} with {described(march)}.')
    check_arguments(order, volume=volume, transfer=transfer, camera=camera, march=march, lighting=lighting)
    assert isinstance(march, March)
    scene = Scene(volume, transfer, camera, march, compositing_of(compositing), lighting)
    return render_scene(scene, outputs, adjoint, devices=devices)


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
    outputs: RenderOutputs | Any = "all",
    adjoint: Adjoint | Any = "replay",
    devices: Devices | Any | None = None,
) -> Rendering:
    """Renders arbitrary rays.

    **Arguments:** as for `render`, except:

    - `origins`, `directions`: (*rays, 3) world points, and directions of any length but 0. Distances
      are measured in world length whatever the length of a direction.
    - `pixels`: (*rays, 2) integers, (column, row), which key the random numbers of each ray. By default
      (index, 0), with the ray's index in the flattened array. Inside `jax.shard_map` over the first axis of
      the rays that is the index in the whole array. Under `check_vma=False`, JAX does not tell a shard that
      it is one: give pixels there, or each shard draws the same numbers. There is no need for any of this
      with `devices`.

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
    source = GivenRays(origins, directions, _pixels(pixels, origins), first)
    scene = Scene(volume, transfer, source, march, compositing_of(compositing), lighting)
    return render_scene(scene, outputs, adjoint, devices=devices)


def _pixels(pixels: Arrayable | None, origins: Float[Array, "*rays 3"]) -> Int[Array, "*rays 2"] | None:
    if pixels is None:
        return None
    pixels, shape = jnp.asarray(pixels), (*origins.shape[:-1], 2)
    if pixels.shape != shape or not jnp.issubdtype(pixels.dtype, jnp.integer):
        raise ValueError(f"pixels must be integers of shape {shape}; got {pixels.dtype} of {pixels.shape}.")
    return pixels.astype(jnp.int32)
