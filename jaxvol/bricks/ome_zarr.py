"""Which levels of detail does an OME-Zarr image have, and where do they lie in the world?

The `multiscales` of versions 0.4 (Zarr 2, in .zattrs) and 0.5 (Zarr 3, in zarr.json), which yaozarrs checks:
https://ngff.openmicroscopy.org/0.5/. A voxel's position is that of its centre.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .sources import SPACE, Triple, VoxelSource, triple
from .zarr import is_zarr_array, read_json, zarr_array


def levels_in(
    path: Path,
    *,
    index: Mapping[str, int] | None = None,
    spacing: Triple | None = None,
    origin: Triple | None = None,
    **options: Any,
) -> tuple[VoxelSource, ...]:
    """The levels of the first image in an OME-Zarr group, finest first, with their spacing and origin in the
    unit of the file; or with the finest at another place and of another `spacing`, and the others moved with
    it. `index`, `options`: as for `zarr.zarr_array`.

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
    found: list[VoxelSource] = []
    for dataset in image.datasets:
        array = (path / dataset.path).resolve()
        if not array.is_relative_to(path.resolve()) or not is_zarr_array(array):
            raise ValueError(f"path: {path}: {dataset.path} is no Zarr array within the group.")
        scale, offset = np.ones(len(names)), np.zeros(len(names))
        for source in (dataset, image):  # those of all levels come last
            for each in source.coordinateTransformations or ():
                if each.type == "scale":
                    scale, offset = scale * each.scale, offset * each.scale
                else:
                    offset = offset + each.translation
        at = [names.index(axis) for axis in SPACE]
        where: dict[str, Any] = {
            "spacing": triple("spacing", scale[at]),
            "origin": triple("origin", offset[at]),
        }
        found.append(zarr_array(array, axes=names, index=index, **where, **options))
    _move(found, spacing, origin)
    return tuple(found)


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
    metadata = read_json(file) if file.is_file() else {}
    if third:
        attributes = metadata.get("attributes")
        metadata = attributes.get("ome") if isinstance(attributes, dict) else None
    if not isinstance(metadata, dict) or "multiscales" not in metadata:
        several = isinstance(metadata, dict) and "bioformats2raw.layout" in metadata
        raise ValueError(
            f"path: {path} is a Zarr group without the multiscales of OME-Zarr 0.4 or 0.5. "
            + ("It holds several images: give the path of one, such as its folder 0." if several else "")
            + ("" if several else "Give the path of an image, or of an array in it.")
        )
    try:
        return (v05 if third else v04).Image.model_validate(metadata).multiscales[0]
    except ValidationError as fault:
        said = "; ".join(f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in fault.errors())
        raise ValueError(
            f"path: {path} does not follow OME-Zarr {'0.5' if third else '0.4'}: {said}."
        ) from fault


def _move(levels: list[VoxelSource], spacing: Triple | None, origin: Triple | None) -> None:
    """Moves levels so that the finest has this spacing and origin."""
    place: Any = [(level.spacing, level.origin) for level in levels]
    finest, start = map(np.array, place[0])
    factor = 1 if spacing is None else np.array(spacing) / finest
    first = start if origin is None else np.array(origin)
    for level, (its_spacing, its_origin) in zip(levels, place, strict=True):
        level.spacing = triple("spacing", np.array(its_spacing) * factor)
        level.origin = triple("origin", first + (np.array(its_origin) - start) * factor)
