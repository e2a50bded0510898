"""Starting points for fits of transfer functions."""

import numpy as np

from .._util.checks import Arrayable, finite_array, integer, require
from ..scene.transfer import TransferFunction
from ..scene.volume import Volume


def flat_grey(volume: Volume, points: int = 8, clim: Arrayable | None = None) -> TransferFunction:
    """A transfer function to start a fit from: middle grey, with the same extinction everywhere.

    Args:
        volume: the volume, whose optical depth becomes about 1: its back is visible as well as its front.
        points: number of control points, at least 2, evenly spaced.
        clim: range (low, high) of the control points, in value units; by default that of the volume.

    Returns:
        The `TransferFunction`, with colours 0.5.

    Raises:
        ValueError: for fewer than two points, and for a range that does not increase.
    """
    points = integer("points", points, 2)
    if clim is None:
        data = np.asarray(volume.data)
        clim = float(data.min()), float(data.max())
    message = "clim must be (low, high), low first; got {got}."
    low, high = require(finite_array("clim", clim, (2,)), lambda c: c[0] < c[1], message)
    extent = float(np.mean(np.diff(np.asarray(volume.bounds).reshape(3, 2))))
    values = np.linspace(float(low), float(high), points)
    return TransferFunction(values, np.full((points, 3), 0.5), np.full(points, 1 / extent))
