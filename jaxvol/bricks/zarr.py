"""How are Zarr arrays and OME-Zarr images in a folder opened?

tensorstore reads arrays: all chunks that a box touches at once. yaozarrs checks the `multiscales` of OME-Zarr
0.4 (Zarr 2, in .zattrs) and 0.5 (Zarr 3, in zarr.json), which say where levels of detail lie in the world:
https://ngff.openmicroscopy.org/0.5/. A voxel's position is that of its centre.
"""

import json
import math
import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .._util.checks import Arrayable, described, finite_array
from .sources import SPACE, VoxelSource


METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs"
"""Files, of which a Zarr array or group has at least one."""

LARGE, BEYOND = 2**26, 8
"""Bytes that a chunk may always have, and how many times those of the array."""

CACHE = 2**24
"""Bytes of decoded chunks and indices of shards that are kept, for boxes that share them."""

INSTALL = 'which tensorstore and yaozarrs read: pip install "jaxvol[bricks]".'


def is_zarr_array(path: Path) -> bool:
    """Whether a folder is that of a Zarr array, not of a group or anything else."""
    if (path / "zarr.json").is_file():
        return _read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def zarr_array(
    path: Path, *, axes: Any = None, missing: Literal["error", "fill"] | Any = "error", **how: Any
) -> VoxelSource:
    """The array in a folder. Arguments and errors as for `levels_of`."""
    if missing not in ("error", "fill"):
        raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
    try:
        import tensorstore
    except ImportError as fault:
        raise ImportError(f"{path} is a Zarr array, {INSTALL}") from fault
    spec = {
        "driver": "zarr" if (path / ".zarray").is_file() else "zarr3",
        "kvstore": {"driver": "file", "path": f"{path.resolve()}{os.sep}"},
        "fill_missing_data_reads": missing == "fill",
        "context": {"cache_pool": {"total_bytes_limit": CACHE}},
    }
    try:
        store = tensorstore.open(spec, open=True, read=True).result()
    except ValueError as fault:
        raise ValueError(f"path: {path} cannot be opened as a Zarr array (tensorstore: {fault}).") from fault
    _check_chunks(path, store)
    hint = "A chunk is damaged. Fetch it again."
    if missing == "error":
        hint = (
            'A chunk is missing or damaged. Fetch it again; or pass missing="fill", if chunks were left out '
            "because all their voxels have the fill value."
        )
    return VoxelSource(store, axes=axes or _named_axes(path, store), name=str(path), hint=hint, **how)


def _named_axes(path: Path, store: Any) -> list[str] | None:
    """The names of the axes in the array's metadata, if x, y and z are among them."""
    names: Any = list(store.domain.labels)  # Zarr 3
    if (path / ".zattrs").is_file():  # xarray's in Zarr 2
        names = _read_json(path / ".zattrs").get("_ARRAY_DIMENSIONS")
    names = [str(name).lower() for name in names] if isinstance(names, list) else []
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
    """The levels of the first image in an OME-Zarr group, finest first, in the unit of the file. A given
    `spacing` and `origin` are those of the finest; others are scaled and moved with it. `options`: as for
    `zarr_array`.

    **Raises:** `ValueError` for metadata that do not follow OME-Zarr 0.4 or 0.5, and for axes of different
    units; `ImportError` without yaozarrs."""
    image = _first_image(path)
    names = [axis.name for axis in image.axes]
    units = {axis.name: getattr(axis, "unit", None) for axis in image.axes if axis.name in SPACE}
    if len(units) < 3 or len({*units.values()}) > 1:
        raise ValueError(f"path: {path} must have axes x, y and z of the same unit; got {names}, {units}.")
    at, places = [names.index(axis) for axis in SPACE], []
    for dataset in image.datasets:
        scale, offset = np.ones(len(names)), np.zeros(len(names))
        for described_by in (dataset, image):  # those of all levels come last
            for each in described_by.coordinateTransformations or ():
                if each.type == "scale":
                    scale, offset = scale * each.scale, offset * each.scale
                else:
                    offset = offset + each.translation
        places.append((scale[at], offset[at]))
    finest, start = places[0]
    factor, first = 1.0, start
    if spacing is not None:
        factor = np.asarray(finite_array("spacing", spacing, (3,)), float) / finest
    if origin is not None:
        first = np.asarray(finite_array("origin", origin, (3,)), float)
    levels = []
    for dataset, (scale, offset) in zip(image.datasets, places, strict=True):
        if not is_zarr_array(path / dataset.path):
            raise ValueError(f"path: {path}: {dataset.path} is no Zarr array within the group.")
        place = {"spacing": scale * factor, "origin": first + (offset - start) * factor}
        levels.append(zarr_array(path / dataset.path, axes=names, **place, **options))
    return tuple(levels)


def _first_image(path: Path) -> Any:
    """The first entry of `multiscales`, which is the one to show if nothing else is asked for."""
    try:
        from yaozarrs import v04, v05
    except ImportError as fault:
        raise ImportError(f"{path} may be an OME-Zarr image, {INSTALL}") from fault
    third = (path / "zarr.json").is_file()
    file = path / ("zarr.json" if third else ".zattrs")
    metadata: Any = _read_json(file) if file.is_file() else {}
    for key in ("attributes", "ome") if third else ():
        metadata = metadata.get(key) if isinstance(metadata, dict) else None
    if not isinstance(metadata, dict) or "multiscales" not in metadata:
        raise ValueError(
            f"path: {path} is a Zarr group without the multiscales of OME-Zarr 0.4 or 0.5. Give the path of "
            "an image or of an array in it, such as its folder 0."
        )
    try:
        return (v05 if third else v04).Image.model_validate(metadata).multiscales[0]
    except ValueError as fault:
        version, said = "0.5" if third else "0.4", " ".join(str(fault).split())
        raise ValueError(f"path: {path} does not follow OME-Zarr {version}: {said}") from fault


def _read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file. **Raises** `ValueError` if it holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise ValueError(f"path: {path} cannot be read as JSON ({fault}).") from fault
    if not isinstance(content, dict):
        raise ValueError(f"path: {path} must hold a JSON object; got {described(content)}.")
    return content
