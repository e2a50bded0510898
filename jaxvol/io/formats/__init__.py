"""Loading of volumes from files, by a reader for the ending of the name, which returns an `ImageRecord`.
Nothing is unpickled, and content is checked against the header before memory is allocated."""

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
from jax.typing import DTypeLike

from ..._util.checks import Arrayable, described
from ..._util.files import ensure, file_size, refusing
from ..._util.image_record import ImageRecord, numbered, volume_arguments
from ..._util.voxels import WHOLE, within
from ...march.transforms.toroidal_map import ToroidalMap
from ...scene.volume import Volume
from . import library_formats as known, tiff
from .arrays import RAW, read_npy, read_npz, read_raw
from .dicom import dicom_files, folders_below, is_dicom, read_dicom
from .kretz import MAGIC, read_kretz
from .save import save as save
from .text_headers import read_metaimage, read_nrrd
from .vtk_files import read_vtk


READERS: dict[str, Callable[..., ImageRecord]] = {".npy": read_npy, ".npz": read_npz}
READERS |= dict.fromkeys((".nrrd", ".nhdr"), read_nrrd) | dict.fromkeys((".mha", ".mhd"), read_metaimage)
READERS |= dict.fromkeys(known.NIFTI, known.read_nifti) | dict.fromkeys(tiff.ENDINGS, tiff.read_tiff)
READERS |= dict.fromkeys(known.MRC, known.read_mrc) | dict.fromkeys((".vti", ".vtk"), read_vtk)
READERS |= dict.fromkeys(known.HDF5, known.read_hdf5)
VAGUE = (".img", ".hdf", *known.MRC[1:])  # endings of raw voxels, too, if `shape` and `dtype` describe them

FOLDERS: list[tuple[Callable[[Path], bool], Callable[[Path], ImageRecord]]] = []
"""Tests for kinds of folders, and their readers. `bricks.opening`, imported to read a folder, adds Zarr."""


def load(
    path: str | os.PathLike[str],
    *,
    shape: Sequence[int] | np.ndarray | None = None,
    dtype: DTypeLike | None = None,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    direction: Arrayable | None = None,
    labels: str | os.PathLike[str] | None = None,
    nan: float | None = None,
    time: int | None = None,
    channel: int | None = None,
    offset: int | None = None,
) -> Volume:
    """Load a volume from a file, in the format of the ending of its name, or from a folder of slices.

    Formats: raw voxels (`name_XxYxZ_dtype.raw`, `.raw.gz`, or of any name with `shape` and `dtype`), `.npy`,
    `.npz`, NIfTI, Analyze, MGH, MINC, NRRD, MetaImage, TIFF, MRC, VTK's images, HDF5 and NetCDF
    (`file.h5::/name`), DICOM, folders of slices (DICOM, TIFF, PNG, JPEG), Zarr and OME-Zarr. The page "Files"
    of the documentation lists the metadata that is read of every format, and of the JSON file of raw voxels.

    Values are scaled as the file says (CT in HU), lengths are converted to mm if their unit is known, and
    axes are exchanged and reversed so that x, y, z increase along the world's: for medical images, towards
    the patient's left, back and head (LPS). An oblique image keeps its voxels; the remaining rotation, with
    the shear of a tilted gantry, is the volume's `direction`. A warning reports assumptions in place of
    missing metadata. Of an OME-Zarr image, the finest level that takes at most a quarter of the memory is
    read.

    Segment ids (labels) that are too large are replaced by their ranks 0, 1, 2, …, and kept as
    `volume.label_ids`: ids beyond 2**24 in a file whose voxels mostly equal their neighbours along an axis,
    and ids of `labels` outside of 0 to 255, the range of `LabelTransferFunction`.

    Args:
        path: the file, or the folder.
        shape: number of voxels along x, y, z; this, `dtype` and `offset` are for raw files, x fastest.
        dtype: an integer or float type of NumPy, little-endian unless it ends in `be` (`uint16be`).
        spacing: see `Volume`; by default the file's, or (1, 1, 1) if it has none.
        origin: see `Volume`; by default the file's, or (0, 0, 0) if it has none.
        direction: see `Volume`; by default the file's, or none. These three describe the axes as loaded.
        labels: a file or folder of a segmentation of the same grid, which becomes the volume's labels.
        nan: replaces voxels that are NaN or infinite, which are refused by default, and missing values, which
            become the minimum by default.
        time: index of the image, from 0, for a file with an axis of time.
        channel: index of the channel, from 0. Without it, several values per voxel, such as colours, become
            the channels of the volume; an axis of channels needs it.
        offset: bytes before the voxels.

    Returns:
        The `Volume`, with voxels in the file's type, or a smaller one as described in `Volume`.

    Raises:
        ValueError: for a file that is missing, damaged, of unknown format or of another size than its header
            says; for an image that is not 3-D; for several images or DICOM series without a choice; for
            inconsistent slices; for labels of another grid; and for arguments that `Volume` rejects.
        ImportError: for a format that needs a library that is missing: pip install "jaxvol[io]".
    """
    record = read_record(path, shape, dtype, spacing=spacing, time=time, offset=offset)
    arguments = volume_arguments(record, nan=nan, time=time, channel=channel)
    place = {"spacing": spacing, "origin": origin, "direction": direction}
    arguments |= {name: value for name, value in place.items() if value is not None}
    try:
        volume = Volume(**arguments)
        return volume if labels is None else labelled(volume, labels)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def read_record(
    path: str | os.PathLike[str],
    shape: Sequence[int] | np.ndarray | None = None,
    dtype: DTypeLike | None = None,
    spacing: Arrayable | None = None,
    time: int | None = None,
    offset: int | None = None,
) -> ImageRecord:
    """Read the voxels and metadata of a file or folder. Arguments: as for `load`."""
    path, name = _existing(path)
    lower, is_raw = path.name.lower(), shape is not None or dtype is not None or offset
    if path.is_dir():
        import_module("jaxvol.bricks.opening")  # adds to FOLDERS
    folder = next((read for matches, read in FOLDERS if path.is_dir() and matches(path)), None)
    ending = next((ending for ending in READERS if lower.endswith(ending)), None)
    is_slices = (path.is_file() and is_dicom(path)) or lower.endswith(".dcm") or lower == "dicomdir"
    ending = None if ending in VAGUE and shape is not None and dtype is not None else ending
    reader: Callable[..., ImageRecord]
    if lower.endswith(RAW) or (is_raw and not (folder or ending or path.is_dir() or is_slices)):
        reader = partial(read_raw, shape=shape, dtype=dtype, offset=offset or 0)
    elif is_raw:
        raise ValueError(f"shape and dtype are for raw files; {path} has its own. Leave them out.")
    elif folder:
        reader = folder
    elif ending:
        file_size(path)
        reader = partial(READERS[ending], name=name) if ending in known.HDF5 else READERS[ending]
    elif is_slices or (path.is_dir() and dicom_files(path)):
        reader = partial(read_dicom, spacing=spacing, time=time)  # file names on discs often have no ending
    elif path.is_dir() and tiff.slice_files(path):
        reader = tiff.read_slices
    else:
        raise ValueError(f"path: {path} {_unknown(path)}")
    with nullcontext() if folder else refusing(path):  # readers of FOLDERS report their own errors
        record = reader(path)
    record.what = f"path: {path}" if record.what == "data" else record.what
    record.format = record.format or lower.removesuffix(".gz").rpartition(".")[2] or "folder"
    return record


def _unknown(path: Path) -> str:
    """Reason why a path cannot be read."""
    endings = (*RAW, *READERS)
    if path.is_dir():
        content, series = sorted(path.iterdir()), folders_below(path)
        images = [folder for folder in content if folder.is_dir() and tiff.slice_files(folder)]
        files = [file for file in content if file.name.lower().endswith((*endings, ".zarr"))]
        names = ", ".join(str(item.relative_to(path)) for item in (series or images or files)[:8])
        if not names:
            return "is a directory without DICOM and TIFF files, other slices, and no Zarr."
        return f"is a directory that holds {'DICOM images in ' if series else ''}{names}: give its path."
    if path.is_file() and path.name.lower().endswith(".vol"):
        with path.open("rb") as stream:
            magic = stream.read(len(MAGIC))
        if magic == MAGIC:
            use = "Use volume, probe = jv.load_ultrasound(path), and March(step, (probe, ...))"
            return f"is ultrasound as acquired, whose voxels a probe places. {use}."
    hint = "For voxels without a header, give shape=(nx, ny, nz) and dtype."
    expected = f"expected a folder of slices, or a file ending in {', '.join(sorted((*endings, '.dcm')))}"
    return f"has an unknown ending; {expected}. {hint}"


def labelled(volume: Volume, path: str | os.PathLike[str]) -> Volume:
    """Volume with the voxels of another file as labels."""
    try:
        arguments = volume_arguments(read_record(path))
    except ValueError as fault:
        raise ValueError(f"labels: {str(fault).removeprefix('path: ')}") from fault
    if (values := arguments["data"]).dtype.kind == "f":
        are_whole = np.array_equal(values, np.rint(values))
        ensure(are_whole, f"labels: {path} must hold integers; got {values.dtype} with fractions.")
        arguments["data"] = values.astype(np.int64)
    if "label_ids" not in arguments and not within(arguments["data"], WHOLE["uint8"]):
        arguments |= numbered(arguments["data"])
    labels = Volume(**arguments)
    expected, corners = map(_corners, (volume, labels))
    must = f"labels: {path} must lie where the volume does, with corners {expected.tolist()}; it has"
    hint = "Resample it, for example by SimpleITK's Resample with sitkNearestNeighbor."
    fits = np.allclose(expected, corners, rtol=0, atol=0.05 * float(volume.spacing.min()))  # 0.05 voxels
    ensure(fits, f"{must} {corners.tolist()}. {hint}")
    place = volume.spacing, volume.origin
    numbers = np.asarray(labels.data)  # float32 if there are more than 65536 labels
    numbers = numbers.astype(np.int32) if numbers.dtype.kind == "f" else numbers
    return Volume(volume.data, *place, numbers, direction=volume.direction, label_ids=labels.label_ids)


def _corners(volume: Volume) -> np.ndarray:
    """World positions of the first voxel, and of the last one along every axis."""
    direction = np.eye(3) if volume.direction is None else np.asarray(volume.direction)
    edges = direction * np.asarray(volume.spacing) * (np.array(volume.shape) - 1)
    return np.asarray(volume.origin) + np.vstack([np.zeros(3), edges.T])


def load_ultrasound(path: str | os.PathLike[str]) -> tuple[Volume, ToroidalMap]:
    """Load an ultrasound volume as acquired by a swept probe, and the map that places it in the world.

    Angles are those of the file, with the middle beam at π/2. The first sample of a beam has depth γ = 0. The
    format is not published: the reader follows those of SlicerHeart and plooney/kretz, and is tested on
    synthetic files only, not on files of scanners.

    Args:
        path: the Kretz file (`.vol`) of a GE Voluson: `KRETZFILE 1.0`, uncompressed, with 8-bit voxels.

    Returns:
        The volume, `data[β, σ, γ]`, whose spacing has no meaning, and the probe, in mm. Render them with
        `March(step, (probe, ...))`, or make a Cartesian volume with `scan_convert`.

    Raises:
        ValueError: for a file that is missing, damaged, compressed or of another format; for angles that are
            not evenly spaced to 0.01 of a step; and for values that `ToroidalMap` and `Volume` reject.
    """
    data, probe = read_kretz(_existing(path)[0])
    return Volume(data), probe


def _existing(path: str | os.PathLike[str]) -> tuple[Path, str | None]:
    """Existing file of a path, and the name of an array in it, after `::`."""
    if not isinstance(path, str | os.PathLike) or not str(path):
        raise ValueError(f"path must be a str or a path; got {described(path)}.")
    file, name = Path(path), None
    if not file.exists() and "::" in str(path):
        before, _, name = str(path).rpartition("::")
        file = Path(before)
    hint = f"(working directory {Path.cwd()}). Check the spelling."
    ensure(file.exists(), f"path: there is no file {file} {hint}")
    return file, name
