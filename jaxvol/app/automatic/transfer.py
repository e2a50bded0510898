"""Which transfer function shows what a volume holds, as far as its histogram tells?"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Shaped

from ..._util.checks import described
from ..._util.srgb import from_srgb
from ...scene.transfer import TransferFunction, extinction_of
from ...scene.volume import Volume
from ...xla.platform import is_traced
from .histogram import is_body, sampled, thresholds, unit_of


CUT = 0.25
"""Part of the voxels at the volume's faces from which on they cut through what they hold."""


def automatic_transfer(volume: Volume | Any) -> TransferFunction:
    """A transfer function that shows what a volume holds, from its histogram.

    Two thresholds part the values into three classes so that the variance within each is least (Otsu): what
    is around the object, the object, and what is dense in it. The border of the object is shown translucent,
    what is dense in it nearly opaque. Where the volume's faces cut the object, as in most CT scans, where it
    is grain, as in ultrasound, or only borders of what is dense, as in angiograms, it would hide what is
    dense, which alone is shown then. It is a guess. Opacities do not depend on the volume's units.

    **Arguments:** `volume`: the `Volume`. Of more than 2 million voxels, every n-th is looked at.

    **Returns:** the `TransferFunction`.

    **Raises:** `ValueError` for what is no volume, or traced.

    Source: Otsu, "A Threshold Selection Method from Gray-Level Histograms", 1979.
    """
    if not isinstance(volume, Volume):
        raise ValueError(f"volume must be a jaxvol Volume; got {described(volume)}.")
    if is_traced(volume):
        raise ValueError(
            "volume is traced here, and its histogram is needed: call automatic_transfer outside of jax.jit, "
            "jax.vmap and jax.grad, and pass what it returns."
        )
    with jax.ensure_compile_time_eval():  # of a volume from outside, also where something else is traced
        return transfer_by_copy(volume, np.asarray(volume.data))


def transfer_by_copy(copy: Volume, part: Shaped[np.ndarray, "nx ny nz"]) -> TransferFunction:
    """The same by a copy of every n-th voxel, and a part as it is, which tells what is grain."""
    values = sampled(copy).ravel().astype(np.float32)
    low, high = float(values.min()), float(values.max())
    if not low < high:
        points = [(low, TISSUE, 0.5), (low + max(abs(low), 1.0), TISSUE, 0.5)]
    else:
        first, second = thresholds(values)
        data = np.asarray(copy.data)
        outer = np.concatenate([data.take(end, axis).ravel() for axis in range(3) for end in (0, -1)])
        whole = np.mean(outer > first) < CUT and is_body(part, first, second)
        points = _shell(low, first, second, high) if whole else _dense(first, second, high)
    at, colors, opacities = zip(*points, strict=True)
    linear = np.asarray(from_srgb(np.array(colors) / 255))
    return TransferFunction(np.array(at), linear, extinction_of(opacities, unit_of(copy)))


EDGE, SKIN, TISSUE = (70, 30, 18), (214, 130, 92), (190, 92, 62)
DENSE, BRIGHT = (236, 208, 160), (255, 246, 226)
"""Colours, 8-bit sRGB: of the border's foot, the border, the object, what is dense, and what is densest."""


def _shell(low: float, first: float, second: float, high: float) -> list[tuple[float, Any, float]]:
    w, d = min(first - low, second - first) / 3, (second - first) / 4
    border = [(first - w, EDGE, 0.0), (first, SKIN, 0.3), (first + w, SKIN, 0.07)]
    return [*border, (second - d, TISSUE, 0.04), *_densest(second, d, high)]


def _dense(first: float, second: float, high: float) -> list[tuple[float, Any, float]]:
    d = (second - first) / 4
    return [(second - 2 * d, EDGE, 0.0), (second - d, TISSUE, 0.02), *_densest(second, d, high)]


def _densest(second: float, d: float, high: float) -> list[tuple[float, Any, float]]:
    return [(second, DENSE, 0.45), (max((second + high) / 2, second + d / 2), BRIGHT, 0.9)]
