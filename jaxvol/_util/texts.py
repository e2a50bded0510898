"""Array literals for messages, suggestions of names similar to a wrong one, and warnings."""

import sys
import warnings
from collections.abc import Iterable
from difflib import get_close_matches

import jax
import numpy as np

from ..xla.platform import is_traced
from .checks import described


INNER = "jaxvol.", "equinox.", "jaxtyping.", "beartype"  # modules between a user's call and `warn_caller`


def is_concrete(array: object) -> bool:
    """Test for an array with known numbers, as opposed to a traced one."""
    return isinstance(array, np.ndarray | np.generic | jax.Array) and not is_traced(array)


def pasted(value: object) -> str:
    """Python literal (nested tuples) of an array, with the digits of its type; or a description."""
    if not is_concrete(value):
        return described(value)
    array = np.asarray(value)
    return f"({', '.join(map(pasted, array))}{',' * (len(array) == 1)})" if array.ndim else str(array[()])


def near(word: str, names: Iterable[str]) -> str:
    """Sentence that suggests up to three names similar to `word`; empty if there are none."""
    by_case = {name.lower(): name for name in names}
    count = 1 if word.lower() in by_case else 3
    matches = [by_case[name] for name in get_close_matches(word.lower(), by_case, count)]
    return f" Did you mean {' or '.join(matches)}?" if matches else ""


def warn_caller(text: str) -> None:
    """Warn at the line that called the library."""
    level, frame = 1, sys._getframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith(INNER):
        level, frame = level + 1, frame.f_back
    warnings.warn(text, stacklevel=level)
