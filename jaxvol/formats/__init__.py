"""Which reader is for which file?

One registry leads from the ending of a file's name to a reader, and `register` adds to it. A reader
gives the arguments of `Volume` that the file holds; `load` puts the caller's own in their place.

Files are data: nothing is unpickled, and what a file holds is checked against its header before
memory is taken for it. (`medical` says for which files that is left to SimpleITK.)
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from .._util.checks import Arrayable
from .._util.files import Header
from .._util.npy import read_npy, read_npz
from ..volume import Volume
from .medical import read_medical
from .raw import read_raw


Reader: TypeAlias = Callable[[Path, Header], dict[str, Any]]

READERS: dict[str, Reader] = {
    ".raw": read_raw,
    ".raw.gz": read_raw,
    ".npy": read_npy,
    ".npz": read_npz,
    **dict.fromkeys((".nii", ".nii.gz", ".mha", ".mhd", ".nrrd"), read_medical),
}


def load(
    path: str | os.PathLike[str],
    *,
    shape: Sequence[int] | Any | None = None,
    dtype: str | Any | None = None,
    spacing: Arrayable | None = None,
    origin: Arrayable | None = None,
) -> Volume:
    """The volume in a file, its kind told by the ending of its name.

    | ending | header |
    |---|---|
    | `.raw`, `.raw.gz` | the arguments; else a JSON beside it; else the name `name_XxYxZ_dtype.raw` |
    | `.npy` | its own; the array is data[x, y, z] |
    | `.npz` | its own; arrays `data` and, if there, `spacing`, `origin`, `labels`; or one array of any name |
    | `.nii`, `.nii.gz`, `.mha`, `.mhd`, `.nrrd` | its own; read by SimpleITK (`pip install jaxvol[io]`) |

    Raw files hold x fastest, as those of the Open SciVis datasets do. The JSON is called like the file
    with `.json` appended, or in place of `.raw` or `.raw.gz`, and uses the datasets' keys `size`,
    `type` and `spacing`, and `origin`; any of them may be missing. Where the sources differ nothing is
    guessed: an argument wins over the JSON, the JSON over the name.

    Medical images come out scaled (CT in HU), turned so that x, y, z grow towards the patient's left,
    back and head (LPS), and float64 becomes float32. Integers of 32 and 64 bits become smaller, from whatever
    file they come, as `Volume` says.

    **Arguments:**

    - `path`: the file.
    - `shape`: number of voxels along x, y, z; raw files only.
    - `dtype`: uint8, int8, uint16, int16, float16, float32 or float64, little-endian unless it ends in
      `be` (`uint16be`); raw files only.
    - `spacing`: see `Volume`; in place of the file's, or of (1, 1, 1) where it has none.
    - `origin`: see `Volume`; in place of the file's, or of (0, 0, 0) where it has none.

    **Returns:** the `Volume`, voxels in the file's type except as said above.

    **Raises:** `ValueError` for a file that is missing, empty, corrupt, of unknown kind, longer or
    shorter than its header says, or without one; for an image that is oblique, not 3-D or not scalar;
    and for what `Volume` refuses. `ImportError` for a format that needs SimpleITK where there is none.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"path: there is no file {path} (looked from {Path.cwd()}). Check the spelling.")
    ending = max((e for e in READERS if path.name.lower().endswith(e)), key=len, default=None)
    if ending is None:
        fault = "is a directory" if path.is_dir() else "has an unknown ending"
        raise ValueError(f"path: {path} {fault}; expected a file ending in {', '.join(sorted(READERS))}.")
    placed = {name: said for name, said in (("spacing", spacing), ("origin", origin)) if said is not None}
    arguments = READERS[ending](path, Header(shape, dtype)) | placed
    try:
        return Volume(**arguments)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from fault


def register(ending: str, reader: Reader) -> None:
    """Lets `load` read files of one more kind, or read a kind otherwise.

    **Arguments:**

    - `ending`: how their names end, such as `".vti"`; upper and lower case are the same, and of two
      endings that fit a name the longer one counts.
    - `reader`: `reader(path, header)` gives a dict of the arguments of `Volume`: `data`, and those of
      `spacing`, `origin` and `labels` that the file holds. A file that says its own shape and type
      calls `header.refuse(path)`. `path` exists, and may be a directory.
    """
    if not ending.startswith("."):
        raise ValueError(f'ending must start with a dot, such as ".vti"; got {ending!r}.')
    READERS[ending.lower()] = reader
