"""How does a colour of a display become one of a transfer function?"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..._util.srgb import from_srgb


def linear(color: Sequence[int]) -> Float[np.ndarray, "3"]:
    """Linear RGB of an 8-bit sRGB colour."""
    return np.asarray(from_srgb(np.array(color) / 255))
