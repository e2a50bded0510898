"""Opens Zarr arrays and OME-Zarr images in a folder.

tensorstore reads arrays: all chunks that a box touches at once. yaozarrs checks the `multiscales` of OME-Zarr
0.4 (Zarr 2, in .zattrs) and 0.5 (Zarr 3, in zarr.json), which say where levels of detail lie in the world:
https://ngff.openmicroscopy.org/0.5/. A voxel's position is that of its centre.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from .._util.checks import described, finite_array
from .sources import SPACE, VoxelSource


METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs"
"""Files, of which a Zarr array or group has at least one."""

LARGE, BEYOND = 2**26, 8
"""Bytes that a chunk may always have, and how many times those of the array."""

CACHE = 2**24
"""Bytes of decoded chunks and indices of shards that are kept, for boxes that share them."""


def zarr_levels(path: Path, place: dict[str, Any], **options: Any) -> tuple[VoxelSource, ...]:
    """The array in a folder, or the levels of the first image in an OME-Zarr group, finest first, in the unit
    of the file. `place`: spacing and origin of the finest, where given; others are scaled and moved with it."""
    try:
        import tensorstore  # noqa: F401
        from yaozarrs import v04, v05
    except ImportError as fault:
        raise ImportError(
            f'{path} is Zarr, which tensorstore and yaozarrs read: pip install "jaxvol[bricks]".'
        ) from fault
    if _is_array(path):
        return (_array(path, **place, **options),)
    zarr3 = (path / "zarr.json").is_file()
    metadata = _read_json(path / ("zarr.json" if zarr3 else ".zattrs"))
    try:
        model, content = (v05.Image, metadata["attributes"]["ome"]) if zarr3 else (v04.Image, metadata)
        image: Any = model.model_validate(content).multiscales[0]
    except (KeyError, TypeError, ValueError) as fault:
        version, said = "0.5" if zarr3 else "0.4", " ".join(str(fault).split())
        raise ValueError(
            f"path: {path} does not follow OME-Zarr {version} ({said}). Give the path of an image, or of an "
            "array in it, such as its folder 0."
        ) from fault
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
    factor = np.asarray(finite_array("spacing", place.get("spacing", finest), (3,)), float) / finest
    first = np.asarray(finite_array("origin", place.get("origin", start), (3,)), float)
    levels = []
    for dataset, (scale, offset) in zip(image.datasets, places, strict=True):
        if not _is_array(path / dataset.path):
            raise ValueError(f"path: {path}: {dataset.path} is no Zarr array within the group.")
        where = {"spacing": scale * factor, "origin": first + (offset - start) * factor}
        levels.append(_array(path / dataset.path, axes=names, **where, **options))
    return tuple(levels)


def _is_array(path: Path) -> bool:
    """Whether a folder is that of a Zarr array, not of a group or anything else."""
    if (path / "zarr.json").is_file():
        return _read_json(path / "zarr.json").get("node_type") == "array"
    return (path / ".zarray").is_file()


def _array(path: Path, *, axes: Any = None, missing: Any = "error", **how: Any) -> VoxelSource:
    import tensorstore

    if missing not in ("error", "fill"):
        raise ValueError(f'missing must be "error" or "fill"; got {missing!r}.')
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
    # a chunk is decoded as a whole, even beyond the array
    chunk = [c or n for c, n in zip(store.chunk_layout.read_chunk.shape, store.shape, strict=True)]
    of_chunk, whole = (math.prod(shape) * store.dtype.numpy_dtype.itemsize for shape in (chunk, store.shape))
    if of_chunk > max(LARGE, BEYOND * whole):
        raise ValueError(
            f"path: {path} must have chunks that are not much larger than it; got chunks of {tuple(chunk)} "
            f"voxels, {of_chunk} bytes, for an array of {tuple(store.shape)}. Its metadata may be damaged."
        )
    names: Any = list(store.domain.labels)  # Zarr 3
    if (path / ".zattrs").is_file():  # xarray's in Zarr 2
        names = _read_json(path / ".zattrs").get("_ARRAY_DIMENSIONS")
    names = [str(name).lower() for name in names] if isinstance(names, list) else []
    if axes is None and {*SPACE} <= {*names}:
        axes = names
    return VoxelSource(store, axes=axes, name=str(path), **how)


def _read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        raise ValueError(f"path: {path} cannot be read as JSON ({fault}).") from fault
    if not isinstance(content, dict):
        raise ValueError(f"path: {path} must hold a JSON object; got {described(content)}.")
    return content
