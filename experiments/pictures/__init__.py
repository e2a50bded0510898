"""Renders the pictures of the papers' figures: rows of panels, which the scripts of paper_figs/ lay out.

A function for each figure, from the options of its script: `size`, pixels along a side; `resolution`, voxels
along an axis of a phantom; `data`, the folder of real volumes or None; `quick`.
"""

from typing import Any, NamedTuple, TypeAlias

import numpy as np

import jaxvol as jv


BLACK = (0.0, 0.0, 0.0)


class Panel(NamedTuple):
    """A picture, sRGB, with text below and above it. `square`: left, top and side of a part that is framed,
    pixels."""

    image: np.ndarray
    below: str = ""
    above: str = ""
    square: tuple[float, float, float] | None = None


Panels: TypeAlias = list[list[Panel]]
"""By row and column."""


def panel(linear: Any, below: str = "", above: str = "", square: Any = None) -> Panel:
    """Of a linear image."""
    return Panel(np.asarray(jv.to_srgb(np.clip(linear, 0, 1))), below, above, square)
