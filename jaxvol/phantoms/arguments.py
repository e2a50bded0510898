"""Is this argument a whole number that is large enough?"""

from typing import Any

import numpy as np


def integer(name: str, value: int | Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}; got {value!r}.")
    return int(value)
