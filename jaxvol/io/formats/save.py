"""Writes volumes to files that `load` reads again as they were."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import described, output_file
from ..._util.files import library, reason
from ..._util.npy import VOLUME
from ..._util.whole_files import whole_file
from ...scene.volume import Volume, check_one_channel
from .nifti import write_nifti


ENDINGS = (".mha", ".nii", ".nii.gz", ".npz", ".nrrd")


def save(volume: Volume | Any, path: str | os.PathLike[str] | Any) -> Path:
    """Write a volume to a file, in the format of its ending; `jv.load` reads the same volume.

    | ending | written |
    |---|---|
    | `.npz` | voxels, spacing, origin, direction, labels and their ids; compressed |
    | `.nrrd`, `.mha` | voxels, spacing, origin, direction; by SimpleITK (`pip install "jaxvol[io]"`) |
    | `.nii`, `.nii.gz` | the same, rounded to about 1e-7, as sform and, unless sheared, as qform |

    Voxels are written in their own type, and read so. Medical formats are read along the patient's axes: a
    volume whose axes are turned by more than 45 degrees comes back with axes exchanged or reversed, and every
    voxel where it was in the world. A file that is there is replaced, at once when the new one is whole.

    Args:
        volume: with voxels, not with a `field`. It comes first; `save_png`, of images, has the path first.
        path: the file to write. Folders are made where they are missing.

    Returns:
        The path.

    Raises:
        ValueError: for an unknown ending, a volume that has a field, labels or a type of voxels that the
            format cannot hold, and a file that cannot be written.
        ImportError: if the format needs SimpleITK, and it is missing.
    """
    if not isinstance(volume, Volume):
        told = f"volume must be a Volume; got {described(volume)}"
        raise ValueError(f"{told}. The volume comes first, as in save(volume, path).")
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path must be a str or a path; got {described(path)}.")
    if volume.field is not None:
        raise ValueError("volume must have voxels; got one with a field. Save an array of its values.")
    path = output_file("path", path)
    if not path.name.lower().endswith(".npz"):
        check_one_channel(volume, f"{path.suffix} (.npz holds several)")
    name = path.name.lower()
    if not name.endswith(ENDINGS):
        raise ValueError(f"path must end in {', '.join(ENDINGS)}; got {path}.")
    unknown = ("bfloat16",) if name.endswith(".npz") else ("bfloat16", "float16")
    if volume.data.dtype.name in unknown:
        raise ValueError(
            f"volume has voxels of {volume.data.dtype}, which {path.name} cannot hold. Convert to float32."
        )
    if (volume.labels is not None or volume.label_ids) and not name.endswith(".npz"):
        raise ValueError(
            f"volume has labels, for which {path.name} has no place. Save it as .npz, or save labels "
            "and voxels as two volumes, and read them by load(path, labels=...)."
        )
    parts = {part: getattr(volume, part) for part in VOLUME}
    arrays = {part: np.asarray(array) for part, array in parts.items() if array is not None}
    if volume.label_ids:
        arrays["label_ids"] = np.array(
            volume.label_ids, np.uint64 if min(volume.label_ids) >= 0 else np.int64
        )
    with whole_file(path) as file:
        if name.endswith(".npz"):
            with file.open("wb") as stream:  # by a path, NumPy would append .npz to .NPZ
                np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
        elif name.endswith((".nii", ".nii.gz")):
            write_nifti(file, arrays, packed=name.endswith(".gz"))
        else:
            _write_medical(arrays, file)
    return path


def _write_medical(arrays: dict[str, np.ndarray], path: Path) -> None:
    sitk = library("SimpleITK", path)
    image = sitk.GetImageFromArray(np.ascontiguousarray(arrays["data"].T))
    image.SetSpacing(arrays["spacing"].astype(float).tolist())
    image.SetOrigin(arrays["origin"].astype(float).tolist())
    if "direction" in arrays:
        image.SetDirection(arrays["direction"].astype(float).ravel().tolist())
    try:
        sitk.WriteImage(image, str(path), True)
    except RuntimeError as fault:
        raise ValueError(f"path: {path.name} cannot be written ({reason(fault)}).") from fault
