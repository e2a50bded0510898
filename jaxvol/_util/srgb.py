"""The sRGB curve: linear colour to display values, and back."""

import io
import warnings
from collections.abc import Callable, Mapping
from functools import partial
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
    return _by_curve(_to_srgb, linear)


def from_srgb(display: Arrayable) -> Float[Array, "*image"]:
    """sRGB display values (as of a matplotlib colormap) to linear colour, both in [0, 1].

    Args:
        display: values, of any shape.

    Returns:
        The colours, of the same shape.

    Source: IEC 61966-2-1.
    """
    return _by_curve(_from_srgb, display)


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
    shown = [_to_srgb(color, np), np.clip(opacity, 0, 1)]
    return np.round(np.concatenate(shown, axis=-1) * 255).astype(np.uint8)


def png_of(pixels: UInt8[np.ndarray, "height width channels"], text: Mapping[str, str] = {}) -> bytes:
    """A PNG, with texts by keyword."""
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
    found, dtype = curve(np.asarray(values), np), jnp.result_type(float)  # compiles nothing
    return jnp.asarray(found.astype(dtype), dtype)


@partial(jax.jit, static_argnums=0)  # one program for each shape, rather than one for each operation
def _on_device(curve: Callable[[Any, Any], Any], values: Array) -> Array:
    return curve(values, jnp)


def _to_srgb(linear: Any, xp: Any) -> Any:
    linear = xp.clip(linear, 0, 1)
    curved = 1.055 * xp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return xp.where(linear <= 0.0031308, 12.92 * linear, curved)


def _from_srgb(display: Any, xp: Any) -> Any:
    display = xp.clip(display, 0, 1)
    return xp.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
