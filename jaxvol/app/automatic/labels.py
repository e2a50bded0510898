"""Are the voxels of a volume labels, and in which colours are they shown?"""

import numpy as np
from jaxtyping import Shaped

from ..._util.srgb import from_srgb
from ...scene.labels import LabelTransferFunction
from ...scene.transfer import TransferFunction, extinction_of
from ...scene.volume import Volume
from .histogram import unit_of


FEWEST_FLAT = 0.8
"""Part of the voxels, of those that are not the lowest, whose neighbour has the same value: above it, whole
numbers are taken for labels. It was 0.92 in a segmented frog, 0.25 at most in twelve scans and simulations,
and 0.46 at most in phantoms."""

MOST_LABELS = 64

INSIDE = 255
"""Value of what has a label, in the volume that is shown."""


def labels_shown(volume: Volume) -> tuple[Volume, LabelTransferFunction] | None:
    """How a volume is shown whose voxels are labels; None if they seem to be none.

    Voxels are taken for labels if they are whole numbers of few kinds, and nearly all of a kind lie beside
    others of it. The lowest is what is around.

    **Returns:** a volume in the same place, whose values are smooth, 255 inside of all labels, and whose
    labels reach two voxels beyond; and a transfer function that shows what is inside, each label in its own
    colour."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    data = np.asarray(volume.data)
    kinds = _kinds(data)
    if kinds is None:
        return None
    if data.dtype in (np.uint8, np.uint16):  # by a table, which is faster than a search for each voxel
        labels = np.searchsorted(kinds, np.arange(int(kinds[-1]) + 1)).astype(np.uint8)[data]
    else:
        labels = np.searchsorted(kinds, data).astype(np.uint8)
    inside = gaussian_filter(np.where(labels > 0, np.float32(INSIDE), np.float32(0)), LABEL_BLUR)
    beyond = np.where(labels > 0, labels, maximum_filter(labels, size=5))
    place = volume.spacing, volume.origin
    shown = Volume((inside + 0.5).astype(np.uint8), *place, beyond, direction=volume.direction)
    colors = np.asarray(from_srgb(np.array(COLORS) / 255))
    opacity = extinction_of([0.0, 0.0, 0.9], unit_of(volume))
    functions = {
        label: TransferFunction(
            [0, 0.35 * INSIDE, 0.65 * INSIDE], [colors[(label - 1) % len(COLORS)]] * 3, opacity
        )
        for label in range(1, len(kinds))
    }
    return shown, LabelTransferFunction(functions)


LABEL_BLUR = 0.8
"""Voxels by which the border of what has a label is smoothed, so that it has a gradient."""

COLORS = (
    *((31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189), (140, 86, 75)),
    *((227, 119, 194), (188, 189, 34), (23, 190, 207), (174, 199, 232), (255, 187, 120), (152, 223, 138)),
    *((255, 152, 150), (197, 176, 213), (196, 156, 148), (247, 182, 210), (219, 219, 141), (158, 218, 229)),
)
"""Colours of labels, 8-bit sRGB: those of matplotlib's tab20 without its greys, one of each pair first."""


def _kinds(data: Shaped[np.ndarray, "nx ny nz"]) -> Shaped[np.ndarray, " n"] | None:
    """The labels, in order, if the voxels are labels."""
    if data.dtype.kind not in "iu":
        return None
    inside = data[:-1] != data.min()
    if not inside.any() or np.mean(data[:-1][inside] == data[1:][inside]) < FEWEST_FLAT:
        return None
    kinds = np.unique(data)
    return kinds if 2 < len(kinds) <= MOST_LABELS else None
