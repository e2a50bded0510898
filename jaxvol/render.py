"""The public functions that render: they check their arguments, and call the fast engine."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal, SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._util.checks import Arrayable, described, finite_array, integer, require
from ._util.memory import memory_available
from .compositing.blending import Compositing
from .compositing.modes import Mode, compositing_of
from .engine.devices import Devices
from .engine.image import Adjoint, RenderOutputs, render_scene
from .lighting.shading import Lighting
from .march.march import March
from .ray import Scene, check_arguments
from .scene.camera import Camera, Ending, GivenRays, finer
from .scene.rendering import Rendering, pooled
from .scene.several import together
from .scene.transfer import Transfer
from .scene.volume import Volume
from .xla.platform import is_traced
from .xla.sharding import shard_number


PLANNED = 1 / 255
"""Tolerance of `march="auto"`: one level of an 8-bit image."""

BYTES = 136
"""Memory of a ray until its image is done, in bytes (measured: 110 to 160): position, state, result."""

LARGE = 2**31
"""Images of more bytes are compared with the memory that is left."""


def render(
    volume: Volume | Sequence[Volume],
    transfer: Transfer | Sequence[Transfer],
    camera: Camera,
    march: March | Literal["auto"],
    *,
    tolerance: float | None = None,
    compositing: Mode | Compositing[Any] = "over",
    lighting: Lighting | None = None,
    outputs: RenderOutputs = "all",
    adjoint: Adjoint = "replay",
    devices: Devices | None = None,
    antialias: SupportsIndex = 1,
    until: Arrayable | None = None,
) -> Rendering:
    """Render an image of a volume.

    Args:
        volume: a volume, or a list of volumes on different grids. Extinctions of several volumes add at each
            sample, colours are means weighted by extinction, and a cell that a volume's face divides counts
            for its part inside. Several volumes cannot be lit, and are composited by `"over"`, `"integral"`
            or a custom `Weighting`.
        transfer: transfer function, or a list with one for each volume. (Where all extinctions are exactly 0,
            the mixed colour is undefined. `jax.grad` with `adjoint="replay"` is exact there; forward mode and
            second derivatives use the mean colour.)
        camera: camera, one ray for each pixel.
        march: step and transforms; or `"auto"`: those of `plan`, which is called for each image, without
            transforms that are part of the scene (a `ToroidalMap`, a `Clip`). To plan with these, call
            `planned = plan(volume, transfer, camera, tolerance, transforms=(clip,))`, and render by
            `planned.march`.
        tolerance: with `"auto"`, the RMSE allowed in the image's colours; by default 1/255.
        compositing: mode that makes a pixel of the cells of a ray: `"over"`; `"maximum"`, `"minimum"` or
            `"average"`, the projections of VTK (`Maximum` and its siblings take a `thickness`); an
            `Isosurface(value)`; or another `Weighting` or `Selection`. Where a `Selection` chooses a depth,
            the march is not differentiated: JAX differentiates the pixel computed at that depth.
        lighting: shading of samples: `lighting.Phong(lights)` or
            `lighting.ScattererTemplates(materials, lights)`; by default none.
        outputs: `"all"`, or `"rgba"` for the image and `exhausted` only, in some 5 % less time.
        adjoint: method of differentiation; the image is the same. `"replay"`: forward and reverse mode, and
            forward mode over these (`jax.hessian`, `jax.jvp` of `jax.grad`); for `jax.grad`, a second march
            computes the samples again, so that memory does not grow with their number (one array like each
            leaf, and the rays of one tile). `"forward"`: forward mode (`jax.jvp`, `jax.jacfwd`) only, by one
            march instead of two. `"direct"`: any mode and order; JAX differentiates the reference's march, in
            some 15 times the time, and memory grows with the number of samples.
        devices: a sequence of JAX's devices, or a `jax.sharding.Mesh` of one axis, over which
            `jax.shard_map` shards the rays. Image and gradient are the same, and lie on all of these
            devices; so does the scene (a volume is copied to each once in its lifetime). By default JAX
            chooses one device. In a program of several processes (`jax.distributed.initialize()`) pass
            `jax.devices()` and make the same calls in all of them; each gets the whole image
            (`examples/several_processes.py`).
        antialias: number n of rays along the width and the height of each pixel, through the centers of
            n x n equal parts of it; by default one. A pixel is their mean (a box filter), its depth is
            weighted by their opacity. Time and memory grow with n². With a single ray, details smaller than
            a pixel move the image by jumps: the gradient of image statistics (entropy, histograms, edges)
            with respect to the camera is then mostly noise.
        until: (height, width) distances from the rays' origins, world length, at which rays end, such as
            those of an opaque mesh of another renderer, which hides the volume behind it. Infinite where a
            ray goes on to the exit; nothing is visible where it is below the entry. It is an exit like the
            volume's: `AlphaCorrection` cuts the last cell there, and makes gradients by `until` complete.
            A planar depth z along the view is the distance z / cos of the ray's angle to the view.

    Returns:
        A `Rendering` of shape (height, width), in JAX's default float type. If a number on which all pixels
        depend is NaN or infinite (a transfer function whose fit diverged, say), or, where it is traced, out
        of its range (a view angle of 180°, control points that decrease), the image and its gradient are NaN.
        A voxel that is NaN makes those pixels NaN whose rays sample it, or leave the volume next to it (0
        times NaN is NaN), unless matter in front of it is opaque or decides the pixel, as an isosurface does.
        An infinite voxel is a value beyond all others, and need not show. (`Volume` refuses both; they come
        from replacing its data.)

    Raises:
        ValueError: for an argument of another type (an array for a `Volume`, a camera in the march's place);
            for unknown outputs or adjoint; for `"direct"` where the step, the volume's place or a transform
            that bends space is traced and `march.max_samples` is not set; for `"auto"` where arrays are
            traced, and for a tolerance without it; for wrong `devices`, and for any inside a `jax.shard_map`;
            for an `antialias` that is no integer of at least 1; for an `until` of another shape or with NaN;
            for another number of channels than the transfer function, the mode or the lighting reads; and for
            a mode of differentiation that the adjoint does not support.

    `jax.vmap`, over any of the arguments, renders one image after the other, in one program, and so do
    gradients. Under `"direct"` and `"forward"`, images that are also differentiated, or compiled by a
    `jax.jit` within the `jax.vmap`, are rendered side by side: slower, with more memory.

    In float32, the gradient with respect to extinction is lost in rounding along rays of optical depth above
    14 (`experiments/stability.py`, "gradients of opaque rays").

    Second derivatives by voxels, camera and place leave out the bends of a piecewise linear transfer function
    at its control points; `quadrature="preintegrated"` smooths these over a cell, and has them. Those by
    camera and place also leave out the bends of the interpolated values at voxels' faces.

    Without `AlphaCorrection` an image jumps when a sample crosses the exit. The gradient with respect to the
    camera, the spacing and everything else that moves the exit misses these jumps, and is wrong by them.
    """
    order = "render(volume, transfer, camera, march)"
    grid, function = together(volume, transfer)
    if isinstance(march, str):
        if march != "auto":
            raise ValueError(f'march must be a jaxvol March or "auto"; got {march!r}.')
        check_arguments(order, volume=grid)
        tolerance = PLANNED if tolerance is None else tolerance
        from .planning import plan  # here, since few images need it

        planned = plan(grid, function, camera, tolerance, compositing=compositing, lighting=lighting)
        if not planned.within:
            warnings.warn(f"the image may not be within the tolerance: {planned}", stacklevel=2)
        march = planned.march
    elif tolerance is not None:
        raise ValueError(f'tolerance needs march="auto"; got tolerance={tolerance!r}, {described(march)}.')
    check_arguments(order, volume=grid, transfer=function, camera=camera, march=march, lighting=lighting)
    if lighting is not None:
        function = lighting.medium(function)
    _warn_of_step(grid, march)
    n, source = integer("antialias", antialias, 1), camera
    _warn_of_size(camera, n)
    if n > 1:
        source = finer(camera, n)
    if until is not None:
        until = finite_array("until", until, camera.size[::-1], infinite=True)
        source = Ending(source, until if n == 1 else jnp.kron(until, jnp.ones((n, n), until.dtype)))
    scene = Scene(grid, function, source, march, compositing_of(compositing), lighting)
    rendering = render_scene(scene, outputs, adjoint, devices=devices)
    return rendering if n == 1 else pooled(rendering, n)


def _warn_of_step(volume: Volume, march: March) -> None:
    """Warn of a step that is longer than the volume, if both are known and no transform bends the volume."""
    if is_traced(march.step, volume.spacing):
        return
    # JAX keeps what it brought to the host, so that no later image waits for the device here
    step, spacing = (np.asarray(array).tolist() for array in (march.step, volume.spacing))
    if step <= max(spacing) or march.overriding("locate"):
        return
    diagonal = math.hypot(*((n - 1) * s for n, s in zip(volume.shape, spacing, strict=True)))
    if step > diagonal:
        message = f"march.step is {step:.4g}, longer than the volume, which is {diagonal:.4g} across"
        warnings.warn(f"{message}; half a voxel is {min(spacing) / 2:.4g}.", stacklevel=3)


def _warn_of_size(camera: Camera, antialias: int) -> None:
    """Warn of an image that may take more than half of the memory that is left."""
    width, height = camera.size
    size = width * height * antialias**2 * BYTES
    if size > LARGE and size > (available := memory_available()) / 2:
        rays = "" if antialias == 1 else f" of {antialias} x {antialias} rays"
        message = f"{width} x {height} pixels{rays} take some {size / 2**30:.3g} GiB of memory"
        remedy = "render parts of the image, camera.crop(left, top, width, height), whose pixels are the same"
        warnings.warn(f"{message}, and {available / 2**30:.3g} GiB are left; {remedy}.", stacklevel=3)


def render_rays(
    volume: Volume | Sequence[Volume],
    transfer: Transfer | Sequence[Transfer],
    origins: Arrayable,
    directions: Arrayable,
    march: March,
    *,
    pixels: Arrayable | None = None,
    compositing: Mode | Compositing[Any] = "over",
    lighting: Lighting | None = None,
    outputs: RenderOutputs | Literal["samples"] = "all",
    most_samples: SupportsIndex | None = None,
    adjoint: Adjoint = "replay",
    devices: Devices | None = None,
    until: Arrayable | None = None,
) -> Rendering:
    """Render arbitrary rays. All other arguments are as for `render`.

    Args:
        origins: (*rays, 3) world points where rays begin.
        directions: (*rays, 3), of any length but 0. Distances are measured in world length.
        pixels: (*rays, 2) integers, (column, row), which key the random numbers of each ray. By default
            (index in the flattened array, 0). Within a `jax.shard_map` over the first axis, the index is that
            in the full array; but under `check_vma=False`, where a shard is not known as one, pass pixels, or
            all shards draw the same numbers.
        outputs: as for `render`; or `"samples"`: also `Rendering.ray_samples`, the depth, width, weight and
            colour of up to `most_samples` samples of each ray, for losses along rays (distortion, depth).
            They are those of the march, without what `SpaceLeaping` leaps over (which each ray does by
            itself), and their sums are the pixel's. A ray that needs more than `most_samples` samples or
            cells (with cells in gaps of the volume) ends there: it is `Rendering.exhausted`, and its pixel
            is that of its samples. Rays are marched by the reference's steps, and differentiated by JAX, in
            any mode and order, whatever the `adjoint`; memory grows with the number of samples.
        most_samples: number of samples, for `"samples"` only.
        until: (*rays,) distances at which rays end.

    Returns:
        A `Rendering` of shape `*rays`.

    Raises:
        ValueError: as `render`; and for shapes that differ or do not end in 3, NaN or infinity, and
            directions of length 0; for `"samples"` without `most_samples`, and with a compositing mode that
            does not weight samples.
    """
    if (outputs == "samples") != (most_samples is not None):
        raise ValueError(
            f'most_samples is needed for outputs="samples", and for no others; got outputs={outputs!r}, '
            f"most_samples={described(most_samples)}."
        )
    limit = None if most_samples is None else integer("most_samples", most_samples, 1, 2**24)
    order = "render_rays(volume, transfer, origins, directions, march)"
    grid, function = together(volume, transfer)
    check_arguments(order, volume=grid, transfer=function, march=march, lighting=lighting)
    if lighting is not None:
        function = lighting.medium(function)
    origins = finite_array("origins", origins, (..., 3))
    directions = finite_array("directions", directions, (..., 3))
    if origins.shape != directions.shape:
        raise ValueError(
            f"origins and directions must agree in shape; got {origins.shape} and {directions.shape}."
        )
    tiny = float(jnp.finfo(directions.dtype).tiny)
    message = f"directions must not have length 0, or below {tiny:.2g}."
    directions = _unit(require(directions, lambda d: (abs(d) >= tiny).any(-1, keepdims=True), message))
    count = jnp.asarray(math.prod(origins.shape[:-1]), jnp.int32)
    first = shard_number(origins, directions) * count
    source = GivenRays(origins, directions, _pixels(pixels, origins), first)
    if until is not None:
        source = Ending(source, finite_array("until", until, origins.shape[:-1], infinite=True))
    scene = Scene(grid, function, source, march, compositing_of(compositing), lighting)
    shown: RenderOutputs = "all" if outputs == "samples" else outputs
    return render_scene(scene, shown, adjoint, devices=devices, most_samples=limit)


@jax.jit
def _unit(directions: Float[Array, "*rays 3"]) -> Float[Array, "*rays 3"]:
    """Scale directions to length 1. Squares of long and short ones would overflow and underflow."""
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(directions), axis=-1, keepdims=True))
    directions = directions / jnp.where((largest > 1e-9) & (largest < 1e9), 1, largest)
    return directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)


def _pixels(pixels: Arrayable | None, origins: Float[Array, "*rays 3"]) -> Int[Array, "*rays 2"] | None:
    if pixels is None:
        return None
    pixels, shape = jnp.asarray(pixels), (*origins.shape[:-1], 2)
    if pixels.shape != shape or not jnp.issubdtype(pixels.dtype, jnp.integer):
        raise ValueError(f"pixels must be integers of shape {shape}; got {pixels.dtype} of {pixels.shape}.")
    return pixels.astype(jnp.int32)
