"""Writing of volumes to files, which `load` reads without loss."""

import gzip
import os
from pathlib import Path

import numpy as np

from ..._util.affine import SHEARED
from ..._util.checks import described, output_file
from ..._util.files import ensure, library, reason
from ..._util.whole_files import whole_file
from ...scene.volume import Volume, check_one_channel
from .arrays import VOLUME


ENDINGS = (".mha", ".nii", ".nii.gz", ".npz", ".nrrd")


def save(volume: Volume, path: str | os.PathLike[str]) -> Path:
    """Write a volume to a file, in the format of its ending; `jv.load` reads the same volume.

    | ending | content |
    |---|---|
    | `.npz` | voxels, spacing, origin, direction, labels and their ids; compressed |
    | `.nrrd`, `.mha` | voxels, spacing, origin, direction; by SimpleITK (`pip install "jaxvol[io]"`) |
    | `.nii`, `.nii.gz` | the same, rounded to about 1e-7, as sform and, unless sheared, as qform |

    Voxels keep their type. Medical formats are read along the patient's axes: a volume whose axes are turned
    by more than 45 degrees is loaded with axes exchanged or reversed, and every voxel at the same world
    position. An existing file is replaced, in one operation.

    Args:
        volume: with voxels, not with a `field`. It comes first; `save_png`, of images, has the path first.
        path: the file to write. Missing folders are made.

    Returns:
        The path.

    Raises:
        ValueError: for an unknown ending, a volume with a field, labels or a type of voxels that the format
            cannot hold, and a file that cannot be written.
        ImportError: if the format needs a library that is missing.
    """
    hint = "The volume comes first, as in save(volume, path)."
    ensure(isinstance(volume, Volume), f"volume must be a Volume; got {described(volume)}. {hint}")
    ensure(isinstance(path, str | os.PathLike), f"path must be a str or a path; got {described(path)}.")
    ensure(volume.field is None, "volume must have voxels; got a field. Save an array of its values.")
    path = output_file("path", path)
    name, kind = path.name.lower(), volume.data.dtype.name
    in_npz = name.endswith(".npz")
    if not in_npz:
        check_one_channel(volume, f"{path.suffix} (.npz holds several)")
    ensure(name.endswith(ENDINGS), f"path must end in {', '.join(ENDINGS)}; got {path}.")
    is_held = kind not in (("bfloat16",) if in_npz else ("bfloat16", "float16"))
    ensure(is_held, f"volume has voxels of {kind}, which {path.name} cannot hold. Convert to float32.")
    has_labels, fault = volume.labels is not None or volume.label_ids, f"for which {path.name} has no place"
    hint = "Save it as .npz, or labels and voxels as two volumes, to be read by load(path, labels=...)."
    ensure(in_npz or not has_labels, f"volume has labels, {fault}. {hint}")
    parts = {part: getattr(volume, part) for part in VOLUME}
    arrays = {part: np.asarray(array) for part, array in parts.items() if array is not None}
    if ids := volume.label_ids:
        arrays["label_ids"] = np.array(ids, np.uint64 if min(ids) >= 0 else np.int64)
    with whole_file(path) as file:
        if in_npz:
            with file.open("wb") as stream:  # by a path, NumPy would append .npz to .NPZ
                np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
        elif name.endswith((".nii", ".nii.gz")):
            content = _nifti(arrays, file)
            file.write_bytes(gzip.compress(content, 6) if name.endswith(".gz") else content)
        else:
            _write_medical(arrays, file)
    return path


def _nifti(arrays: dict[str, np.ndarray], path: Path) -> bytes:
    """Bytes of a NIfTI-1 with an sform, which keeps shears, and the same qform unless sheared."""
    data, turn, affine = arrays["data"], arrays.get("direction", np.eye(3)).astype(float), np.eye(4)
    fits = max(data.shape) < 2**15
    ensure(fits, f"path: NIfTI-1 holds fewer than 32768 voxels along an axis; got {data.shape}.")
    affine[:3] = np.diag([-1.0, -1, 1]) @ np.column_stack([turn * arrays["spacing"], arrays["origin"]])  # RAS
    image = library("nibabel", path).Nifti1Image(data, affine)
    image.set_sform(affine, 1)
    if np.abs(turn.T @ turn - np.eye(3)).max() <= SHEARED:
        image.set_qform(affine, 1)
    image.header.set_xyzt_units("mm")
    return image.to_bytes()


def _write_medical(arrays: dict[str, np.ndarray], path: Path) -> None:
    sitk = library("SimpleITK", path)
    image = sitk.GetImageFromArray(np.ascontiguousarray(arrays["data"].T))
    image.SetSpacing(arrays["spacing"].astype(float).tolist())
    image.SetOrigin(arrays["origin"].astype(float).tolist())
    image.SetDirection(arrays.get("direction", np.eye(3)).astype(float).ravel().tolist())
    try:
        sitk.WriteImage(image, str(path), True)
    except RuntimeError as fault:
        raise ValueError(f"path: {path.name} cannot be written ({reason(fault)}).") from fault
