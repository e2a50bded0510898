"""Are the voxels of a volume labels, and in which colours are they shown?"""

from typing import cast

import numpy as np
from jaxtyping import Shaped

from ..._util.srgb import from_srgb
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction, extinction_of
from ...scene.volume import Volume
from .histogram import unit_of


FEWEST_FLAT = 0.8
"""Part of the voxels that are not the lowest whose neighbour has the same value: above it, whole numbers are
labels. It was 0.92 in a segmented frog, and 0.46 at most in scans, simulations and phantoms."""

MOST_LABELS = 64

LABEL_BLUR = 0.8
"""Voxels by which the border of what has a label is smoothed, so that it has a gradient."""

INSIDE = 255
"""Value of what has a label, in the volume that is shown."""


def labels_shown(volume: Volume) -> tuple[Volume, LabelTransferFunction] | None:
    """A volume and a transfer function that show each label but the lowest in its own colour; None if there
    are no labels. The volume is smooth, 255 inside of all labels, and its labels reach two voxels beyond."""
    import matplotlib
    from matplotlib.colors import ListedColormap
    from scipy.ndimage import gaussian_filter, maximum_filter

    data = np.asarray(volume.data)
    kinds = _kinds(data)
    if kinds is None:
        return None
    labels = np.searchsorted(kinds, data).astype(np.uint8)
    inside = gaussian_filter(np.where(labels > 0, np.float32(INSIDE), np.float32(0)), LABEL_BLUR)
    beyond = np.where(labels > 0, labels, maximum_filter(labels, size=5))
    place = volume.spacing, volume.origin
    shown = Volume((inside + 0.5).astype(np.uint8), *place, beyond, direction=volume.direction)
    tab20 = np.array(cast(ListedColormap, matplotlib.colormaps["tab20"]).colors)
    dark_then_light = np.delete(np.concatenate([tab20[::2], tab20[1::2]]), (7, 17), axis=0)  # without greys
    colors = np.asarray(from_srgb(dark_then_light))
    opacity = extinction_of([0.0, 0.0, 0.9], unit_of(volume))
    functions = {
        label: TransferFunction(
            [0, 0.35 * INSIDE, 0.65 * INSIDE], [colors[(label - 1) % len(colors)]] * 3, opacity
        )
        for label in range(1, len(kinds))
    }
    return shown, LabelTransferFunction(functions)


def _kinds(data: Shaped[np.ndarray, "nx ny nz"]) -> Shaped[np.ndarray, " n"] | None:
    """The labels, in order, if the voxels are labels."""
    if data.dtype.kind not in "iu":
        return None
    inside = data[:-1] != data.min()
    if not inside.any() or np.mean(data[:-1][inside] == data[1:][inside]) < FEWEST_FLAT:
        return None
    kinds = np.unique(data)
    return kinds if 2 < len(kinds) <= MOST_LABELS else None
