"""Saves linear images as files, and shows them side by side."""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .._util.checks import Arrayable, described, integer, output_file
from .._util.srgb import displayed, png_of, to_srgb, warn_of_8_bits
from .._util.whole_files import whole_file


def save_image(
    path: str | os.PathLike[str] | Any, linear: Arrayable, *, text: Mapping[str, str] | None = None
) -> Path:
    """Write an image, in the format given by the file extension:

    | extension | contents |
    |---|---|
    | `.png` | 8-bit sRGB; with opacity, transparent (straight alpha) |
    | `.jpg`, `.jpeg` | 8-bit sRGB, no opacity |
    | `.tif`, `.tiff` | linear float32, unchanged; with opacity, premultiplied (associated alpha) |
    | `.npy` | linear float32, unchanged; read it with `numpy.load` |

    A viewer blends a transparent PNG over its background in sRGB, `Rendering.image` blends in linear light;
    the two look different where the opacity lies between 0 and 1.

    Args:
        path: of the file. It comes first, as in `matplotlib.pyplot.imsave`; `save`, of volumes, has it last.
        linear: linear RGB, (height, width, 3), as from `Rendering.image`; or premultiplied RGBA, (height,
            width, 4), as `Rendering.rgba`; or one channel, (height, width), as `Rendering.depth`, which may
            be infinite. 8-bit formats clip to [0, 1].
        text: texts by keyword (1 to 79 letters of Latin-1) that a PNG carries, as `Image.info` of Pillow has
            them; other formats carry none.

    Returns:
        The path. Its folder is created if it does not exist. The file appears whole or not at all.

    Raises:
        ValueError: for input that is not an array, an unknown extension, a shape that the format does not
            hold, NaN, infinite colours, and a path that cannot be written.
    """
    if not isinstance(path, str | os.PathLike):
        told = f"path must be a str or a path; got {described(path)}"
        raise ValueError(f"{told}. It comes first, as in save_png(path, image).")
    image = _numbers("linear", linear, (0, 3, 4))
    channels = image.shape[2] if image.ndim == 3 else 0
    path = image_file("path", path, channels)
    ending = path.suffix.lower()
    if channels and not np.isfinite(image).all():
        raise ValueError(
            f"linear must not be infinite; {np.isinf(image).sum()} of its {image.size} values are."
        )
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


def save_png(path: str | os.PathLike[str] | Any, linear: Arrayable) -> Path:
    """`save_image` for a path that must end in `.png`.

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
"""Pixels between images that `show_images` draws, and of the line above each that names it."""

INSET = 1e-3
"""Inset of an image, pixels: on an edge between two, matplotlib below 3.11 may draw a row more or less."""


def show_images(images: Mapping[str, Arrayable] | Any, columns: int | Any = 3) -> None:
    """Draw linear images side by side, each under its name, with matplotlib: one pixel of the page for each
    of theirs, since resampling would hide what samples do. It is for notebooks, where the picture appears
    under the cell.

    Args:
        images: by name, linear RGB (height, width, 3), as from `Rendering.image`, or grey (height, width).
            Values outside of [0, 1] are clipped. Sizes may differ.
        columns: how many images stand in a row at most.

    Raises:
        ValueError: for no image, an image of another shape, NaN, and a number of columns below 1.
    """
    if not isinstance(images, Mapping) or not images:
        raise ValueError(
            f"images must be a dict of at least one image, such as {{'head': ...}}; got {described(images)}."
        )
    shown = {name: _numbers(f"images[{name!r}]", image, (0, 3)) for name, image in images.items()}
    columns = min(integer("columns", columns, 1), len(shown))
    rows = math.ceil(len(shown) / columns)
    height, width = (max(image.shape[axis] for image in shown.values()) for axis in (0, 1))
    across, down = columns * (width + GAP) + GAP, rows * (height + TITLE + GAP)

    import matplotlib.pyplot as plt  # here: slow to import, and only pictures need it

    figure = plt.figure(figsize=(across / 100, down / 100), dpi=100)
    for place, (name, image) in enumerate(shown.items()):
        row, column = divmod(place, columns)
        left, top = GAP + column * (width + GAP), row * (height + TITLE + GAP) + TITLE
        box = left + INSET, down - top - image.shape[0] + INSET, *(n - 2 * INSET for n in image.shape[1::-1])
        axes = figure.add_axes(np.divide(box, (across, down, across, down)).tolist())
        axes.imshow(np.asarray(to_srgb(image)), cmap="gray", vmin=0, vmax=1, interpolation="none")
        axes.set_axis_off()
        axes.set_title(str(name), fontsize=9, loc="left", pad=3)
    plt.show()


def _numbers(name: str, image: Any, channels: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """An image with one of these numbers of channels; 0: no axis of channels."""
    try:
        numbers = np.asarray(image, np.float32)
    except (TypeError, ValueError) as fault:
        told = f"{name} must be an array of numbers; got {described(image)}"
        raise ValueError(f"{told}. For a Rendering, pass rendering.image().") from fault
    shapes = ["(height, width)" if n == 0 else f"(height, width, {n})" for n in channels]
    found = 0 if numbers.ndim == 2 else numbers.shape[2] if numbers.ndim == 3 else -1
    if found not in channels or numbers.size == 0:
        raise ValueError(f"{name} must have shape {' or '.join(shapes)}; got {numbers.shape}.")
    if np.isnan(numbers).any():
        raise ValueError(f"{name} must not be NaN; {np.isnan(numbers).sum()} of its values are.")
    return numbers


def image_file(name: str, path: str | os.PathLike[str], channels: int) -> Path:
    """Check, before rendering, that an image of these channels (0: no such axis) can be written to `path`."""
    path, what = Path(path), {0: "one channel", 3: "colours", 4: "colours and opacity"}[channels]
    allowed = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy")
    allowed = {0: allowed[3:], 3: allowed, 4: (".png", *allowed[3:])}[channels]
    if path.suffix.lower() not in allowed:
        raise ValueError(f"{name}: a file of {what} must end in one of {', '.join(allowed)}; got {path}.")
    return output_file(name, path)
