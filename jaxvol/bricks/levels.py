"""Which level of detail is fine enough for a view?"""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from ..scene.camera import Camera, axes_of
from .sources import VoxelSource


def level_for(levels: Sequence[VoxelSource], camera: Camera) -> int:
    """The coarsest level whose voxels are no larger than a pixel at the volume's corner nearest to the image
    plane. An axis along which a level is as fine as the finest does not count against it.

    **Arguments:** `levels`: of the same volume, finest first, all with spacing and origin (`levels_of`).
    `camera`: the view.

    **Returns:** its index, 0 for the finest; also where the camera is within the volume.

    **Raises:** `ValueError` for several levels of which one has no place in the world.
    """
    if len(levels) == 1:
        return 0
    for number, level in enumerate(levels):
        if level.spacing is None or level.origin is None:
            raise ValueError(f"levels must have spacing and origin; level {number} ({level.name}) has none.")
    finest: Any = levels[0]
    width, height = camera.size
    left, right, low, high = np.asarray(camera.window, float)
    pixel = min((right - left) / width, (high - low) / height)
    if camera.parallel_scale is not None:
        pixel *= float(camera.parallel_scale)
    else:
        forward, position = (np.asarray(each, float) for each in (axes_of(camera)[2], camera.position))
        size = np.array(finest.spacing) * (np.array(finest.shape) - 1)
        corners = np.array(finest.origin) + np.array(list(product((0, 1), repeat=3))) * size
        nearest = max(float(np.min((corners - position) @ forward)), 0.0)
        pixel *= np.tan(np.deg2rad(float(camera.view_angle)) / 2) * nearest
    allowed = np.maximum(pixel, finest.spacing) * (1 + 1e-6)  # spacings of equal length may be rounded
    return max(k for k, level in enumerate(levels) if k == 0 or np.all(np.array(level.spacing) <= allowed))
