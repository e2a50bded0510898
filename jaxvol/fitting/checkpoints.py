"""Checkpoints of fits: a file with one line of JSON that describes the fit, then its arrays."""

import json
from pathlib import Path
from typing import IO, Any, TypeVar

import equinox as eqx
import jax
import numpy as np

from .._util.whole_files import whole_file
from ..xla.trees import PyTree


T = TypeVar("T")


def save(path: Path, state: PyTree, description: dict[str, Any]) -> None:
    """Write the description of a fit and the arrays of its state to `path`, replacing its content."""
    with whole_file(path) as part, part.open("wb") as file:
        file.write(json.dumps(description).encode() + b"\n")
        eqx.tree_serialise_leaves(file, state)


def load(path: Path, template: T, description: dict[str, Any]) -> tuple[T, dict[str, Any]] | None:
    """The saved state, a tree like `template`, and its description, of the same fit; None without a file."""
    if not path.exists():
        return None
    remedy = "Choose another file, or delete this one."
    try:
        with path.open("rb") as file:
            saved = json.loads(file.readline())
            differs = next((key for key, value in description.items() if saved[key] != value), None)
            if differs is None:
                return eqx.tree_deserialise_leaves(file, template, _read_leaf), saved
    except Exception as fault:  # readers of JSON and of arrays raise errors of many kinds
        raise ValueError(f"checkpoint {path} is damaged, or no checkpoint. {remedy}") from fault
    raise ValueError(
        f"checkpoint {path} belongs to another fit: its {differs} is {saved[differs]}, that of this fit is "
        f"{description[differs]}. {remedy}"
    )


def _read_leaf(file: IO[bytes], like: Any) -> Any:
    """A leaf of the state; `jnp.load` would compile a program for each shape."""
    if isinstance(like, jax.Array):
        return jax.device_put(np.load(file))
    return eqx.default_deserialise_filter_spec(file, like)
