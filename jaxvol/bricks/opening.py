"""Which source, and which levels of detail, does a user mean?"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from .._util.checks import Arrayable, described
from .._util.named_axes import along_xyz, is_named
from ..volume import Volume
from .files import mapped, npy, raw, triple
from .ome_zarr import levels_in
from .sources import ArraySource, VoxelSource, array_of
from .zarr import ZarrSource, array_metadata


Openable: TypeAlias = VoxelSource | Volume | os.PathLike[str] | str | Any
"""A source, a volume, the path of a file or folder, or an array."""

METADATA = "zarr.json", ".zarray", ".zgroup", ".zattrs"
"""Files, of which a Zarr array or group has at least one."""

NEEDED = "source must be an array, a Volume, a VoxelSource, or the path of a file or folder"

OF_RAW, OF_ZARR = ("shape", "dtype"), ("axes", "index", "missing")


def source_of(thing: Openable, **options: Any) -> VoxelSource:
    """The finest level of what `levels_of` opens.

    **Arguments:** `thing`, `options`: as for `levels_of`.

    **Returns:** the source.

    **Raises:** as `levels_of`.
    """
    return levels_of(thing, **options)[0]


def levels_of(
    thing: Openable,
    *,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    shape: Sequence[int] | None = None,
    dtype: str | Any | None = None,
    axes: str | Sequence[str] | Any | None = None,
    index: Mapping[str, int] | None = None,
    missing: Literal["error", "fill"] | Any | None = None,
) -> tuple[VoxelSource, ...]:
    """The levels of detail of a volume, finest first; only that of an OME-Zarr image may have several.

    **Arguments:**

    - `thing`: what holds the voxels.

      | | read |
      |---|---|
      | an array, data[x, y, z] | in place |
      | an xarray `DataArray` | in place, its axes and coordinates as in `Volume` |
      | a memory map (`np.memmap`) or a view of one | from its file; in place if that is gone or replaced |
      | path of a `.raw` file, x fastest | from the file, box by box; header as for `jv.load` |
      | path of a `.npy` file, data[x, y, z] | from the file, box by box |
      | path of a Zarr array, version 2 or 3, or an OME-Zarr image | by tensorstore: `jaxvol[bricks]` |
      | an array or a group of the `zarr` package, in a folder | as its path |
      | a `Volume` without labels and field | in place |
      | a `VoxelSource` | as it says |

    - `spacing`, `origin`: as in `Volume`, of the finest level; by default what the source says.
    - `shape`, `dtype`: of a raw file, as in `jv.load`.
    - `axes`, `index`, `missing`: of Zarr; see `zarr.ZarrSource`. OME-Zarr has its own axes.

    **Returns:** a source for each level.

    **Raises:** `ValueError` for anything else, for options that do not belong to it, for a file that is
    missing, damaged, or larger or smaller than it says, and for shapes and types that no volume has;
    `ImportError` for Zarr without tensorstore.
    """
    options = {"shape": shape, "dtype": dtype, "axes": axes, "index": index, "missing": missing}
    options = {name: value for name, value in options.items() if value is not None}
    place = {"spacing": triple("spacing", spacing), "origin": triple("origin", origin)}
    path = _folder_of(thing) if type(thing).__module__.partition(".")[0] == "zarr" else thing
    if isinstance(path, str | os.PathLike):
        if not str(path):
            raise ValueError(f"{NEEDED}; got ''.")
        return _of_path(Path(path), options, place)
    _refuse(described(thing), options, ())
    if isinstance(thing, VoxelSource | Volume):
        source = array_of(thing) if isinstance(thing, Volume) else thing
        if any(value is not None for value in place.values()):
            raise ValueError(
                f"spacing and origin are those of {described(thing)}; got {place} as well. Leave them out."
            )
        return (source,)
    if isinstance(thing, type) or not (hasattr(thing, "shape") or isinstance(thing, Sequence)):
        raise ValueError(f"{NEEDED}; got {described(thing)}.")
    if is_named(thing):
        thing, told = along_xyz(thing)
        place = {name: triple(name, told.get(name)) if at is None else at for name, at in place.items()}
    found = mapped(thing, **place) if isinstance(thing, np.ndarray) else None
    return (ArraySource(thing, **place) if found is None else found,)


def _of_path(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    if not path.exists():
        raise ValueError(
            f"path: there is no file {path} (working directory {Path.cwd()}). Check the spelling."
        )
    if path.is_dir():
        if not any((path / name).is_file() for name in METADATA):
            raise ValueError(
                f"path: {path} is a folder without Zarr in it: it has none of {', '.join(METADATA)}. Give "
                "the folder of an array or of an OME-Zarr image; for a DICOM series, pass jv.load(path)."
            )
        _refuse(str(path), options, OF_ZARR)
        return _of_zarr(path, options, place)
    name = path.name.lower()
    if name.endswith((".raw", ".raw.gz")):
        _refuse(str(path), options, OF_RAW)
        return (raw(path, **options, **place),)
    _refuse(str(path), options, ())
    if name.endswith(".npy"):
        return (npy(path, **place),)
    raise ValueError(
        f"path: {path} is not of a kind that is read in parts: .raw, .npy, or the folder of a Zarr array or "
        "an OME-Zarr image. If it fits into memory, pass jv.load(path), or for ultrasound the volume and "
        "the map that jv.load_ultrasound(path) returns."
    )


def _folder_of(thing: Any) -> Path:
    """The folder of an array or a group of the zarr package, which is not imported here."""
    store = getattr(thing, "store", None)
    root = getattr(store, "root", getattr(store, "path", None))
    folder = Path(root, thing.path) if isinstance(root, str | os.PathLike) else None
    if folder is None or not folder.is_dir():
        raise ValueError(
            f"source: {described(thing)} does not lie in a folder of this machine, from which alone Zarr is "
            f"read; its store is {described(store)}. Copy it to a folder and pass the path of that; or, if "
            "they fit into memory, its voxels: array[:], as data[x, y, z]."
        )
    return folder


def _of_zarr(path: Path, options: dict[str, Any], place: dict[str, Any]) -> tuple[VoxelSource, ...]:
    try:
        array_metadata(path)
    except ValueError:
        _refuse(str(path), options, ("index", "missing"))
        return _placed(levels_in(path, **options), **place)
    return (ZarrSource(path, **options, **place),)


def _placed(
    levels: tuple[ZarrSource, ...],
    spacing: tuple[float, float, float] | None,
    origin: tuple[float, float, float] | None,
) -> tuple[VoxelSource, ...]:
    """Levels with the finest at another place and of another spacing, and the others moved with it."""
    finest, start = (np.array(each) for each in (levels[0].spacing, levels[0].origin))
    factor = 1 if spacing is None else np.array(spacing) / finest
    first = start if origin is None else np.array(origin)
    for level in levels:
        level.spacing = triple("spacing", np.array(level.spacing) * factor)
        level.origin = triple("origin", first + (np.array(level.origin) - start) * factor)
    return levels


def _refuse(what: str, options: dict[str, Any], allowed: tuple[str, ...]) -> None:
    if unused := [name for name in options if name not in allowed]:
        raise ValueError(
            f"{', '.join(unused)}: {what} takes no such option; {', '.join(OF_RAW)} belong to raw files, "
            f"{', '.join(OF_ZARR)} to Zarr arrays."
        )
