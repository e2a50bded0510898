"""Loads volumes from files, with a reader chosen by the ending of the file's name, and saves them.

A reader returns the arguments of `Volume` that the file holds; the caller's own arguments to `load` override
them. Files are data: nothing is unpickled, and the content of a file is checked against its header before
memory is allocated for it.
"""

import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..._util.checks import Arrayable, described
from ..._util.files import Header
from ..._util.npy import npz_names, read_npy, read_npz
from ...march.transforms import ToroidalMap
from ...scene.volume import Volume
from .dicom import dicom_files, is_dicom, read_dicom, series_files
from .kretz import read_kretz, refuse_kretz
from .medical import nrrd_data, read_medical
from .metaimage import metaimage_data, read_metaimage
from .raw import ENDINGS as RAW, raw_json, raw_json_header, read_raw
from .save import save as save
from .tiff import ENDINGS as TIFF, read_tiff, read_tiff_folder, tiff_files, tiff_spacing


Reader: TypeAlias = Callable[[Path, Header], dict[str, Any]]

READERS: dict[str, Reader] = {
    **dict.fromkeys(RAW, read_raw),
    ".npy": read_npy,
    ".npz": read_npz,
    **dict.fromkeys((".nii", ".nii.gz", ".nrrd", ".nhdr"), read_medical),
    **dict.fromkeys((".mha", ".mhd"), read_metaimage),
    ".dcm": read_dicom,
    **dict.fromkeys(TIFF, read_tiff),
    ".vol": refuse_kretz,
}


def load(
    path: str | os.PathLike[str] | Any,
    *,
    shape: Sequence[int] | Any | None = None,
    dtype: str | Any | None = None,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
    direction: Arrayable | None = None,
    labels: str | os.PathLike[str] | None = None,
) -> Volume:
    """Load a volume from a file, whose format is given by the ending of its name, or from a folder of slices.

    | ending | header |
    |---|---|
    | `.raw`, `.raw.gz` | the arguments; else a JSON file beside it; else the name `name_XxYxZ_dtype.raw` |
    | `.npy` | its own; the array is data[x, y, z] |
    | `.npz` | its own; `data` and, if any, `spacing`, `origin`, `direction`, `labels`; or any one array |
    | `.mha`, `.mhd` | its own |
    | `.nii`, `.nii.gz`, `.nrrd`, `.nhdr` | its own; read by SimpleITK (`pip install jaxvol[io]`) |
    | a folder of DICOM slices, or one of them, of any ending: its series | their own; read by SimpleITK |
    | `.tif`, `.tiff` | its own; several images, row y of image z holds data[:, y, z]; read by tifffile |
    | a folder of `.tif`, `.tiff` | their own; one image each, in the order of the numbers in their names |

    Raw files store x fastest, like those of the Open SciVis datasets. The JSON file has the raw file's name
    with `.json` appended, or in place of `.raw` or `.raw.gz`, and uses the datasets' keys `size`, `type` and
    `spacing`, and `origin`; any of them may be missing. If the sources differ, an argument overrides the
    JSON, and the JSON overrides the name; nothing is guessed.

    Medical images are rescaled (CT in HU), float64 becomes float32, and axes are exchanged and reversed so
    that x, y, z increase towards the patient's left, back and head (LPS). An oblique image keeps its voxels,
    and the turn that is left is the volume's `direction`. DICOM slices are sorted by where they lie; their
    names and numbers do not count. Integers of 32 and 64 bits, from any kind of file, are
    converted to smaller types, as described in `Volume`.

    **Arguments:**

    - `path`: the file.
    - `shape`: number of voxels along x, y, z; raw files only.
    - `dtype`: uint8, int8, uint16, int16, float16, float32 or float64, little-endian unless it ends in
      `be` (`uint16be`); raw files only.
    - `spacing`: see `Volume`; by default the file's, or (1, 1, 1) if it has none.
    - `origin`: see `Volume`; by default the file's, or (0, 0, 0) if it has none.
    - `direction`: see `Volume`; by default the file's, or none. These three are of the axes as loaded.
    - `labels`: a file or folder of any of these kinds that holds a segmentation, an integer for each voxel,
      at the same place: it becomes the volume's labels.

    **Returns:** the `Volume`, with voxels in the file's type except as described above.

    **Raises:** `ValueError` for a file that is missing, empty, corrupt, of unknown kind, longer or
    shorter than its header says, or without a header; for an image that is not 3-D or not scalar; for a
    folder of several DICOM series, or in which slices are missing, there twice, or do not fit together; for
    labels that lie elsewhere; for `.vol` files, which `load_ultrasound` reads; and for anything that `Volume`
    rejects. `ImportError` for a format that needs SimpleITK or tifffile if it is missing.
    """
    path = _existing(path)
    given = (("spacing", spacing), ("origin", origin), ("direction", direction))
    overrides = {name: value for name, value in given if value is not None}
    arguments = _reader(path)(path, Header(shape, dtype)) | overrides
    try:
        volume = Volume(**arguments)
        return volume if labels is None else _labelled(volume, labels)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def _reader(path: Path) -> Reader:
    """The reader for a file, by the ending of its name, or for a folder, by what is in it."""
    endings = [ending for ending in READERS if path.name.lower().endswith(ending)]
    if endings:
        return READERS[max(endings, key=len)]
    if (path.is_dir() and dicom_files(path)) or (path.is_file() and is_dicom(path)):
        return read_dicom  # on discs their names often have no ending
    if path.is_dir() and tiff_files(path):
        return read_tiff_folder
    fault = "is a directory without DICOM and TIFF files" if path.is_dir() else "has an unknown ending"
    raise ValueError(
        f"path: {path} {fault}; expected a folder of these, or a file ending in {', '.join(sorted(READERS))}."
    )


def _labelled(volume: Volume, labels: str | os.PathLike[str]) -> Volume:
    """The volume with the voxels of another file as labels."""
    other = load(labels)
    # a hundredth of a voxel, at the far end of some hundred
    slack = {"origin": 0.01 * float(volume.spacing.min()), "shape": 0}
    for name in ("shape", "spacing", "origin", "direction"):
        own, found = (
            np.eye(3) if value is None else np.asarray(value)
            for value in (getattr(volume, name), getattr(other, name))
        )
        relative = 1e-4 if name == "spacing" else 0
        if not np.allclose(own, found, rtol=relative, atol=slack.get(name, 1e-4)):
            raise ValueError(
                f"labels: {labels} must have the {name} of the volume, {own.tolist()}; it has "
                f"{found.tolist()}."
            )
    values = np.asarray(other.data)
    if values.dtype.kind == "f":
        if not np.array_equal(values, np.rint(values)):
            raise ValueError(f"labels: {labels} must hold integers; got {values.dtype} with fractions.")
        with np.errstate(invalid="ignore"):  # `Volume` checks the range
            values = values.astype(np.int64)
    return Volume(volume.data, volume.spacing, volume.origin, values, direction=volume.direction)


def files_of(path: Path) -> list[Path]:
    """The files that `load` reads for a volume: of a folder, its slices; beside a header, what it names; of
    one DICOM file, those of its series. None where there is no volume.

    **Raises:** `ValueError` for a file whose header cannot be read."""
    if path.is_dir():
        return dicom_files(path) or tiff_files(path)
    if not path.is_file():  # a device may have no end
        return []
    name = path.name.lower()
    if name.endswith(RAW):
        beside = raw_json(path)
        return [path] if beside is None else [path, beside]
    if name.endswith((".mhd", ".nrrd", ".nhdr")):
        data = metaimage_data(path) if name.endswith(".mhd") else nrrd_data(path)
        return [path, data] if data != path and data.is_file() else [path]
    return series_files(path) if is_dicom(path) else [path]


def says_where_it_lies(path: Path) -> bool:
    """Whether a file says where in the world its volume lies, and how its axes are turned."""
    return "origin" in _place_told(path)


def says_its_spacing(path: Path) -> bool:
    """Whether a file of voxels, or the header beside it, says how far they lie apart."""
    return "spacing" in _place_told(path)


def _place_told(path: Path) -> Collection[str]:
    """Which of spacing and origin a file tells, without reading its voxels."""
    name = path.name.lower()
    if name.endswith(RAW):  # an origin there says nothing of the axes
        return raw_json_header(path).keys() - {"origin"}
    if name.endswith(".npz"):
        return npz_names(path)
    if name.endswith(TIFF):
        return tiff_spacing(path)
    if name.endswith(".npy") or (path.is_dir() and tiff_files(path) and not dicom_files(path)):
        return ()
    return ("spacing", "origin")


def load_ultrasound(path: str | os.PathLike[str] | Any) -> tuple[Volume, ToroidalMap]:
    """Load an ultrasound volume as acquired by a swept probe, and the map that places it in the world.

    | ending | what |
    |---|---|
    | `.vol` | Kretz files of GE Voluson scanners, `KRETZFILE 1.0`, uncompressed; 8-bit voxels |

    Read are the volume and its geometry, and nothing of the patient or the settings; of a Doppler scan, the
    B-mode volume. Angles are taken as they stand in the file, with the middle beam at π/2; those of planes
    and beams must be evenly spaced to 0.01 of a step, by which a voxel may be misplaced. The first sample of
    a beam has depth γ = 0.

    **Arguments:**

    - `path`: the file.

    **Returns:** the volume, `data[β, σ, γ]`, whose own spacing has no meaning, and the probe, in mm. Render
    them with `March(step, (probe, ...))`, or make a Cartesian volume with `scan_convert`.

    **Raises:** `ValueError` for a file that is missing, empty, corrupt, cut short, compressed, of another
    kind, or lacks an item; for angles that are not evenly spaced; and for what `ToroidalMap` and `Volume`
    reject. Sizes are compared with the file's before memory is taken.

    The format is not published. The reader is tested on files written by its tests, after the readers of
    SlicerHeart and plooney/kretz, and not on a scanner's own.
    """
    path = _existing(path)
    data, probe = read_kretz(path)
    return Volume(data), probe


def _existing(path: str | os.PathLike[str] | Any) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path must be a str or a path; got {described(path)}.")
    if not str(path):
        raise ValueError("path must be that of a file or folder; got ''.")
    path = Path(path)
    if not path.exists():
        raise ValueError(
            f"path: there is no file {path} (working directory {Path.cwd()}). Check the spelling."
        )
    return path


def register(ending: str, reader: Reader) -> None:
    """Register a reader with `load` for a new kind of file, or in place of an existing one.

    **Arguments:**

    - `ending`: how the files' names end, such as `".vti"`; case is ignored, and of two endings that match
      a name the longer one is used.
    - `reader`: `reader(path, header)` returns a dict of arguments of `Volume`: `data`, and those of
      `spacing`, `origin`, `direction` and `labels` that the file holds. A reader of files that contain their
      shape and type calls `header.refuse(path)`. `path` exists, and may be a directory.

    **Raises:** `ValueError` for an ending without a dot.
    """
    if not ending.startswith("."):
        raise ValueError(f'ending must start with a dot, such as ".vti"; got {ending!r}.')
    READERS[ending.lower()] = reader
