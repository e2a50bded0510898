"""Texts of arrays that Python reads, and names near a wrong one."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import jax
import numpy as np

from ..xla.platform import is_traced
from .checks import described


def is_concrete(array: Any) -> bool:
    """Whether this is an array whose numbers are known."""
    return isinstance(array, np.ndarray | np.generic | jax.Array) and not is_traced(array)


def pasted(value: Any) -> str:
    """Numbers as nested tuples that Python reads, with the digits that their type has; or a description."""
    if not is_concrete(value):
        return described(value)
    given = np.asarray(value)
    return f"({', '.join(map(pasted, given))}{',' * (len(given) == 1)})" if given.ndim else str(given[()])


def near(given: str, names: Iterable[str]) -> str:
    """A sentence that asks whether one of up to three names like this one is meant; empty without any."""
    by_case = {name.lower(): name for name in names}
    most = 1 if given.lower() in by_case else 3
    found = [by_case[name] for name in get_close_matches(given.lower(), by_case, most)]
    return f" Did you mean {' or '.join(found)}?" if found else ""
