"""Results of a render: the image, optional outputs, and how notebooks show it."""

import os
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._util.checks import Arrayable, described
from .._util.srgb import displayed, linear_color, png_of, warn_of_8_bits
from ..xla.platform import is_traced, on_gpu
from ..xla.trees import PyTree


class BrickReport(NamedTuple):
    """Bricks, bytes and memory of an image by `render_bricks`."""

    counts: tuple[int, int, int]
    """Bricks along x, y and z."""
    needed: int
    """Number of bricks that may hold anything visible."""
    loads: int
    """Number of times a brick was read."""
    reloads: int
    """Number of loads except the first one of each brick."""
    bytes_read: int
    """Bytes of voxels read, including the margin of each brick."""
    stored: tuple[int, int, int]
    """Voxels along x, y and z that are held at a time."""
    bytes_held: int
    """Memory of the voxels held, of the data derived from them, and of the next brick."""


class RaySamples(eqx.Module):
    """The samples of rays, front to back, each with the part of the ray that it represents: what losses along
    rays need. Where a ray has fewer samples than the arrays have room for, the last ones have the weight,
    width and colour 0, at the depth of the ray's exit.

    Attributes:
        depth: distance from the ray's origin to the sample, world length. A sample is at the front of its
            part of the ray under `quadrature="left"`, otherwise in its middle.
        width: length of that part, world length.
        weight: its share of the pixel, T α under `"over"`. The weights of a ray sum to its opacity, weights
            times colours to its premultiplied colour.
        color: colours, linear and lit, not premultiplied.
    """

    depth: Float[Array, "*rays samples"]
    width: Float[Array, "*rays samples"]
    weight: Float[Array, "*rays samples"]
    color: Float[Array, "*rays samples colors"]


class Details(NamedTuple):
    """Outputs that cost time; None for those not requested. See `Rendering`."""

    depth: Float[Array, "*rays"] | None = None
    samples: Int[Array, "*rays"] | None = None
    aligned: Bool[Array, "*rays"] | None = None
    normal: Float[Array, "*rays 3"] | None = None
    selected: PyTree = None
    """The final state of a `Selection`, for `ray.resolve`; None in an image."""
    bricks: BrickReport | None = None
    ray_samples: RaySamples | None = None


class Rendering(eqx.Module):
    """The image and other outputs of rays. The leading shape is that of the rays: (height, width) for a
    camera.

    Attributes:
        rgba: linear colour, premultiplied by opacity, and opacity; not composited over a background. A
            `Transfer` of n colours gives n + 1 numbers, the opacity last.
        exhausted: whether the ray reached `March.max_samples` before its end.
        depth: mean distance from the ray's origin to visible cells, weighted by their contributions to the
            opacity, world length; infinite where nothing is visible.
        samples: number of samples evaluated, one for each piece of a cell.
        aligned: whether a visible last cell was cut at the exit (Kye 2013, Fig. 13).
        normal: unit normal of an `Isosurface` in the world; 0 where nothing is visible.
        bricks: the `BrickReport` of `render_bricks`.
        ray_samples: the `RaySamples` of `render_rays(..., outputs="samples")`.
        background: linear RGB of the default background of `image` and of the notebook's picture; white
            unless set by `jaxvol.show`. Static.

    A notebook displays it as the last line of a cell; `show` displays it anywhere.

    With `antialias`, a pixel has the mean `rgba` of its rays, the means of `depth` and `normal` weighted by
    opacity, and the sum of `samples`; it is `exhausted` or `aligned` if any of its rays is.

    `depth`, `samples`, `aligned`, `normal`, `bricks` and `ray_samples` raise `AttributeError` if not
    computed, as with `outputs="rgba"`. Modes other than `"over"` document their depth.
    """

    rgba: Float[Array, "*rays numbers"]
    exhausted: Bool[Array, "*rays"]
    details: Details = Details()
    background: tuple[float, ...] = eqx.field(static=True, default=(1.0, 1.0, 1.0))

    @property
    def opacity(self) -> Float[Array, "*rays"]:
        """The last number of `rgba`."""
        return self.rgba[..., self.rgba.shape[-1] - 1]

    @property
    def depth(self) -> Float[Array, "*rays"]:
        return self._detail("depth")

    @property
    def samples(self) -> Int[Array, "*rays"]:
        return self._detail("samples")

    @property
    def aligned(self) -> Bool[Array, "*rays"]:
        return self._detail("aligned")

    @property
    def normal(self) -> Float[Array, "*rays 3"]:
        return self._detail("normal", "composite by an Isosurface, and ")

    @property
    def bricks(self) -> BrickReport:
        return self._detail("bricks", "render it by render_bricks, and ")

    @property
    def ray_samples(self) -> RaySamples:
        return self._detail("ray_samples", "render it by render_rays, and ", "samples")

    def _detail(self, name: str, condition: str = "", outputs: str = "all") -> Any:
        if (value := getattr(self.details, name)) is None:
            raise AttributeError(
                f'{name} is not part of this rendering: {condition}pass outputs="{outputs}".'
            )
        return value

    def image(self, background: Arrayable | None = None) -> Float[Array, "*rays 3"]:
        """Linear RGB over a background: one colour, (3,) or by name ("white"), or an image of the same shape;
        by default `self.background`.

        Raises:
            ValueError: for a background of another shape or with NaN or infinity, and an unknown name.

        Warns of 8-bit colours.
        """
        if (numbers := self.rgba.shape[-1]) != 4:
            raise ValueError(f"image needs a rendering of three colours; this one has {numbers - 1}.")
        background = self.background if background is None else background
        background = linear_color("background", background, (..., 3))
        warn_of_8_bits("background", background, stacklevel=3)
        background = jnp.asarray(background, self.rgba.dtype)
        if background.shape not in ((3,), shape := (*self.rgba.shape[:-1], 3)):
            expected = f"one colour (3,) or an image {shape}"
            raise ValueError(f"background must be {expected}; got shape {background.shape}.")
        if is_traced(self.rgba, background) or on_gpu():
            return _over(self.rgba, background)
        rgba, background = np.asarray(self.rgba), np.asarray(background)
        return jnp.asarray(rgba[..., :3] + (1 - rgba[..., 3:]) * background, rgba.dtype)

    def show(self) -> None:
        """Show the image over its background: below the cell of a notebook, or else in a window of
        matplotlib, until it is closed.

        Raises:
            ValueError: for a traced rendering, or rays that are no image.

        Warns if nothing is visible in the image.
        """
        if self.rgba.ndim != 3 or is_traced(self.rgba):
            raise ValueError(f"show needs an image whose numbers are known; got {described(self.rgba)}.")
        if in_notebook():
            sys.modules["IPython"].display.display(self)
            return
        _warn_if_empty(self)
        open_window(self, stacklevel=4)

    def _repr_png_(self) -> bytes | None:
        """The image as a PNG, for notebooks; None for rays that are no image."""
        if self.rgba.ndim != 3 or self.rgba.shape[-1] != 4 or is_traced(self.rgba):
            return None
        _warn_if_empty(self)
        return png_of(displayed(np.asarray(self.image(), np.float32)))


def _warn_if_empty(rendering: Rendering) -> None:
    if not np.asarray(rendering.rgba)[..., -1].any():  # NaN is not nothing
        causes = "does the camera see the volume, and the transfer function show its values?"
        warning = f"nothing is visible, all pixels are transparent: {causes} jaxvol.show says why."
        warnings.warn(warning, stacklevel=4)  # the caller of a method, which equinox wraps


def open_window(rendering: Rendering, stacklevel: int = 3) -> None:
    """Show an image over its background in a window of matplotlib, until it is closed."""
    import matplotlib.pyplot as plt

    if plt.get_backend().lower() == "agg" and "MPLBACKEND" not in os.environ:  # as without a display
        path = next(p for k in range(1000) if not (p := Path(f"jaxvol-{k}.png").resolve()).exists())
        path.write_bytes(png_of(displayed(np.asarray(rendering.image(), np.float32))))
        warnings.warn(f"matplotlib opens no window (agg): the image is in {path}", stacklevel=stacklevel)
        return
    pixels = displayed(np.asarray(rendering.image(), np.float32))
    figure = plt.figure(figsize=np.divide(pixels.shape[1::-1], 100).tolist(), dpi=100)
    figure.figimage(pixels)
    plt.show()
    plt.close(figure)


def in_notebook() -> bool:
    """True inside a notebook's kernel, whose cells display their last value."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


@partial(jax.jit, static_argnums=1)
def pooled(rendering: Rendering, n: int) -> Rendering:
    """The image with each n x n pixels averaged."""
    height, width = (size // n for size in rendering.exhausted.shape)

    def of_pixels(reduce: Callable[..., Array], tree: PyTree) -> Any:
        return jax.tree.map(
            lambda leaf: reduce(leaf.reshape(height, n, width, n, *leaf.shape[2:]), axis=(1, 3)), tree
        )

    mean, details, opacity = partial(of_pixels, jnp.mean), rendering.details, rendering.opacity
    depth, normal, samples = details.depth, details.normal, details.samples
    if depth is not None:
        visible = ~jnp.isinf(depth)
        weight = jnp.where(visible, opacity, 0)
        total, sums = mean((weight, weight * jnp.where(visible, depth, 0)))
        depth = jnp.where(total == 0, jnp.inf, sums / jnp.where(total == 0, 1, total))
    if normal is not None:
        normal = mean(opacity[..., None] * normal)
        square = jnp.sum(normal * normal, axis=-1, keepdims=True)
        normal = normal / jnp.sqrt(jnp.where(square == 0, 1, square))
    if samples is not None:
        samples = of_pixels(partial(jnp.sum, dtype=samples.dtype), samples)
    exhausted, aligned = of_pixels(jnp.any, (rendering.exhausted, details.aligned))
    details = Details(depth, samples, aligned, normal)
    return Rendering(mean(rendering.rgba), exhausted, details)


@jax.jit
def _over(rgba: Float[Array, "*rays 4"], background: Float[Array, "..."]) -> Float[Array, "*rays 3"]:
    background = jnp.broadcast_to(background, (*rgba.shape[:-1], 3))
    return rgba[..., :3] + (1 - rgba[..., 3:]) * background
