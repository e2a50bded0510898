"""How does linear light become a picture file? Through the sRGB curve."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .checks import Arrayable


def to_srgb(linear: Arrayable) -> Float[Array, "*image"]:
    """Linear colour to sRGB display values, both in [0, 1]; what lies outside is clipped."""
    linear = jnp.clip(jnp.asarray(linear), 0, 1)
    curved = 1.055 * jnp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return jnp.where(linear <= 0.0031308, 12.92 * linear, curved)


def from_srgb(display: Arrayable) -> Float[Array, "*image"]:
    """sRGB display values (as of a matplotlib colormap) to linear colour, both in [0, 1]."""
    display = jnp.clip(jnp.asarray(display), 0, 1)
    return jnp.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def save_png(path: str | os.PathLike[str], linear: Arrayable) -> Path:
    """Write a linear RGB image (height, width, 3) as an 8-bit sRGB PNG.

    **Raises:** `ValueError` for another shape and for NaN.
    """
    from skimage.io import imsave

    image = np.asarray(linear)
    if image.ndim != 3 or image.shape[-1] != 3:
        raise ValueError(f"image must have shape (height, width, 3); got {image.shape}.")
    if np.isnan(image).any():
        raise ValueError(f"image must not hold NaN; got {int(np.isnan(image).sum())} in {image.size} values.")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, np.asarray(jnp.round(to_srgb(image) * 255)).astype(np.uint8), check_contrast=False)
    return path
