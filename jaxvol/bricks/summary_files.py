"""Is a summary already known? Keeps summaries in files beside the data.

A file holds the fingerprint of the data it was made from and is used for no other. It appears whole or not at
all, and whoever finds it damaged makes it anew.
"""

import hashlib
import json
import os
import warnings
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .._util.checks import described, integer
from .._util.npy import read_arrays
from .._util.whole_files import whole_file
from ..occupancy import BLOCK
from .sources import VoxelSource
from .summary import COMBINED, Progress, Summary, scan


VERSION = 2
"""Of the files and of what is in them; others are made anew."""


def summary_of(
    source: VoxelSource,
    cell: int | Any = BLOCK,
    *,
    memory: int = 2**28,
    cache: Literal["beside"] | str | os.PathLike[str] | Any | None = "beside",
    progress: Progress | None = None,
) -> Summary:
    """The summary of a source: from a file, if it was made before, else from one pass over the voxels.

    **Arguments:**

    - `source`: the voxels.
    - `cell`, `memory`, `progress`: see `summary.scan`. `progress` is called only in a pass.
    - `cache`: where files lie. `"beside"`: beside the data, `NAME.jaxvol-summary-CELL.npz`; a folder: in it,
      and it is made if it is not there, but not those above it; None: nowhere. Arrays in memory have no
      files, and neither has a memory map that is open for writing.

    **Returns:** the summary.

    **Raises:** `ValueError` as `summary.scan` does, for a `cache` that lies in no folder, and if the source
    changes during the pass. A file that cannot be written is a warning. A pass that is interrupted leaves
    files as they were.
    """
    cell = integer("cell", cell, BLOCK)
    check_cache(cache)
    before = None if cache is None or source.beside is None else source.fingerprint()
    if before is None or source.beside is None:
        return scan(source, cell, memory=memory, progress=progress)
    path, about = _path(source.beside, cell, cache), _about(source, before, cell)
    known = _read(path, source, about) if path.is_file() else None
    if known is not None:
        return known
    summary = scan(source, cell, memory=memory, progress=progress)
    if source.fingerprint() != before:
        raise ValueError(f"{source.name} changed while it was read. Open it again once it is complete.")
    try:
        _write(path, summary.ranges, about)
    except OSError as fault:
        warnings.warn(
            f"{path} cannot be written ({fault.strerror or fault}), so that the pass over {source.name} will "
            "be repeated next time. Pass cache= the path of a folder, or cache=None.",
            stacklevel=2,
        )
    return summary


def check_cache(cache: Any) -> None:
    """**Raises** `ValueError` for what is neither "beside", nor a folder that is there or can be made, nor
    None; whether or not the source has files there."""
    if cache is None:
        return
    if not isinstance(cache, str | os.PathLike):
        raise ValueError(f'cache must be "beside", a folder, or None; got {described(cache)}.')
    if cache == "beside":
        return
    if not str(cache):
        raise ValueError("cache must be \"beside\", a folder, or None; got ''.")
    folder = Path(cache)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f'cache must be "beside", a folder, or None; {folder} is a file.')
    if not folder.absolute().parent.is_dir():
        raise ValueError(
            f"cache: there is no folder {folder.absolute().parent} in which {folder.name} could be made. "
            "Check the spelling, or make it."
        )


def _path(beside: Path, cell: int, cache: str | os.PathLike[str] | Any) -> Path:
    name = f"{beside.name}.jaxvol-summary-{cell}.npz"
    if cache == "beside":
        return beside.with_name(name)
    # data of the same name may lie in different folders
    folder = Path(cache)
    return folder / f"{hashlib.blake2b(str(beside).encode(), digest_size=4).hexdigest()}-{name}"


def _about(source: VoxelSource, fingerprint: dict[str, Any], cell: int) -> dict[str, Any]:
    """What a summary is valid for, as JSON gives it back."""
    about = {"version": VERSION, "cell": cell, "dtype": source.dtype.name, "data": fingerprint}
    return json.loads(json.dumps(about))


def _write(path: Path, ranges: dict[str, np.ndarray], about: dict[str, Any]) -> None:
    told = np.frombuffer(json.dumps(about).encode(), np.uint8)
    # bfloat16, which NumPy's files do not know, as integers of its bits
    arrays = {
        name: part if part.dtype.kind in "iuf" else part.view(np.uint16) for name, part in ranges.items()
    }
    arrays["about"] = told
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as part, part.open("xb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def _read(path: Path, source: VoxelSource, about: dict[str, Any]) -> Summary | None:
    """The summary in a file, if it is whole and belongs to these data."""
    cell = about["cell"]
    blocks = tuple(-(-(n - 1) // cell) for n in source.shape)
    try:
        told = json.loads(read_arrays(path, ("about",))["about"].tobytes())
        if told != about:
            return None
        ranges = read_arrays(path, tuple(COMBINED))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):  # damaged
        return None
    for name, part in ranges.items():
        if part.dtype != source.dtype:
            ranges[name] = part = part.view(source.dtype)
        if part.shape != blocks:
            return None
    return Summary(source.shape, cell, ranges)
