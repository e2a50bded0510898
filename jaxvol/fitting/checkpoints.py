"""Checkpoints, so that a fit survives being killed: the file is complete at all times and identifies its fit.

A file is one line with a checksum over the rest, one line of JSON that describes the fit, and the arrays, one
after the other, as `equinox.tree_serialise_leaves` writes them: NumPy's .npy, never pickled. A new file is
written beside the old one and moved into its place in one operation; the old one is kept as `NAME.before`.
"""

import hashlib
import io
import itertools
import json
import os
import warnings
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import numpy as np

from .._util.whole_files import whole_file


T = TypeVar("T")


def save(path: Path, state: Any, about: dict[str, Any]) -> None:
    """Write the arrays of `state` and the description `about` of its fit to `path`, replacing its content."""
    buffer = io.BytesIO()
    buffer.write(json.dumps(about).encode() + b"\n")
    eqx.tree_serialise_leaves(buffer, state)
    with whole_file(path) as part:
        with part.open("wb") as file:
            file.write(_checksum_line(buffer))
            file.write(buffer.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, before(path))
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def load(path: Path, like: T, about: dict[str, Any]) -> tuple[T, dict[str, Any]] | None:
    """The saved state, a tree like `like`, with its description; or None if none was saved. A damaged file is
    named in a warning, and the previous one is used.

    **Raises:** `ValueError` for a checkpoint of another fit than `about` describes (the saved description may
    have more entries), or of an earlier version.
    """
    for candidate in (path, before(path)):
        if not candidate.exists():
            continue
        try:
            saved, leaves = _read(candidate)
        except (OSError, ValueError) as fault:
            warnings.warn(
                f"checkpoint {candidate} is damaged and ignored ({fault}); the fit continues from the "
                "previous one, or from the start if there is none.",
                stacklevel=4,
            )
            continue
        if saved is None:
            raise ValueError(
                f"checkpoint {candidate} is a zip archive, as earlier versions of jaxvol wrote; this version "
                "cannot continue from it. Choose another file, or delete this one."
            )
        for key, expected in about.items():
            if not _agree(saved.get(key), expected):
                raise ValueError(
                    f"checkpoint {candidate} belongs to another fit: its {key} "
                    f"{_differing(saved.get(key), expected)}. Choose another file, or delete this one."
                )
        return eqx.tree_deserialise_leaves(leaves, like), saved
    return None


def before(path: Path) -> Path:
    """Path of the previous checkpoint."""
    return path.with_name(path.name + ".before")


def _read(path: Path) -> tuple[dict[str, Any] | None, io.BytesIO]:
    """The description, None for a zip archive; and the rest of the file."""
    with path.open("rb") as file:
        first = file.readline()
        content = io.BytesIO(file.read())
    if first.startswith(b"PK"):
        return None, content
    if first != _checksum_line(content):
        raise ValueError("its checksum does not match")
    return json.loads(content.readline()), content


def _checksum_line(content: io.BytesIO) -> bytes:
    """First line of a file with this content."""
    return b"jaxvol checkpoint, SHA-256 " + hashlib.sha256(content.getbuffer()).hexdigest().encode() + b"\n"


def _differing(saved: Any, expected: Any) -> str:
    """What differs, of lists the first entries that do."""
    if not (isinstance(saved, list) and isinstance(expected, list)):
        return f"is {saved}, that of this fit is {expected}"
    pairs = itertools.zip_longest(saved, expected, fillvalue="nothing")
    there, here = next((there, here) for there, here in pairs if not _agree(there, here))
    return f"is of {there}, where that of this fit is of {here}"


def _agree(saved: Any, expected: Any) -> bool:
    """Whether two entries agree; floats may differ, since another machine may round differently."""
    if isinstance(expected, float) and isinstance(saved, float):
        return bool(np.isclose(saved, expected, rtol=1e-4))
    return saved == expected
