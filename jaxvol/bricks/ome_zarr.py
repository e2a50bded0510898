"""Which levels of detail does an OME-Zarr image have, and where do they lie in the world?

Reads the `multiscales` of versions 0.4 (Zarr 2, in .zattrs) and 0.5 (Zarr 3, in zarr.json):
https://ngff.openmicroscopy.org/0.5/. A voxel's position is that of its center.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._util.checks import described
from .files import triple
from .zarr import SPACE, ZarrSource, array_metadata, read_json


class Placement(NamedTuple):
    """World position of index i along each axis of an array: `offset` + `scale` · i, in the file's units."""

    scale: np.ndarray
    offset: np.ndarray


def levels_in(
    path: Path, *, index: Mapping[str, int] | None = None, **options: Any
) -> tuple[ZarrSource, ...]:
    """The levels of the first image in an OME-Zarr group, finest first, with their spacing and origin in the
    unit of the file.

    `index`, `options`: as for `ZarrSource`.

    **Raises:** `ValueError` for a group without `multiscales` of version 0.4 or 0.5, for metadata that do not
    follow them, such as levels in another order, and for axes of different units.
    """
    image = _first_image(path)
    axes = _axes(path, image)
    found = []
    for dataset in _list(path, image, "datasets"):
        name = dataset.get("path") if isinstance(dataset, dict) else None
        if (
            not isinstance(name, str)
            or not name
            or not (path / name).resolve().is_relative_to(path.resolve())
        ):
            raise ValueError(f"path: {path}: datasets must name arrays within the group; got {dataset!r}.")
        _, metadata = array_metadata(path / name)
        if len(metadata.get("shape", ())) != len(axes):
            raise ValueError(
                f"path: {path}: {name} must have the {len(axes)} axes {axes}; got shape "
                f"{metadata.get('shape')}."
            )
        placement = Placement(np.ones(len(axes)), np.zeros(len(axes)))
        for source in (dataset, image):  # those of all levels come last
            placement = _transformed(path, placement, source.get("coordinateTransformations") or [])
        scale, offset = (
            [float(part[axes.index(axis)]) for axis in SPACE] for part in (placement.scale, placement.offset)
        )
        root = path.resolve()
        level = ZarrSource(
            path / name,
            axes=axes,
            index=index,
            spacing=triple("spacing", scale),
            origin=triple("origin", offset),
            beside=root.with_name(f"{root.name}.{name.replace('/', '.')}"),
            **options,
        )
        if found:
            _check_coarser(path, found[-1], level)
        found.append(level)
    return tuple(found)


def _check_coarser(path: Path, level: ZarrSource, following: ZarrSource) -> None:
    """Raises if a level is finer along any axis than the one before it. Both the number of voxels and their
    spacing tell; files round the latter."""
    more = [b > a for a, b in zip(level.shape, following.shape, strict=True)]
    finer = np.array(following.spacing) < np.array(level.spacing) * (1 - 1e-3)
    if any(more) or np.any(finer):
        raise ValueError(
            f"path: {path}: datasets of multiscales must be ordered from the highest resolution to the "
            f"lowest; got {following.name}, {following.shape} voxels of {following.spacing}, after "
            f"{level.name}, {level.shape} voxels of {level.spacing}. Correct their order in the file."
        )


def _first_image(path: Path) -> dict[str, Any]:
    """The first entry of `multiscales`, which is the one to show if nothing else is asked for."""
    if (path / "zarr.json").is_file():
        metadata = (read_json(path / "zarr.json").get("attributes") or {}).get("ome") or {}
    elif (path / ".zattrs").is_file():
        metadata = read_json(path / ".zattrs")
    else:
        metadata = {}
    images = metadata.get("multiscales") if isinstance(metadata, dict) else None
    if not isinstance(images, list) or not images or not isinstance(images[0], dict):
        several = isinstance(metadata, dict) and "bioformats2raw.layout" in metadata
        raise ValueError(
            f"path: {path} is a Zarr group without the multiscales of OME-Zarr 0.4 or 0.5. "
            + ("It holds several images: give the path of one, such as its folder 0." if several else "")
            + ("" if several else "Give the path of an image, or of an array in it.")
        )
    return images[0]


def _axes(path: Path, image: dict[str, Any]) -> list[str]:
    entries = _list(path, image, "axes")
    if not all(isinstance(entry, dict) and isinstance(entry.get("name"), str) for entry in entries):
        raise ValueError(
            f"path: {path}: axes must be objects with a name, as in OME-Zarr 0.4 and 0.5; got {entries!r}."
        )
    names = [entry["name"] for entry in entries]
    if not {*SPACE} <= {*names}:
        raise ValueError(f"path: {path}: a volume has the axes x, y and z; got {names}.")
    units = {entry["name"]: entry.get("unit") for entry in entries if entry["name"] in SPACE}
    if len({*units.values()}) > 1:
        raise ValueError(f"path: {path}: x, y and z must have the same unit; got {units}.")
    return names


def _transformed(path: Path, placement: Placement, transformations: Any) -> Placement:
    scale, offset = placement
    for each in transformations if isinstance(transformations, list) else [transformations]:
        kind = each.get("type") if isinstance(each, dict) else None
        if kind == "identity":
            continue
        if kind not in ("scale", "translation"):
            raise ValueError(
                f"path: {path}: coordinateTransformations must be of type scale, translation or identity; "
                f"got {each!r}."
            )
        try:
            values = np.asarray(each.get(kind), float)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.shape != scale.shape:
            raise ValueError(
                f"path: {path}: a {kind} must hold one number for each of {len(scale)} axes; got {each!r}."
            )
        scale, offset = (scale * values, offset * values) if kind == "scale" else (scale, offset + values)
    return Placement(scale, offset)


def _list(path: Path, image: dict[str, Any], name: str) -> list[Any]:
    entries = image.get(name)
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"path: {path}: {name} of multiscales must be a list; got {described(entries)}.")
    return entries
