"""Reads views (pictures with their cameras) and transfer functions from picture and JSON files."""

import json
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._util.checks import described
from .._util.srgb import from_srgb
from .._util.whole_files import whole_file
from ..scene.camera import Camera
from ..scene.transfer import TransferFunction


CAMERA = "position", "focal_point", "view_up", "view_angle", "parallel_scale", "window"
TRANSFER = "values", "colors", "extinction"

File = str | PathLike[str]


def read_views(images: Sequence[File], cameras: File) -> list[tuple[Camera, Float[Array, "h w 3"]]]:
    """Read pictures and their cameras, as `ImageResidual` takes them.

    Args:
        images: pictures of 8 or 16 bits in sRGB, such as `save_png` writes. They are converted to linear RGB.
        cameras: a JSON file with a list of one object per image, in the same order, with the fields
            `position`, `focal_point`, and optionally `view_up`, `view_angle`, `parallel_scale` and `window`,
            as `Camera` takes them.

    Returns:
        A pair for each image: its `Camera`, and the picture, linear RGB.

    Raises:
        ValueError: naming the file, if it is missing or holds anything else.
    """
    entries = _json(cameras)
    if not isinstance(entries, list) or len(entries) != len(images):
        got = len(entries) if isinstance(entries, list) else f"a {type(entries).__name__}"
        raise ValueError(
            f"{cameras} must hold a list with a camera for each of {len(images)} images; got {got}."
        )
    views = []
    for number, (fields, path) in enumerate(zip(entries, images, strict=True)):
        picture, what = _picture(path), f"{cameras}: camera {number}"
        views.append((_made(Camera, what, CAMERA, fields, size=picture.shape[1::-1]), picture))
    return views


def read_transfer(path: File) -> TransferFunction:
    """Read a transfer function from a JSON file with the fields `values`, `colors` and `extinction`.

    Args:
        path: the file.

    Returns:
        The `TransferFunction`.

    Raises:
        ValueError: naming the file, if it is missing or holds anything else.
    """
    return transfer_of_fields(str(path), _json(path))


def transfer_of_fields(what: str, content: Any) -> TransferFunction:
    """The transfer function that `transfer_fields` wrote; `what` names its place in errors."""
    return _made(TransferFunction, what, TRANSFER, content)


def transfer_fields(transfer: TransferFunction) -> dict[str, Any]:
    """Its values, colours and extinctions, as JSON holds them."""
    if transfer.per_voxel:
        raise ValueError(
            "transfer counts lengths in voxels, and a file holds world lengths; give it a unit_distance, "
            "such as the volume."
        )
    return {name: np.asarray(getattr(transfer, name), float).tolist() for name in TRANSFER}


def write_transfer(path: File, transfer: TransferFunction | Any) -> Path:
    """Write a transfer function in the format that `read_transfer` reads.

    Args:
        path: the file.
        transfer: a `TransferFunction`.

    Returns:
        The path.

    Raises:
        ValueError: for other kinds of them, which that format does not hold.
    """
    if not isinstance(transfer, TransferFunction):
        raise ValueError(f"transfer must be a TransferFunction; got {described(transfer)}.")
    path = Path(path)
    with whole_file(path) as part:
        part.write_text(json.dumps(transfer_fields(transfer), indent=1) + "\n", encoding="utf-8")
    return path


def _json(path: File) -> Any:
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as fault:
        raise ValueError(f"{path} cannot be read ({fault.strerror}).") from fault
    except (ValueError, RecursionError) as fault:  # of text that is not UTF-8, too
        raise ValueError(f"{path} is not JSON: {fault}.") from fault


def _made(kind: Callable[..., Any], what: str, allowed: Sequence[str], content: Any, **more: Any) -> Any:
    """What `kind` makes of the fields of a JSON object."""
    if not isinstance(content, dict) or not set(content) <= set(allowed):
        got = ", ".join(content) if isinstance(content, dict) else f"a {type(content).__name__}"
        raise ValueError(f"{what} must be an object with fields of {', '.join(allowed)}; got {got}.")
    try:
        return kind(**content, **more)
    except (TypeError, ValueError) as fault:  # TypeError: a field that is needed is missing
        raise ValueError(f"{what}: {fault}") from fault


def _picture(path: File) -> Float[Array, "h w 3"]:
    from skimage.io import imread
    from skimage.util import img_as_float32

    if not Path(path).is_file():
        raise ValueError(f"there is no file {path}.")
    try:
        picture = imread(path)
    except Exception as fault:  # each of the many readers raises errors of its own
        raise ValueError(f"{path} cannot be read as a picture: {fault}") from fault
    if picture.ndim != 3 or picture.shape[-1] != 3 or picture.dtype not in (np.uint8, np.uint16):
        got = f"shape {picture.shape} of {picture.dtype}"
        raise ValueError(f"{path} must be an RGB picture of 8 or 16 bits, without transparency; got {got}.")
    return from_srgb(jnp.asarray(img_as_float32(picture)))
