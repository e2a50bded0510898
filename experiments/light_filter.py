"""Filters an image against the noise of templates that are chosen for each pixel: the future work of Lee,
Kwon and Shin (2016).

The noise is in how much light each pixel gets, and neither in what it shows nor in how far away that is. So
the light, which is the lit image over the unlit one, is averaged over pixels around whose depths are alike,
by scikit-image's non-local means, and falls on the unlit image again.
"""

import numpy as np
from skimage.restoration import denoise_nl_means

import jaxvol as jv


REACH = 6
"""Pixels to each side over which light is averaged."""
DEPTH = 3.0
"""Voxels of depth between pixels that are not to be averaged any more."""
LIGHT = 0.25
"""How much differences in light count beside those in depth, in units of the mean light: little, since most
of them are noise."""
FAINT = 1e-3
"""Pixels fainter than this keep their colour."""


def filtered(lit: np.ndarray, unlit: jv.Rendering, voxel: float) -> np.ndarray:
    """The lit image (H, W, 4), with less noise, from that without light. `voxel`: its size, world length."""
    before, depth = np.asarray(unlit.rgba[..., :3]), np.asarray(unlit.depth)
    lit, seen = np.asarray(lit), before.max(-1) > FAINT
    light = np.where(seen[..., None], lit[..., :3] / np.maximum(before, FAINT), 0)
    mean = light[seen].mean()
    # what is not seen is farther from everything than any light differs
    away = np.where(seen, np.where(seen, depth, 0) / (DEPTH * voxel), 1e3)
    both = np.concatenate([LIGHT / mean * light, away[..., None]], axis=-1)
    smooth = denoise_nl_means(both, patch_size=3, patch_distance=REACH, h=1.0, channel_axis=-1)
    color = np.where(seen[..., None], smooth[..., :3] * mean / LIGHT * before, lit[..., :3])
    return np.concatenate([color, lit[..., 3:]], axis=-1)
