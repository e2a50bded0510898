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
from ..scene.transfer import Transfer, TransferFunction


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
        ValueError: with the file's name, if it is missing or has another content.
    """
    entries = _json(cameras)
    if not isinstance(entries, list) or len(entries) != len(images):
        got = len(entries) if isinstance(entries, list) else f"a {type(entries).__name__}"
        raise ValueError(
            f"{cameras} must hold a list with a camera for each of {len(images)} images; got {got}."
        )
    views = []
    for number, (fields, path) in enumerate(zip(entries, images, strict=True)):
        picture, place = _picture(path), f"{cameras}: camera {number}"
        views.append((_build(Camera, place, CAMERA, fields, size=picture.shape[1::-1]), picture))
    return views


def read_transfer(path: File) -> TransferFunction:
    """Read a transfer function from a JSON file with the fields `values`, `colors` and `extinction`.

    Args:
        path: the file.

    Returns:
        The `TransferFunction`.

    Raises:
        ValueError: with the file's name, if it is missing or has another content.
    """
    return transfer_of_fields(str(path), _json(path))


def transfer_of_fields(place: str, content: object) -> TransferFunction:
    """The transfer function of the fields that `transfer_fields` returned. Errors begin with `place`."""
    return _build(TransferFunction, place, TRANSFER, content)


def transfer_fields(transfer: TransferFunction) -> dict[str, Any]:
    """Values, colours and extinctions of a transfer function, for JSON."""
    if transfer.per_voxel:
        raise ValueError(
            "transfer counts lengths in voxels, and a file holds world lengths. Pass the transfer function a "
            "unit_distance, such as the volume."
        )
    return {name: np.asarray(getattr(transfer, name), float).tolist() for name in TRANSFER}


def write_transfer(path: File, transfer: Transfer) -> Path:
    """Write a transfer function in the format that `read_transfer` reads.

    Args:
        path: the file.
        transfer: a `TransferFunction`.

    Returns:
        The path.

    Raises:
        ValueError: for other kinds of transfer functions, which the format does not represent.
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
    except (ValueError, RecursionError) as fault:  # includes text that is not UTF-8
        raise ValueError(f"{path} is not JSON: {fault}.") from fault


def _build(kind: Callable[..., Any], place: str, allowed: Sequence[str], content: Any, **extra: Any) -> Any:
    """Call `kind` with the fields of a JSON object."""
    if not isinstance(content, dict) or not set(content) <= set(allowed):
        got = ", ".join(content) if isinstance(content, dict) else f"a {type(content).__name__}"
        raise ValueError(f"{place} must be an object with fields of {', '.join(allowed)}; got {got}.")
    try:
        return kind(**content, **extra)
    except (TypeError, ValueError) as fault:  # TypeError: a required field is missing
        raise ValueError(f"{place}: {fault}") from fault


def _picture(path: File) -> Float[Array, "h w 3"]:
    from skimage.io import imread
    from skimage.util import img_as_float32

    if not Path(path).is_file():
        raise ValueError(f"images must be files; there is no file {path}.")
    try:
        picture = imread(path)
    except Exception as fault:  # readers of pictures raise errors of many kinds
        raise ValueError(f"{path} cannot be read as a picture: {fault}") from fault
    if picture.ndim != 3 or picture.shape[-1] != 3 or picture.dtype not in (np.uint8, np.uint16):
        got = f"shape {picture.shape} of {picture.dtype}"
        raise ValueError(f"{path} must be an RGB picture of 8 or 16 bits, without transparency; got {got}.")
    return from_srgb(jnp.asarray(img_as_float32(picture)))
