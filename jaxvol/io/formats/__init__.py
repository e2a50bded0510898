"""Loads volumes from files, by readers chosen by the name's ending, which return an `ImageRecord`. Nothing is
unpickled, and content is checked against the header before memory is allocated."""

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import Arrayable, described
from ..._util.files import ensure, file_size, refusing
from ..._util.image_record import ImageRecord, numbered, volume_arguments
from ..._util.voxels import WHOLE, within
from ...march.transforms import ToroidalMap
from ...scene.volume import Volume
from . import library_formats as known, tiff
from .arrays import RAW, raw_json, read_npy, read_npz, read_raw
from .dicom import dicom_files, folders_below, is_dicom, read_dicom, series_headers
from .kretz import MAGIC, read_kretz
from .save import save as save
from .text_headers import metaimage_header, nrrd_header, read_metaimage, read_nrrd
from .vtk_files import read_vtk


READERS: dict[str, Callable[..., ImageRecord]] = {".npy": read_npy, ".npz": read_npz}
READERS |= dict.fromkeys((".nrrd", ".nhdr"), read_nrrd) | dict.fromkeys((".mha", ".mhd"), read_metaimage)
READERS |= dict.fromkeys(known.NIFTI, known.read_nifti) | dict.fromkeys(tiff.ENDINGS, tiff.read_tiff)
READERS |= dict.fromkeys(known.MRC, known.read_mrc) | dict.fromkeys((".vti", ".vtk"), read_vtk)
READERS |= dict.fromkeys(known.HDF5, known.read_hdf5)
VAGUE = (".img", ".hdf", *known.MRC[1:])  # of voxels without a header, too, if the caller describes these

FOLDERS: list[tuple[Callable[[Path], bool], Callable[[Path], ImageRecord]]] = []
"""What knows a kind of folder, and its reader. `bricks.opening`, imported where one is read, adds Zarr."""


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
    offset: int | None = None,
) -> Volume:
    """Load a volume from a file, whose format is given by the ending of its name, or from a folder of slices.

    Formats: raw voxels (`name_XxYxZ_dtype.raw`, `.raw.gz`, or of any name with `shape` and `dtype`), `.npy`,
    `.npz`, NIfTI, Analyze, MGH, MINC, NRRD, MetaImage, TIFF, MRC, VTK's images, HDF5 and NetCDF
    (`file.h5::/name`), DICOM, folders of slices (DICOM, TIFF, PNG, JPEG), Zarr and OME-Zarr. The page "Files"
    of the documentation has a table of what is read of each, and of the JSON file beside raw voxels.

    Values are scaled as the file says (CT in HU), lengths become mm where their unit is known, and axes are
    exchanged and reversed so that x, y, z increase along the world's: of medical images, towards the
    patient's left, back and head (LPS). An oblique image keeps its voxels, and the turn that is left, with
    the shear of a tilted gantry, is the volume's `direction`. A warning says what was taken in place of what
    the file does not say. Of the levels of an OME-Zarr image, the finest is read that takes at most a quarter
    of the memory.

    Ids of segments (labels) that are too large are replaced by 0, 1, 2, … in their order, and kept as
    `volume.label_ids`: those beyond 2**24 in a file whose voxels mostly equal their neighbours along an
    axis, and those of `labels` that do not lie from 0 to 255, as `LabelTransferFunction` wants them.

    Args:
        path: the file, or the folder.
        shape: number of voxels along x, y, z; this, `dtype` and `offset` are for raw files, x fastest.
        dtype: an integer or float type of NumPy, little-endian unless it ends in `be` (`uint16be`).
        spacing: see `Volume`; by default the file's, or (1, 1, 1) if it has none.
        origin: see `Volume`; by default the file's, or (0, 0, 0) if it has none.
        direction: see `Volume`; by default the file's, or none. These three are of the axes as loaded.
        labels: a file or folder of a segmentation at the same place, which becomes the volume's labels.
        nan: the value of voxels that are NaN or infinite in the file, which are refused by default, and of
            those that it calls missing, which take the least value by default.
        time: which one of several images, from 0 on, where a file holds an axis of time.
        channel: which channel, from 0 on. Without it, several values in a voxel, as of colours, become the
            channels of the volume; an axis of channels needs it.
        offset: bytes before the voxels.

    Returns:
        The `Volume`, with voxels in the file's type, or a smaller one as described in `Volume`.

    Raises:
        ValueError: for a file that is missing, damaged, of unknown kind or of another size than its header
            says; for an image that is not 3-D; for several images or DICOM series, if nothing says which; for
            slices that do not fit together; for labels that lie elsewhere; and for what `Volume` rejects.
        ImportError: for a format that needs a library that is missing: pip install "jaxvol[io]".
    """
    record = read_record(path, shape, dtype, spacing=spacing, time=time, offset=offset)
    arguments = volume_arguments(record, nan=nan, time=time, channel=channel)
    given = {"spacing": spacing, "origin": origin, "direction": direction}
    arguments |= {name: value for name, value in given.items() if value is not None}
    try:
        volume = Volume(**arguments)
        return volume if labels is None else labelled(volume, labels)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def read_record(
    path: Any, shape: Any = None, dtype: Any = None, spacing: Any = None, time: Any = None, offset: Any = None
) -> ImageRecord:
    """What a file or folder holds, and says of it. Arguments: as for `load`."""
    path, name = _existing(path)
    lower, given = path.name.lower(), shape is not None or dtype is not None or offset
    if path.is_dir():
        import_module("jaxvol.bricks.opening")  # if nothing else has
    folder = next((read for knows, read in FOLDERS if path.is_dir() and knows(path)), None)
    ending = next((ending for ending in READERS if lower.endswith(ending)), None)
    is_slices = (path.is_file() and is_dicom(path)) or lower.endswith(".dcm") or lower == "dicomdir"
    ending = None if ending in VAGUE and shape is not None and dtype is not None else ending
    reader: Callable[..., ImageRecord]
    if lower.endswith(RAW) or (given and not (folder or ending or path.is_dir() or is_slices)):
        reader = partial(read_raw, shape=shape, dtype=dtype, offset=offset or 0)
    elif given:
        raise ValueError(f"shape and dtype are for raw files; {path} has its own. Leave them out.")
    elif folder:
        reader = folder
    elif ending:
        file_size(path)
        reader = partial(READERS[ending], name=name) if ending in known.HDF5 else READERS[ending]
    elif is_slices or (path.is_dir() and dicom_files(path)):
        reader = partial(read_dicom, spacing=spacing, time=time)  # on discs their names often have no ending
    elif path.is_dir() and tiff.slice_files(path):
        reader = tiff.read_slices
    else:
        raise ValueError(f"path: {path} {_unknown(path)}")
    with nullcontext() if folder else refusing(path):  # what others know tells its own faults
        record = reader(path)
    record.what = f"path: {path}" if record.what == "data" else record.what
    record.format = record.format or lower.removesuffix(".gz").rpartition(".")[2] or "folder"
    return record


def _unknown(path: Path) -> str:
    """Why a path is not read."""
    endings = (*RAW, *READERS)
    if path.is_dir():
        inside, series = sorted(path.iterdir()), folders_below(path)
        images = [each for each in inside if each.is_dir() and tiff.slice_files(each)]
        files = [each for each in inside if each.name.lower().endswith((*endings, ".zarr"))]
        told = ", ".join(str(each.relative_to(path)) for each in (series or images or files)[:8])
        if not told:
            return "is a directory without DICOM and TIFF files, other slices, and no Zarr."
        return f"is a directory that holds {'DICOM images in ' if series else ''}{told}: give its path."
    if path.is_file() and path.name.lower().endswith(".vol"):
        with path.open("rb") as stream:
            magic = stream.read(len(MAGIC))
        if magic == MAGIC:
            use = "Use volume, probe = jv.load_ultrasound(path), and March(step, (probe, ...))"
            return f"is ultrasound as acquired, whose voxels a probe places. {use}."
    hint = "Of voxels without a header, give shape=(nx, ny, nz) and dtype."
    expected = f"expected a folder of slices, or a file ending in {', '.join(sorted((*endings, '.dcm')))}"
    return f"has an unknown ending; {expected}. {hint}"


def labelled(volume: Volume, path: str | os.PathLike[str]) -> Volume:
    """The volume with the voxels of another file as labels."""
    try:
        found = volume_arguments(read_record(path))
    except ValueError as fault:
        raise ValueError(f"labels: {str(fault).removeprefix('path: ')}") from fault
    if (values := found["data"]).dtype.kind == "f":
        are_whole = np.array_equal(values, np.rint(values))
        ensure(are_whole, f"labels: {path} must hold integers; got {values.dtype} with fractions.")
        found["data"] = values.astype(np.int64)
    if "label_ids" not in found and not within(found["data"], WHOLE["uint8"]):
        found |= numbered(found["data"])
    labels = Volume(**found)
    here, there = map(_corners, (volume, labels))
    must = f"labels: {path} must lie where the volume does, with corners {here.tolist()}; it has"
    hint = "SimpleITK's Resample, with sitkNearestNeighbor, puts it there."
    same = np.allclose(here, there, rtol=0, atol=0.05 * float(volume.spacing.min()))  # of a voxel
    ensure(same, f"{must} {there.tolist()}. {hint}")
    place = volume.spacing, volume.origin
    numbers = np.asarray(labels.data)  # float32 of more than 65536 kinds
    numbers = numbers.astype(np.int32) if numbers.dtype.kind == "f" else numbers
    return Volume(volume.data, *place, numbers, direction=volume.direction, label_ids=labels.label_ids)


def _corners(volume: Volume) -> np.ndarray:
    """Where the first voxel lies in the world, and the last one along each axis."""
    direction = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    edges = direction * np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    return np.asarray(volume.origin) + np.vstack([np.zeros(3), edges.T])


def files_of(path: Path) -> list[Path]:
    """The files that `load` reads for a volume: of a folder, its slices; with a header, what it names; of one
    DICOM file, those of its series. None where there is no volume. Raises as `load` for a bad header."""
    path = Path(str(path).partition("::")[0])
    if path.is_dir():
        return dicom_files(path) or tiff.slice_files(path)
    if not path.is_file():  # a device may have no end
        return []
    name = path.name.lower()
    if name.endswith(RAW):
        return [path, *raw_json(path)]
    if name.endswith((".hdr", ".img")):
        return sorted(file for ending in (".hdr", ".img") if (file := path.with_suffix(ending)).is_file())
    with refusing(path):
        if name.endswith((".mhd", ".nrrd", ".nhdr")):
            data = (metaimage_header if name.endswith(".mhd") else nrrd_header)(path)[2]
            return [path, data] if data != path and data.is_file() else [path]
        return list(series_headers(path)) if is_dicom(path) else [path]


def load_ultrasound(path: str | os.PathLike[str] | Any) -> tuple[Volume, ToroidalMap]:
    """Load an ultrasound volume as acquired by a swept probe, and the map that places it in the world.

    Angles are taken as they stand in the file, with the middle beam at π/2. The first sample of a beam has
    depth γ = 0. The format is not published: the reader is written after those of SlicerHeart and
    plooney/kretz, and tested on files of its tests alone, not on a scanner's own.

    Args:
        path: the Kretz file (`.vol`) of a GE Voluson: `KRETZFILE 1.0`, uncompressed, of 8-bit voxels.

    Returns:
        The volume, `data[β, σ, γ]`, whose own spacing has no meaning, and the probe, in mm. Render them with
        `March(step, (probe, ...))`, or make a Cartesian volume with `scan_convert`.

    Raises:
        ValueError: for a file that is missing, damaged, compressed or of another kind; for angles that are
            not evenly spaced to 0.01 of a step; and for what `ToroidalMap` and `Volume` reject.
    """
    data, probe = read_kretz(_existing(path)[0])
    return Volume(data), probe


def _existing(path: str | os.PathLike[str] | Any) -> tuple[Path, str | None]:
    """The file of a path, and the name of what is meant in it, behind `::`."""
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise ValueError(f"path must be a str or a path; got {described(path)}.")
    file, name = Path(path), None
    if not file.exists() and "::" in str(path):
        before, _, name = str(path).rpartition("::")
        file = Path(before)
    here = f"(working directory {Path.cwd()}). Check the spelling."
    ensure(file.exists(), f"path: there is no file {file} {here}")
    return file, name
