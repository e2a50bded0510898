"""Writes volumes to files that `load` reads again as they were."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..._util.checks import described, output_file
from ..._util.files import reason
from ..._util.whole_files import whole_file
from ...scene.volume import Volume
from ...xla.platform import is_traced
from .medical import simple_itk
from .metaimage import metaimage_data


ENDINGS = (".mha", ".mhd", ".nii", ".nii.gz", ".npz", ".nrrd")


def save(volume: Volume | Any, path: str | os.PathLike[str] | Any) -> Path:
    """Write a volume to a file, in the format of its ending; `jv.load` reads the same volume.

    | ending | written |
    |---|---|
    | `.npz` | voxels, spacing, origin, direction, labels; compressed |
    | `.nrrd`, `.mha`, `.mhd` | voxels, spacing, origin, direction, by SimpleITK (`pip install jaxvol[io]`) |
    | `.nii`, `.nii.gz` | the same; direction is rounded, to about 1e-7 |

    Voxels are written in their own type, and read so. Medical formats are read along the patient's axes: a
    volume whose axes are turned by more than 45 degrees comes back with axes exchanged or reversed, and every
    voxel where it was in the world.

    A file that is there is replaced, at once when the new one is whole. `.mhd` are two files: the voxels go
    into one that ends in `.raw`, which is replaced first, and only if it belongs to the `.mhd` that is there.

    **Arguments:**

    - `volume`: with voxels, not with a `field`. It comes first; `save_png`, of images, has the path first.
    - `path`: the file to write. Folders are made where they are missing.

    **Returns:** the path.

    **Raises:** `ValueError` for an unknown ending, a volume that is traced or has a field, labels or a type
    of voxels that the format cannot hold, a file that cannot be written, and a `.raw` file beside an `.mhd`
    that is not the `.mhd`'s own. `ImportError` if the format needs SimpleITK, and it is missing.
    """
    if not isinstance(volume, Volume):
        hint = " The volume comes first, as in save(volume, path)." if isinstance(path, Volume) else ""
        raise ValueError(f"volume must be a Volume; got {described(volume)}.{hint}")
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"path must be a str or a path; got {described(path)}.")
    if is_traced(volume):
        raise ValueError("volume must not be traced: save it outside of jit and grad.")
    if volume.field is not None:
        raise ValueError("volume must have voxels; got one with a field. Save an array of its values.")
    path = output_file("path", path)
    name = path.name.lower()
    if not name.endswith(ENDINGS):
        raise ValueError(f"path must end in {', '.join(ENDINGS)}; got {path}.")
    if name.endswith(".mhd"):
        _check_beside(path)
    with whole_file(path) as part:
        if name.endswith(".npz"):
            _write_npz(volume, part)
        else:
            _write_medical(volume, part)
        for file in part.parent.iterdir():
            if file != part:  # the voxels of an .mhd
                os.replace(file, path.with_name(file.name))
    return path


def _check_beside(path: Path) -> None:
    """**Raises** `ValueError` if voxels of something else lie where those of an `.mhd` are written."""
    voxels = path.with_suffix(".raw")
    with suppress(ValueError):  # what is replaced is no MetaImage
        if not voxels.exists() or (path.is_file() and metaimage_data(path).resolve() == voxels.resolve()):
            return
    raise ValueError(
        f"path: the voxels of {path.name} would replace {voxels}, which does not belong to it. Save it under "
        "another name, or as .mha, which is one file."
    )


def _write_npz(volume: Volume, path: Path) -> None:
    if volume.data.dtype == "bfloat16":
        raise ValueError("volume has voxels of bfloat16, which .npz cannot hold; convert them to float32.")
    names = ("data", "spacing", "origin", "direction", "labels")
    arrays = {name: np.asarray(getattr(volume, name)) for name in names if getattr(volume, name) is not None}
    with path.open("wb") as stream:  # by a path, NumPy would append .npz to .NPZ
        np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]


def _write_medical(volume: Volume, path: Path) -> None:
    sitk = simple_itk(path)
    if volume.labels is not None:
        raise ValueError(
            f"volume has labels, for which {path.name} has no place. Save it as .npz, or save labels "
            "and voxels as two volumes, and read them by load(path, labels=...)."
        )
    data = np.asarray(volume.data)
    if data.dtype.name in ("float16", "bfloat16"):
        raise ValueError(
            f"volume has voxels of {data.dtype}, which {path.name} cannot hold. Convert them to float32."
        )
    image = sitk.GetImageFromArray(np.ascontiguousarray(data.T))
    image.SetSpacing(np.asarray(volume.spacing, float).tolist())
    image.SetOrigin(np.asarray(volume.origin, float).tolist())
    if volume.direction is not None:
        image.SetDirection(np.asarray(volume.direction, float).ravel().tolist())
    compress = not path.name.lower().endswith((".nii", ".mhd"))
    try:
        sitk.WriteImage(image, str(path), compress)
    except RuntimeError as fault:
        raise ValueError(f"path: {path.name} cannot be written ({reason(fault)}).") from fault
