"""How does linear light become a picture file? Through the sRGB curve."""

import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._util.checks import Arrayable, described, output_file


def to_srgb(linear: Arrayable) -> Float[Array, "*image"]:
    """Linear colour to sRGB display values, both in [0, 1]; what lies outside is clipped."""
    linear = jnp.clip(jnp.asarray(linear), 0, 1)
    curved = 1.055 * jnp.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return jnp.where(linear <= 0.0031308, 12.92 * linear, curved)


def from_srgb(display: Arrayable) -> Float[Array, "*image"]:
    """sRGB display values (as of a matplotlib colormap) to linear colour, both in [0, 1]."""
    display = jnp.clip(jnp.asarray(display), 0, 1)
    return jnp.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def save_image(path: str | os.PathLike[str], linear: Arrayable) -> Path:
    """Write an image, in the format that the ending of its name tells:

    | ending | what is written |
    |---|---|
    | `.png` | sRGB, 8 bits; with opacity, transparent (straight alpha) |
    | `.jpg`, `.jpeg` | sRGB, 8 bits, no opacity |
    | `.tif`, `.tiff` | linear float32, as it is; with opacity, premultiplied (associated alpha) |
    | `.npy` | linear float32, as it is: `numpy.load` reads it |

    **Arguments:**

    - `linear`: linear RGB, (height, width, 3), as `Rendering.image` gives; with opacity, (height, width, 4),
      as `Rendering.rgba`, premultiplied; or one channel, (height, width), as `Rendering.depth`, which may be
      infinite. 8 bits clip what lies outside [0, 1].

    **Returns:** the path. Its folder is made where there is none.

    **Raises:** `ValueError` for what is no array, another ending, a shape that the format does not hold, NaN,
    colours that are infinite, and a path that cannot be written.

    A viewer blends a transparent PNG over its background in sRGB; `Rendering.image` does so in linear light,
    which looks different where the opacity lies between 0 and 1.
    """
    try:
        image = np.asarray(linear, np.float32)
    except (TypeError, ValueError) as fault:
        given = f"linear must be an array of numbers; got {described(linear)}."
        raise ValueError(f"{given} Of a Rendering, give rendering.image() or rendering.rgba.") from fault
    channels = image.shape[2] if image.ndim == 3 else 0 if image.ndim == 2 else None
    if channels not in (0, 3, 4) or 0 in image.shape:
        raise ValueError(
            "image must have shape (height, width, 3), (height, width, 4) or (height, width); "
            f"got {image.shape}."
        )
    path = image_file("path", path, channels)
    bad = np.isnan(image) if channels == 0 else ~np.isfinite(image)
    if bad.any():
        raise ValueError(f"image must not be NaN or infinite; {bad.sum()} of its {image.size} values are.")
    ending = path.suffix.lower()
    if ending == ".npy":
        np.save(path, image)
    elif ending in (".tif", ".tiff"):
        _save_tiff(path, image)
    else:
        _save_display(path, image)
    return path


def save_png(path: str | os.PathLike[str], linear: Arrayable) -> Path:
    """`save_image` for a path that must end in `.png`: linear RGB (height, width, 3) as 8-bit sRGB, or
    premultiplied RGBA (height, width, 4) as a transparent one."""
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"path must end in .png; got {Path(path)}. save_image writes other formats.")
    return save_image(path, linear)


CHANNELS = {
    ".png": (3, 4),
    ".jpg": (3,),
    ".jpeg": (3,),
    ".tif": (0, 3, 4),
    ".tiff": (0, 3, 4),
    ".npy": (0, 3, 4),
}
"""How many channels an image of each format may have; 0: it has no axis of channels."""


def image_file(name: str, path: str | os.PathLike[str], channels: int) -> Path:
    """The path of an image with so many channels, once it is known that it can be written there: asked before
    the image is made."""
    path, what = Path(path), {0: "depth", 3: "colours", 4: "colours and opacity"}[channels]
    fitting = [ending for ending, counts in CHANNELS.items() if channels in counts]
    if path.suffix.lower() not in fitting:
        raise ValueError(f"{name}: a file of {what} must end in one of {', '.join(fitting)}; got {path}.")
    return output_file(name, path)


def _save_tiff(path: Path, image: Float[np.ndarray, "..."]) -> None:
    from tifffile import imwrite

    extra = ["assocalpha"] if image.shape[2:] == (4,) else None
    imwrite(path, image, photometric="rgb" if image.ndim == 3 else "minisblack", extrasamples=extra)


def _save_display(path: Path, image: Float[np.ndarray, "height width channels"]) -> None:
    from skimage.io import imsave

    color, opacity = image[..., :3], image[..., 3:]
    # straight: a viewer multiplies by the opacity itself
    color = np.divide(color, opacity, out=np.zeros_like(color), where=opacity > 0) if opacity.size else color
    display = jnp.concatenate([to_srgb(color), jnp.clip(opacity, 0, 1)], axis=-1)
    imsave(path, np.asarray(jnp.round(display * 255)).astype(np.uint8), check_contrast=False)
