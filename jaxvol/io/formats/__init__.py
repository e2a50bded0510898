"""Loads volumes from files, with a reader chosen by the ending of the file's name, and saves them.

A reader returns the arguments of `Volume` that the file holds, and as `axes` a letter for each axis of its
data: x, y, z, then t of time, c of channels, s of several values in a voxel (by default as many of "xyzs" as
there are). Nothing is unpickled, and the content of a file is checked against its header before memory is
allocated for it.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import Arrayable, described, integer, number
from ..._util.npy import read_npy, read_npz
from ..._util.voxels import WHOLE, is_flat, within
from ...march.transforms import ToroidalMap
from ...scene.volume import Volume
from .dicom import dicom_files, is_dicom, read_dicom, series_headers
from .kretz import read_kretz
from .medical import nrrd_header, read_nrrd
from .metaimage import metaimage_header, read_metaimage
from .nifti import read_nifti
from .raw import ENDINGS as RAW, raw_json, read_raw
from .save import save as save
from .tiff import read_tiff, read_tiff_folder, tiff_files


READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".npy": read_npy,
    ".npz": read_npz,
    ".nii": read_nifti,
    ".nii.gz": read_nifti,
    ".nrrd": read_nrrd,
    ".nhdr": read_nrrd,
    ".mha": read_metaimage,
    ".mhd": read_metaimage,
    ".tif": read_tiff,
    ".tiff": read_tiff,
}

FOLDERS: list[tuple[Callable[[Path], bool], Callable[..., dict[str, Any]]]] = []
"""What knows a kind of folder, and its reader, which is given the path, `time`, `channel` and `nan`.
`bricks.opening` adds that of Zarr."""


def load(
    path: str | os.PathLike[str] | Any,
    *,
    shape: Sequence[int] | Any | None = None,
    dtype: str | Any | None = None,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    direction: Arrayable | None = None,
    labels: str | os.PathLike[str] | None = None,
    nan: float | None = None,
    time: int | None = None,
    channel: int | None = None,
) -> Volume:
    """Load a volume from a file, whose format is given by the ending of its name, or from a folder of slices.

    | ending | header |
    |---|---|
    | `.raw`, `.raw.gz` | the arguments; else a JSON file beside it; else the name `name_XxYxZ_dtype.raw` |
    | `.npy` | its own; the array is data[x, y, z] |
    | `.npz` | its own; `data` and, if any, `spacing`, `origin`, `direction`, `labels`; or any one array |
    | `.mha`, `.mhd` | its own |
    | `.nii`, `.nii.gz` | its own: the sform if its code is positive, else the qform, else `pixdim`; in mm |
    | `.nrrd`, `.nhdr` | its own; read by SimpleITK (`pip install "jaxvol[io]"`) |
    | a folder of DICOM slices, or one of them, of any ending: its series | their own; read by SimpleITK |
    | `.tif`, `.tiff` | its own; several images, row y of image z holds data[:, y, z]; read by tifffile |
    | a folder of `.tif`, `.tiff` | their own; one image each, in the order of the numbers in their names |
    | the folder of a Zarr array, or of an OME-Zarr image | its own; by tensorstore (`jaxvol[bricks]`) |

    Raw files store x fastest, like those of the Open SciVis datasets. The JSON file has the raw file's name
    with `.json` appended, or in place of `.raw` or `.raw.gz`, and the datasets' keys `size`, `type`,
    `spacing`, `origin`, any of which may be missing. An argument overrides the JSON, and the JSON the name.

    Medical images are rescaled (CT in HU), float64 becomes float32, and axes are exchanged and reversed so
    that x, y, z increase towards the patient's left, back and head (LPS). An oblique image keeps its voxels,
    and the turn that is left is the volume's `direction`, with the shear of a tilted gantry; one below 1e-4,
    which headers' rounding makes, is left out. DICOM slices are sorted by where they lie, and keep their
    values where the lowest is to be shown white (MONOCHROME1). Integers of 32 and 64 bits, from any kind of
    file, are converted to smaller types, as described in `Volume`. Of the levels of an OME-Zarr image, the
    finest is read that takes at most a quarter of the memory; `render_bricks` takes finer ones.

    Ids of segments (labels) that are too large are replaced by 0, 1, 2, … in their order, and kept as
    `volume.label_ids`: those beyond 2**24 in a file whose voxels mostly equal their neighbours along an
    axis, and those of `labels` that do not lie from 0 to 255, as `LabelTransferFunction` wants them. (Of
    Zarr, ids beyond 2**24 are refused.)

    Args:
        path: the file.
        shape: number of voxels along x, y, z; raw files only.
        dtype: uint8, int8, uint16, int16, float16, float32 or float64, little-endian unless it ends in `be`
            (`uint16be`); raw files only.
        spacing: see `Volume`; by default the file's, or (1, 1, 1) if it has none.
        origin: see `Volume`; by default the file's, or (0, 0, 0) if it has none.
        direction: see `Volume`; by default the file's, or none. These three are of the axes as loaded.
        labels: a file or folder of any of these kinds that holds a segmentation, an integer for each voxel,
            at the same place: it becomes the volume's labels.
        nan: the value of voxels that are NaN or infinite in the file; by default, these are refused.
        time: which one of several images, from 0 on, where a file holds an axis of time.
        channel: which channel, from 0 on. Without it, several values in a voxel, as of colours, become the
            channels of the volume; an axis of channels needs it.

    Returns:
        The `Volume`, with voxels in the file's type except as described above.

    Raises:
        ValueError: for a file that is missing, empty, corrupt, of unknown kind, of another size than its
            header says, or without a header; for an image that is not 3-D; where it holds several, and
            `time` or `channel` does not say which; for several DICOM series in a folder, or slices that do
            not fit together; for labels that lie elsewhere; and for anything that `Volume` rejects.
        ImportError: for a format that needs SimpleITK, tifffile, imagecodecs or tensorstore if it is missing.
    """
    arguments = read(path, shape, dtype, spacing=spacing, nan=nan, time=time, channel=channel)
    given = {"spacing": spacing, "origin": origin, "direction": direction}
    arguments |= {name: value for name, value in given.items() if value is not None}
    try:
        volume = Volume(**arguments)
        return volume if labels is None else labelled(volume, labels)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def read(
    path: str | os.PathLike[str] | Any,
    shape: Any = None,
    dtype: Any = None,
    *,
    spacing: Any = None,
    nan: float | None = None,
    time: int | None = None,
    channel: int | None = None,
) -> dict[str, Any]:
    """What a file or folder holds, as arguments of `Volume`; those of which it says nothing are missing. The
    spacing is that of the volume, if the caller gives it."""
    path = _existing(path)
    index = {"time": time, "channel": channel}
    read_folder = next((read for knows, read in FOLDERS if path.is_dir() and knows(path)), None)
    if read_folder is None or shape is not None or dtype is not None:
        arguments = _one(path, _content(path, shape, dtype, spacing), index)
    else:
        arguments = read_folder(path, **index, nan=nan)
    data = arguments["data"]
    if nan is not None and data.dtype.kind == "f":
        arguments["data"] = np.where(np.isfinite(data), data, data.dtype.type(number("nan", nan)))
    if data.dtype.kind in "iu" and data.itemsize > 2 and not within(data, WHOLE["float32"]) and _is_ids(data):
        arguments |= _numbered(data)
    return arguments


def _is_ids(data: np.ndarray) -> bool:
    """Whether voxels are ids of segments, which may be thin along an axis."""
    return any(is_flat(np.moveaxis(data, axis, 0)) for axis in range(3))


def _content(path: Path, shape: Any, dtype: Any, spacing: Any) -> dict[str, Any]:
    name = path.name.lower()
    if name.endswith(RAW):
        return read_raw(path, shape, dtype)
    if shape is not None or dtype is not None:
        raise ValueError(f"shape and dtype are for raw files; {path} has its own. Leave them out.")
    if name.endswith(".vol"):
        use = "Use volume, probe = jv.load_ultrasound(path), and March(step, (probe, ...)) or jv.scan_convert"
        raise ValueError(f"path: {path} is ultrasound as acquired, whose voxels a probe places. {use}.")
    for ending, reader in READERS.items():
        if name.endswith(ending):
            return reader(path)
    if name.endswith(".dcm") or (dicom_files(path) if path.is_dir() else path.is_file() and is_dicom(path)):
        return read_dicom(path, spacing)  # on discs their names often have no ending
    if path.is_dir() and tiff_files(path):
        return read_tiff_folder(path)
    fault = (
        "is a directory without DICOM and TIFF files, and no Zarr"
        if path.is_dir()
        else "has an unknown ending"
    )
    raise ValueError(
        f"path: {path} {fault}; expected a folder of these, or a file ending in "
        f"{', '.join(sorted((*RAW, *READERS, '.dcm')))}."
    )


def _one(path: Path, arguments: dict[str, Any], given: dict[str, int | None]) -> dict[str, Any]:
    """The arguments with the volume that these indices choose, by `axes`, which are left out."""
    data = arguments["data"]
    axes = arguments.pop("axes", "xyzs"[: data.ndim])
    letters = {"time": "t", "channel": "c" if "c" in axes else "s"}
    sizes = ", ".join(f"{axis} {n}" for axis, n in zip(axes, data.shape, strict=False))
    for name, letter in letters.items():
        if given[name] is not None and letter not in axes:
            raise ValueError(f"{name}: {path} has no such axis; it holds {sizes}.")
    for at in reversed(range(3, len(axes))):
        name = "time" if axes[at] == "t" else "channel"
        index, count = given[name] if letters[name] == axes[at] else None, data.shape[at]
        if index is None and count > 1:
            if axes[at] == "s":
                continue  # the volume's channels
            raise ValueError(f"{name} must be given, from 0 to {count - 1}: {path} holds {sizes}.")
        data = data[(slice(None),) * at + (integer(name, index or 0, 0, count - 1),)]
    return arguments | {"data": data}


def labelled(volume: Volume, path: str | os.PathLike[str]) -> Volume:
    """The volume with the voxels of another file as labels."""
    try:
        found = read(path)
    except ValueError as fault:
        raise ValueError(f"labels: {str(fault).removeprefix('path: ')}") from fault
    if (values := found["data"]).dtype.kind == "f":
        if not np.array_equal(values, np.rint(values)):
            raise ValueError(f"labels: {path} must hold integers; got {values.dtype} with fractions.")
        found["data"] = values.astype(np.int64)
    if "label_ids" not in found and not within(found["data"], WHOLE["uint8"]):
        found |= _numbered(found["data"])
    labels = Volume(**found)
    here, there = map(_corners, (volume, labels))
    if not np.allclose(here, there, rtol=0, atol=0.05 * float(volume.spacing.min())):  # of a voxel
        raise ValueError(
            f"labels: {path} must lie where the volume does, with corners {here.tolist()}; it has "
            f"{there.tolist()}. SimpleITK's Resample, with sitkNearestNeighbor, puts it there."
        )
    place = volume.spacing, volume.origin
    numbers = np.asarray(labels.data)  # float32 of more than 65536 kinds
    numbers = numbers.astype(np.int32) if numbers.dtype.kind == "f" else numbers
    return Volume(volume.data, *place, numbers, direction=volume.direction, label_ids=labels.label_ids)


def _numbered(ids: np.ndarray) -> dict[str, Any]:
    """Arguments of `Volume`: numbers in the order of the ids, in place of these, and the ids."""
    kinds, numbers = np.unique(ids, return_inverse=True)
    return {"data": numbers.reshape(ids.shape), "label_ids": kinds.tolist()}


def _corners(volume: Volume) -> np.ndarray:
    """Where the first voxel lies in the world, and the last one along each axis."""
    direction = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    edges = direction * np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    return np.asarray(volume.origin) + np.vstack([np.zeros(3), edges.T])


def files_of(path: Path) -> list[Path]:
    """The files that `load` reads for a volume: of a folder, its slices; with a header, what it names; of one
    DICOM file, those of its series. None where there is no volume. Raises as `load` for a bad header."""
    if path.is_dir():
        return dicom_files(path) or tiff_files(path)
    if not path.is_file():  # a device may have no end
        return []
    name = path.name.lower()
    if name.endswith(RAW):
        return [path, *raw_json(path)]
    if name.endswith((".mhd", ".nrrd", ".nhdr")):
        data = (metaimage_header if name.endswith(".mhd") else nrrd_header)(path)[2]
        return [path, data] if data != path and data.is_file() else [path]
    return list(series_headers(path)) if is_dicom(path) else [path]


def load_ultrasound(path: str | os.PathLike[str] | Any) -> tuple[Volume, ToroidalMap]:
    """Load an ultrasound volume as acquired by a swept probe, and the map that places it in the world, from a
    Kretz file (`.vol`) of GE Voluson scanners: `KRETZFILE 1.0`, uncompressed, of 8-bit voxels.

    Angles are taken as they stand in the file, with the middle beam at π/2. The first sample of a beam has
    depth γ = 0. The format is not published: the reader is written after those of SlicerHeart and
    plooney/kretz, and tested on files of its tests alone, not on a scanner's own.

    Args:
        path: the file.

    Returns:
        The volume, `data[β, σ, γ]`, whose own spacing has no meaning, and the probe, in mm. Render them with
        `March(step, (probe, ...))`, or make a Cartesian volume with `scan_convert`.

    Raises:
        ValueError: for a file that is missing, empty, corrupt, cut short, compressed, of another kind, or
            lacks an item; for angles that are not evenly spaced to 0.01 of a step; and for what
            `ToroidalMap` and `Volume` reject.
    """
    data, probe = read_kretz(_existing(path))
    return Volume(data), probe


def _existing(path: str | os.PathLike[str] | Any) -> Path:
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise ValueError(f"path must be a str or a path; got {described(path)}.")
    path = Path(path)
    if not path.exists():
        raise ValueError(
            f"path: there is no file {path} (working directory {Path.cwd()}). Check the spelling."
        )
    return path
