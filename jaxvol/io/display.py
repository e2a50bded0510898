"""Files and side-by-side figures of linear images."""

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .._util.checks import Arrayable, described, integer, output_file
from .._util.srgb import displayed, png_of, to_srgb, warn_of_8_bits
from .._util.whole_files import whole_file


def save_image(
    path: str | os.PathLike[str], linear: Arrayable, *, text: Mapping[str, str] | None = None
) -> Path:
    """Write an image in the format of the file extension:

    | extension | contents |
    |---|---|
    | `.png` | 8-bit sRGB; with opacity, transparent (straight alpha) |
    | `.jpg`, `.jpeg` | 8-bit sRGB, no opacity |
    | `.tif`, `.tiff` | linear float32, unchanged; with opacity, premultiplied (associated alpha) |
    | `.npy` | linear float32, unchanged; read it with `numpy.load` |

    A viewer blends a transparent PNG over its background in sRGB, `Rendering.image` blends in linear light;
    the results differ where the opacity lies between 0 and 1.

    Args:
        path: of the file. It comes first, as in `matplotlib.pyplot.imsave`; `save`, of volumes, has it last.
        linear: linear RGB, (height, width, 3), as from `Rendering.image`; or premultiplied RGBA, (height,
            width, 4), as `Rendering.rgba`; or one channel, (height, width), as `Rendering.depth`, which may
            be infinite. 8-bit formats clip to [0, 1].
        text: texts by keyword (1 to 79 letters of Latin-1), stored in a PNG, as `Image.info` of Pillow;
            other formats ignore them.

    Returns:
        The path. Its folder is created if it does not exist. The write is atomic.

    Raises:
        ValueError: for input that is not an array, an unknown extension, a shape that the format cannot
            hold, NaN, infinite colours, and a path that cannot be written.
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path must be a str or a path; got {described(path)}. The path comes first.")
    image = _numbers("linear", linear, (0, 3, 4))
    channels = image.shape[2] if image.ndim == 3 else 0
    path = image_file("path", path, channels)
    ending = path.suffix.lower()
    if channels and not np.isfinite(image).all():
        raise ValueError(f"linear must not be infinite; {np.isinf(image).sum()} of {image.size} values are.")
    if channels and ending not in (".npy", ".tif", ".tiff"):
        warn_of_8_bits("linear", image, stacklevel=3)
    with whole_file(path) as part:
        if ending == ".npy":
            np.save(part, image)
        elif ending in (".tif", ".tiff"):
            from tifffile import imwrite

            kind = "minisblack" if channels == 0 else "rgb"
            imwrite(part, image, photometric=kind, extrasamples=["assocalpha"] if channels == 4 else None)
        elif ending == ".png":
            part.write_bytes(png_of(displayed(image), text or {}))
        else:
            from PIL import Image

            Image.fromarray(displayed(image)).save(part)
    return path


def save_png(path: str | os.PathLike[str], linear: Arrayable) -> Path:
    """Write an image as PNG: `save_image` for a path that must end in `.png`.

    Args:
        path: as for `save_image`.
        linear: as for `save_image`, with three or four channels.

    Returns:
        The path.

    Raises:
        ValueError: as `save_image` does, and for another ending.
    """
    if isinstance(path, str | os.PathLike) and Path(path).suffix.lower() != ".png":
        raise ValueError(f"path must end in .png; got {Path(path)}. save_image writes other formats.")
    return save_image(path, linear)


GAP, TITLE = 6, 20
"""Pixels between images that `show_images` draws, and height of the titles above them."""

INSET = 1e-3
"""Inset of an image in pixels: at a pixel's edge, matplotlib below 3.11 may draw one row more or less."""


def show_images(images: Mapping[str, Arrayable], columns: int = 3) -> None:
    """Draw linear images side by side under their names, with matplotlib, for notebooks. They are not
    resampled, which would hide sampling artifacts: one pixel of an image is one pixel of the page.

    Args:
        images: by name, linear RGB (height, width, 3), as from `Rendering.image`, or grey (height, width).
            Values outside of [0, 1] are clipped. Sizes may differ.
        columns: maximum number of images in a row.

    Raises:
        ValueError: for no image, an image of another shape, NaN, and a number of columns below 1.
    """
    if not isinstance(images, Mapping) or not images:
        raise ValueError(f"images must be a dict of at least one image by name; got {described(images)}.")
    arrays = {name: _numbers(f"images[{name!r}]", image, (0, 3)) for name, image in images.items()}
    columns = min(integer("columns", columns, 1), len(arrays))
    rows = math.ceil(len(arrays) / columns)
    height, width = (max(image.shape[axis] for image in arrays.values()) for axis in (0, 1))
    page_width, page_height = columns * (width + GAP) + GAP, rows * (height + TITLE + GAP)

    import matplotlib.pyplot as plt  # slow to import

    figure = plt.figure(figsize=(page_width / 100, page_height / 100), dpi=100)
    for index, (name, image) in enumerate(arrays.items()):
        row, column = divmod(index, columns)
        x, bottom = GAP + column * (width + GAP), row * (height + TITLE + GAP) + TITLE + image.shape[0]
        box = x + INSET, page_height - bottom + INSET, *(n - 2 * INSET for n in image.shape[1::-1])
        axes = figure.add_axes(np.divide(box, (page_width, page_height) * 2).tolist())
        axes.imshow(np.asarray(to_srgb(image)), cmap="gray", vmin=0, vmax=1, interpolation="none")
        axes.set_axis_off()
        axes.set_title(str(name), fontsize=9, loc="left", pad=3)
    plt.show()


def _numbers(name: str, image: Arrayable, channels: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Convert to an array, and check that its number of channels (0: no such axis) is one of `channels`."""
    try:
        numbers = np.asarray(image, np.float32)
    except (TypeError, ValueError) as fault:
        text = f"{name} must be an array of numbers; got {described(image)}"
        raise ValueError(f"{text}. For a Rendering, pass rendering.image().") from fault
    count = 0 if numbers.ndim == 2 else numbers.shape[2] if numbers.ndim == 3 else -1
    if count not in channels or numbers.size == 0:
        shapes = ["(height, width)" if n == 0 else f"(height, width, {n})" for n in channels]
        raise ValueError(f"{name} must have shape {' or '.join(shapes)}; got {numbers.shape}.")
    if np.isnan(numbers).any():
        raise ValueError(f"{name} must not be NaN; {np.isnan(numbers).sum()} of its values are.")
    return numbers


def image_file(name: str, path: str | os.PathLike[str], channels: int) -> Path:
    """Check, before rendering, that an image with `channels` (0: no such axis) can be written to `path`."""
    path, content = Path(path), {0: "one channel", 3: "colours", 4: "colours and opacity"}[channels]
    endings = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")
    endings = {0: endings[3:], 3: endings, 4: (".png", *endings[3:])}[channels]
    if path.suffix.lower() not in endings:
        raise ValueError(f"{name}: a file of {content} must end in one of {', '.join(endings)}; got {path}.")
    return output_file(name, path)
