"""The sRGB curve: linear colour to display values, and back."""

import io
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..xla.platform import is_traced
from .checks import Arrayable, described, finite_array


BRIGHTEST = 8.0
"""Of colours, above which they are hardly meant as linear RGB."""


def to_srgb(linear: Arrayable) -> Float[Array, "*image"]:
    """Linear colour to sRGB display values, both in [0, 1]; values outside are clipped.

    Args:
        linear: colours, of any shape.

    Returns:
        The values, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _to_srgb(jnp.asarray(linear))


def from_srgb(display: Arrayable) -> Float[Array, "*image"]:
    """sRGB display values (as of a matplotlib colormap) to linear colour, both in [0, 1].

    Args:
        display: values, of any shape.

    Returns:
        The colours, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _from_srgb(jnp.asarray(display))


def linear_color(name: str, color: Any, shape: Any = (3,)) -> Any:
    """Linear RGB of this shape; or a name that matplotlib knows: "white", "#336699"."""
    if isinstance(color, str):
        from matplotlib.colors import to_rgb

        try:
            display = np.array(to_rgb(color))
        except ValueError as fault:
            expected = 'a colour\'s name, such as "white", or linear RGB'
            raise ValueError(f"{name} must be {expected}; got {described(color)}.") from fault
        with jax.ensure_compile_time_eval():
            return from_srgb(display)
    # a traced one may be NaN, which then shows in the image
    return color if is_traced(color) else finite_array(name, color, shape)


def warn_of_8_bits(name: str, colors: Any, stacklevel: int = 4) -> None:
    """Warn of colours that are hardly meant as linear RGB, where they are known."""
    if not is_traced(colors) and (most := float(np.asarray(colors).max())) > BRIGHTEST:
        told = f"{name} must be linear RGB, where white is 1; got up to {most:g}"
        warnings.warn(f"{told}. For 8-bit colours, pass jv.from_srgb({name} / 255).", stacklevel=stacklevel)


def displayed(
    image: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """Linear RGB, or premultiplied RGBA, as 8-bit sRGB with straight alpha."""
    color, opacity = image[..., :3], image[..., 3:]
    # straight alpha: viewers multiply by the opacity
    color = np.divide(color, opacity, out=np.zeros_like(color), where=opacity > 0) if opacity.size else color
    return np.asarray(_in_8_bits(color, opacity)).astype(np.uint8)


def png_of(pixels: UInt8[np.ndarray, "height width channels"], text: Mapping[str, str] = {}) -> bytes:
    """A PNG, with texts by keyword."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    file, chunks = io.BytesIO(), PngInfo()
    for keyword, content in text.items():
        chunks.add_itxt(keyword, content, zip=True)
    Image.fromarray(pixels).save(file, "PNG", pnginfo=chunks)
    return file.getvalue()


# Jitted: one program for each shape, rather than one for each operation.


@jax.jit
def _to_srgb(linear: Array) -> Float[Array, "*image"]:
    linear = jnp.clip(linear, 0, 1)
    curved = 1.055 * jnp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return jnp.where(linear <= 0.0031308, 12.92 * linear, curved)


@jax.jit
def _from_srgb(display: Array) -> Float[Array, "*image"]:
    display = jnp.clip(display, 0, 1)
    return jnp.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


@jax.jit
def _in_8_bits(color: Any, opacity: Any) -> Float[Array, "height width channels"]:
    return jnp.round(jnp.concatenate([_to_srgb(color), jnp.clip(opacity, 0, 1)], axis=-1) * 255)
