"""Checkpoints, so that a fit survives being killed: one line of JSON that describes it, then its arrays."""

import json
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx

from .._util.whole_files import whole_file


T = TypeVar("T")


def save(path: Path, state: Any, about: dict[str, Any]) -> None:
    """Write the arrays of `state` and the description `about` of its fit to `path`, replacing its content."""
    with whole_file(path) as part, part.open("wb") as file:
        file.write(json.dumps(about).encode() + b"\n")
        eqx.tree_serialise_leaves(file, state)


def load(path: Path, like: T, about: dict[str, Any]) -> tuple[T, dict[str, Any]] | None:
    """The saved state, a tree like `like`, with its description; None if none was saved. **Raises**
    `ValueError` for a damaged file, and one of another fit than `about` describes, at least."""
    if not path.exists():
        return None
    remedy = "Choose another file, or delete this one."
    try:
        with path.open("rb") as file:
            saved = json.loads(file.readline())
            differs = next((key for key, value in about.items() if saved[key] != value), None)
            if differs is None:
                return eqx.tree_deserialise_leaves(file, like), saved
    except Exception as fault:  # readers of JSON and of arrays raise errors of many kinds
        raise ValueError(f"checkpoint {path} is damaged, or no checkpoint. {remedy}") from fault
    raise ValueError(
        f"checkpoint {path} belongs to another fit: its {differs} is {saved[differs]}, that of this fit is "
        f"{about[differs]}. {remedy}"
    )
