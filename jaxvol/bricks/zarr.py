"""How are Zarr arrays and OME-Zarr images in a folder opened?

tensorstore reads arrays: all chunks that a box touches at once. yaozarrs checks the `multiscales` of OME-Zarr
0.4 (Zarr 2, in .zattrs) and 0.5 (Zarr 3, in zarr.json), which say where levels of detail lie in the world:
https://ngff.openmicroscopy.org/0.5/. A voxel's position is that of its centre.
"""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .._util.checks import Arrayable, described, finite_array
from .sources import SPACE, VoxelSource


METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs"
"""Files, of which a Zarr array or group has at least one."""

LARGE, BEYOND = 2**26, 8
"""Bytes that a chunk may always have, and how many times those of the array."""

DECODED = 2**24
"""Bytes of decoded chunks that are kept, for boxes that share them."""

DECODERS = min(os.cpu_count() or 1, 8)
"""Threads that read files, and threads that decode them."""


def is_zarr_array(path: Path) -> bool:
    """Whether a folder is that of a Zarr array, not of a group or anything else."""
    if (path / "zarr.json").is_file():
        return _read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def zarr_array(
    path: Path,
    *,
    axes: Any = None,
    index: Mapping[str, int] | None = None,
    missing: Literal["error", "fill"] | Any = "error",
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
) -> VoxelSource:
    """The array in a folder. Arguments and errors as for `levels_of`."""
    if missing not in ("error", "fill"):
        raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(
            f'{path} is a Zarr array, which tensorstore reads; it is missing: pip install "jaxvol[bricks]".'
        ) from fault
    second = (path / ".zarray").is_file()
    spec = {
        "driver": "zarr" if second else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path.resolve()}{os.sep}"},
        "fill_missing_data_reads": missing == "fill",
    }
    context = {
        "cache_pool": {"total_bytes_limit": DECODED},
        "data_copy_concurrency": {"limit": DECODERS},
        "file_io_concurrency": {"limit": DECODERS},
    }
    try:
        store = tensorstore.open(spec, open=True, read=True, context=tensorstore.Context(context)).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault
    _check_chunks(path, store)
    hint = "A chunk is damaged. Fetch it again."
    if missing == "error":
        hint = (
            'A chunk is missing or damaged. Fetch it again; or pass missing="fill", if chunks were left out '
            "because all their voxels have the fill value."
        )
    axes = _named_axes(path, second=second) if axes is None else axes
    return VoxelSource(store, spacing, origin, axes=axes, index=index, name=str(path), hint=hint)


def _named_axes(path: Path, *, second: bool) -> list[str] | None:
    """The names of the axes in the array's metadata, if x, y and z are among them."""
    names: Any = None
    if second and (path / ".zattrs").is_file():
        names = _read_json(path / ".zattrs").get("_ARRAY_DIMENSIONS")
    elif not second:
        metadata = _read_json(path / "zarr.json")
        names, attributes = metadata.get("dimension_names"), metadata.get("attributes")
        if names is None and isinstance(attributes, dict):
            names = attributes.get("_ARRAY_DIMENSIONS")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return None
    names = [name.lower() for name in names]
    return names if {*SPACE} <= {*names} else None


def _check_chunks(path: Path, store: Any) -> None:
    """Raises for chunks much larger than the array: a chunk is decoded as a whole, even beyond the array."""
    chunk = [c or n for c, n in zip(store.chunk_layout.read_chunk.shape, store.shape, strict=True)]
    of_chunk, whole = (math.prod(shape) * store.dtype.numpy_dtype.itemsize for shape in (chunk, store.shape))
    if of_chunk > max(LARGE, BEYOND * whole):
        raise ValueError(
            f"path: {path} must have chunks that are not much larger than it; got chunks of {tuple(chunk)} "
            f"voxels, {of_chunk} bytes, for an array of {tuple(store.shape)}. Its metadata may be damaged."
        )


def ome_zarr_levels(
    path: Path, *, spacing: Arrayable | None = None, origin: Arrayable | None = None, **options: Any
) -> tuple[VoxelSource, ...]:
    """The levels of the first image in an OME-Zarr group, finest first, with their spacing and origin in the
    unit of the file. A given `spacing` and `origin` are those of the finest, and others are scaled and moved
    with it. `options`: as for `zarr_array`.

    **Raises:** `ValueError` for a group without `multiscales` of version 0.4 or 0.5, for metadata that do not
    follow them, such as levels in another order, and for axes of different units; `ImportError` without
    yaozarrs.
    """
    image = _first_image(path)
    names = [axis.name for axis in image.axes]
    if not {*SPACE} <= {*names}:
        raise ValueError(f"path: {path}: a volume has the axes x, y and z; got {names}.")
    units = {axis.name: getattr(axis, "unit", None) for axis in image.axes if axis.name in SPACE}
    if len({*units.values()}) > 1:
        raise ValueError(f"path: {path}: x, y and z must have the same unit; got {units}.")
    places = []
    for dataset in image.datasets:
        scale, offset = np.ones(len(names)), np.zeros(len(names))
        for described_by in (dataset, image):  # those of all levels come last
            for each in described_by.coordinateTransformations or ():
                if each.type == "scale":
                    scale, offset = scale * each.scale, offset * each.scale
                else:
                    offset = offset + each.translation
        at = [names.index(axis) for axis in SPACE]
        places.append((scale[at], offset[at]))
    for name, given in (("spacing", spacing), ("origin", origin)):
        if given is not None:
            finite_array(name, given, (3,))
    finest, start = places[0]
    factor = 1.0 if spacing is None else np.asarray(spacing, float) / finest
    first = start if origin is None else np.asarray(origin, float)
    levels = []
    for dataset, (scale, offset) in zip(image.datasets, places, strict=True):
        array = (path / dataset.path).resolve()
        if not array.is_relative_to(path.resolve()) or not is_zarr_array(array):
            raise ValueError(f"path: {path}: {dataset.path} is no Zarr array within the group.")
        place = {"spacing": scale * factor, "origin": first + (offset - start) * factor}
        levels.append(zarr_array(array, axes=names, **place, **options))
    return tuple(levels)


def _first_image(path: Path) -> Any:
    """The first entry of `multiscales`, which is the one to show if nothing else is asked for."""
    try:
        from pydantic import ValidationError
        from yaozarrs import v04, v05
    except ImportError as fault:
        raise ImportError(
            f'{path} may be an OME-Zarr image, whose metadata yaozarrs reads: pip install "jaxvol[bricks]".'
        ) from fault
    third = (path / "zarr.json").is_file()
    file = path / ("zarr.json" if third else ".zattrs")
    metadata: Any = _read_json(file) if file.is_file() else {}
    if third:
        attributes = metadata.get("attributes")
        metadata = attributes.get("ome") if isinstance(attributes, dict) else None
    if not isinstance(metadata, dict) or "multiscales" not in metadata:
        several = isinstance(metadata, dict) and "bioformats2raw.layout" in metadata
        hint = "Give the path of an image, or of an array in it."
        if several:
            hint = "It holds several images: give the path of one, such as its folder 0."
        raise ValueError(
            f"path: {path} is a Zarr group without the multiscales of OME-Zarr 0.4 or 0.5. {hint}"
        )
    try:
        return (v05 if third else v04).Image.model_validate(metadata).multiscales[0]
    except ValidationError as fault:
        said = "; ".join(f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in fault.errors())
        raise ValueError(
            f"path: {path} does not follow OME-Zarr {'0.5' if third else '0.4'}: {said}."
        ) from fault


def _read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. **Raises** `ValueError` if it holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise ValueError(f"path: {path} cannot be read as JSON ({fault}).") from fault
    if not isinstance(content, dict):
        raise ValueError(f"path: {path} must hold a JSON object; got {described(content)}.")
    return content
