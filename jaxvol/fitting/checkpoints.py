"""Checkpoints, so that a fit survives being killed: the file is complete at all times and identifies its fit.

Arrays are stored as NumPy's .npz, never pickled, with a checksum over all of them. A new file is written
beside the old one and moved into its place in one operation; the old one is kept as `NAME.before`.
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
    """Write the arrays, and the description `about` of their fit, to `path`, replacing its content."""
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
    """The saved arrays, or None if there are none. A damaged file is named in a warning, and the previous one
    is used.

    **Raises:** `ValueError` for a checkpoint of another fit than `about` describes.
    """
    for candidate in (path, before(path)):
        if not candidate.exists():
            continue
        try:
            arrays, saved = _read(candidate)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as fault:
            warnings.warn(
                f"checkpoint {candidate} is damaged and ignored ({fault}); the fit continues from the "
                "previous one, or from the start if there is none.",
                stacklevel=4,
            )
            continue
        for key, expected in about.items():
            if not _agree(saved.get(key), expected):
                raise ValueError(
                    f"checkpoint {candidate} belongs to another fit: its {key} is {saved.get(key)}, "
                    f"that of this fit is {expected}. Choose another file, or delete this one."
                )
        return arrays
    return None


def before(path: Path) -> Path:
    """Path of the previous checkpoint."""
    return path.with_name(path.name + ".before")


def _read(path: Path) -> tuple[Arrays, dict[str, Any]]:
    with np.load(path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files}
    checksum = content.pop("checksum")
    if not np.array_equal(checksum, _checksum(content)):
        raise ValueError("its checksum does not match")
    return content, json.loads(content.pop("about").tobytes())


def _checksum(content: Arrays) -> np.ndarray:
    digest = hashlib.sha256()
    for name in sorted(content):
        array = np.ascontiguousarray(content[name])
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        digest.update(array.tobytes())
    return np.frombuffer(digest.digest(), np.uint8)


def _agree(saved: Any, expected: Any) -> bool:
    """Whether two entries agree; floats may differ, since another machine may round differently."""
    if isinstance(expected, float) and isinstance(saved, float):
        return bool(np.isclose(saved, expected, rtol=1e-4))
    return saved == expected
