"""Conversions between linear colour and sRGB display values, and PNG files."""

import io
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from types import EllipsisType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..xla.platform import is_traced
from .checks import Arrayable, described, finite_array


BRIGHTEST = 8.0
"""Component of a colour above which it is hardly meant as linear RGB."""


def to_srgb(linear: Arrayable) -> Float[Array, "*image"]:
    """Convert linear colour to sRGB display values, both in [0, 1]; values outside are clipped.

    Args:
        linear: colours, of any shape.

    Returns:
        The values, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _by_curve(_to_srgb, linear)


def from_srgb(display: Arrayable) -> Float[Array, "*image"]:
    """Convert sRGB display values (as of a matplotlib colormap) to linear colour, both in [0, 1].

    Args:
        display: values, of any shape.

    Returns:
        The colours, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _by_curve(_from_srgb, display)


def linear_color(name: str, color: Arrayable, shape: tuple[int | EllipsisType | None, ...] = (3,)) -> Any:
    """Check linear RGB of a shape, or convert a name that matplotlib knows: "white", "#336699"."""
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


def warn_of_8_bits(name: str, colors: Arrayable, stacklevel: int = 4) -> None:
    """Warn of colours, unless traced, that are hardly meant as linear RGB."""
    if not is_traced(colors) and (maximum := float(np.asarray(colors).max())) > BRIGHTEST:
        fault = f"{name} must be linear RGB, where white is 1; got up to {maximum:g}"
        warnings.warn(f"{fault}. For 8-bit colours, pass jv.from_srgb({name} / 255).", stacklevel=stacklevel)


def displayed(
    image: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """Convert linear RGB, or premultiplied RGBA, to 8-bit sRGB with straight alpha."""
    color, opacity = image[..., :3], image[..., 3:]
    # straight alpha: viewers multiply by the opacity
    color = np.divide(color, opacity, out=np.zeros_like(color), where=opacity > 0) if opacity.size else color
    channels = [_to_srgb(color, np), np.clip(opacity, 0, 1)]
    return np.round(np.concatenate(channels, axis=-1) * 255).astype(np.uint8)


def png_of(pixels: UInt8[np.ndarray, "height width channels"], text: Mapping[str, str] = {}) -> bytes:
    """Bytes of a PNG, with texts by keyword."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    file, chunks = io.BytesIO(), PngInfo()
    for keyword, content in text.items():
        chunks.add_itxt(keyword, content, zip=True)
    Image.fromarray(pixels).save(file, "PNG", pnginfo=chunks)
    return file.getvalue()


def _by_curve(curve: Callable[[Any, Any], Any], values: Any) -> Float[Array, "*image"]:
    if isinstance(values, jax.Array) or is_traced(values):
        return _on_device(curve, jnp.asarray(values))
    result, dtype = curve(np.asarray(values), np), jnp.result_type(float)  # compiles nothing
    return jnp.asarray(result.astype(dtype), dtype)


@partial(jax.jit, static_argnums=0)  # one program per shape, rather than one per operation
def _on_device(curve: Callable[[Any, Any], Any], values: Array) -> Array:
    return curve(values, jnp)


def _to_srgb(linear: Any, xp: Any) -> Any:
    linear = xp.clip(linear, 0, 1)
    curved = 1.055 * xp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return xp.where(linear <= 0.0031308, 12.92 * linear, curved)


def _from_srgb(display: Any, xp: Any) -> Any:
    display = xp.clip(display, 0, 1)
    return xp.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
