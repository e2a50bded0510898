"""Checkpoints, so that a fit survives being killed: the file is complete at all times and identifies its fit.

A file is one line with a checksum over the rest, one line of JSON that describes the fit, and the arrays, one
after the other, as `equinox.tree_serialise_leaves` writes them: NumPy's .npy, never pickled.
"""

import hashlib
import io
import itertools
import json
import os
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import numpy as np

from .._util.whole_files import whole_file


T = TypeVar("T")


def save(path: Path, state: Any, about: dict[str, Any]) -> None:
    """Write the arrays of `state` and the description `about` of its fit to `path`, replacing its content."""
    content = io.BytesIO()
    content.write(json.dumps(about).encode() + b"\n")
    eqx.tree_serialise_leaves(content, state)
    with whole_file(path) as part, part.open("wb") as file:
        file.write(_checksum_line(content))
        file.write(content.getbuffer())
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, like: T, about: dict[str, Any]) -> tuple[T, dict[str, Any]] | None:
    """The saved state, a tree like `like`, with its description; or None if none was saved.

    **Raises:** `ValueError` for a damaged file, and for a checkpoint of another fit than `about` describes
    (the saved description may have more entries).
    """
    if not path.exists():
        return None
    with path.open("rb") as file:
        first, content = file.readline(), io.BytesIO(file.read())
    if first != _checksum_line(content):
        raise ValueError(
            f"checkpoint {path} is damaged, or no checkpoint: its checksum does not match. Choose another "
            "file, or delete this one."
        )
    saved = json.loads(content.readline())
    for key, expected in about.items():
        if not _agree(saved.get(key), expected):
            difference = _differing(saved.get(key), expected)
            raise ValueError(
                f"checkpoint {path} belongs to another fit: its {key} {difference}. Choose another file, or "
                "delete this one."
            )
    return eqx.tree_deserialise_leaves(content, like), saved


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
