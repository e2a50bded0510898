"""How does a fit survive being killed? By a file that is whole at every moment, and says what it belongs to.

Arrays as NumPy's .npz, never pickled, with a checksum over all of them. A new file is written beside the old
one and put in its place in one operation; the old one is kept as `NAME.before`.
"""

import hashlib
import io
import json
import os
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np


Arrays = dict[str, np.ndarray]


def save(path: Path, arrays: Arrays, about: dict[str, Any]) -> None:
    """Write arrays, and what they belong to, in place of what `path` held before."""
    content = {**arrays, "about": np.frombuffer(json.dumps(about).encode(), np.uint8)}
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, checksum=_checksum(content), **content)
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(buffer.getbuffer())
        file.flush()
        os.fsync(file.fileno())
    if path.exists():
        os.replace(path, before(path))
    os.replace(part, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path, about: dict[str, Any]) -> Arrays | None:
    """What was saved, or None where nothing was. A file that is damaged is named in a warning, and the one
    before it is used.

    **Raises:** `ValueError` for a checkpoint that belongs to something else than `about`.
    """
    for candidate in (path, before(path)):
        if not candidate.exists():
            continue
        try:
            arrays, found = _read(candidate)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as fault:
            warnings.warn(
                f"checkpoint {candidate} is damaged and not used ({fault}); the fit goes on from the one "
                "before it, or where there is none, from the start.",
                stacklevel=4,
            )
            continue
        for what, here in about.items():
            if not _agree(found.get(what), here):
                raise ValueError(
                    f"checkpoint {candidate} belongs to another fit: its {what} is {found.get(what)}, "
                    f"that of this fit is {here}. Give another file, or delete this one."
                )
        return arrays
    return None


def before(path: Path) -> Path:
    """Where the checkpoint before the last one is kept."""
    return path.with_name(path.name + ".before")


def _read(path: Path) -> tuple[Arrays, dict[str, Any]]:
    with np.load(path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files}
    checksum = content.pop("checksum")
    if not np.array_equal(checksum, _checksum(content)):
        raise ValueError("its checksum is another")
    return content, json.loads(content.pop("about").tobytes())


def _checksum(content: Arrays) -> np.ndarray:
    digest = hashlib.sha256()
    for name in sorted(content):
        array = np.ascontiguousarray(content[name])
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        digest.update(array.tobytes())
    return np.frombuffer(digest.digest(), np.uint8)


def _agree(found: Any, here: Any) -> bool:
    """Floats may differ by what another machine rounds otherwise."""
    if isinstance(here, float) and isinstance(found, float):
        return bool(np.isclose(found, here, rtol=1e-4))
    return found == here
